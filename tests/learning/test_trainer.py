"""The trainer: the same weights whatever interrupts it, however many processes share it, and words for every fault."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load_file

from fracsim.cli.main import main
from fracsim.common.errors import ModelError
from fracsim.data.dataset import Dataset
from fracsim.learning.body import BodyGeometry
from fracsim.learning.model import load_model
from fracsim.learning.options import TrainingOptions, options_from
from fracsim.learning.shuffle import shuffled
from fracsim.learning.targets import Targets, amae_loss
from fracsim.learning.trainer import Run, train
from fracsim.metrics import amae

FOREVER = 10**6


class Line:
    """Learns y = 2 x_0 - x_1, through dropout and drawn noise, so that every source of chance is in it."""

    def __init__(self, count=40, dropout=0.2, noise=0.1):
        torch.manual_seed(5)
        self.module = torch.nn.Sequential(
            torch.nn.Linear(2, 8), torch.nn.BatchNorm1d(8), torch.nn.Dropout(dropout), torch.nn.Linear(8, 1)
        )
        self.x = torch.randn(count, 2)
        self.count, self.noise, self.stop_at = count, noise, FOREVER
        self.seen = []

    def groups(self, rate):
        return [{"params": list(self.module.parameters()), "lr": 2 * rate}]

    def loss(self, rows, generator):
        if len(self.seen) >= self.stop_at:
            raise KeyboardInterrupt
        self.seen.append(rows.tolist())
        y = 2 * self.x[rows, 0] - self.x[rows, 1] + self.noise * torch.randn(len(rows), generator=generator)
        return ((self.module(self.x[rows])[:, 0] - y) ** 2).mean()

    def validate(self):
        assert not self.module.training
        return float(((self.module(self.x)[:, 0] - 2 * self.x[:, 0] + self.x[:, 1]) ** 2).mean())

    def weights(self):
        return {name: value.numpy().copy() for name, value in self.module.state_dict().items()}


OPTIONS = TrainingOptions("adamw", 1e-2, 1e-3, "cosine", batch=16, epochs=9)


def same(one, other):
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], name)


@pytest.mark.parametrize("stop_at", [1, 4, 6, 25])  # an epoch has 3 steps: before, between and within
def test_a_killed_training_goes_on_to_the_same_bits(tmp_path, stop_at):
    whole = Line()
    figures = train(whole, OPTIONS, 3)
    assert (figures["steps"], figures["epochs"]) == (27, 9)
    run = Run(tmp_path / "c.safetensors", resume=True, every=0.0)
    killed = Line()
    killed.stop_at = stop_at
    with pytest.raises(KeyboardInterrupt):
        train(killed, OPTIONS, 3, run)
    resumed = Line()
    assert train(resumed, OPTIONS, 3, run)["validation"] == figures["validation"]
    assert len(resumed.seen) == 27 - stop_at
    same(whole.weights(), resumed.weights())
    assert killed.seen + resumed.seen == whole.seen


def test_every_epoch_sees_every_row_once_in_another_order():
    line = Line()
    train(line, OPTIONS, 3)
    epochs = [[row for rows in line.seen[k : k + 3] for row in rows] for k in range(0, 27, 3)]
    assert all(sorted(rows) == list(range(40)) for rows in epochs)
    assert len({tuple(rows) for rows in epochs}) == 9


@settings(deadline=None)
@given(st.integers(1, 500), st.integers(0, 2**63 - 1), st.integers(1, 100))
def test_an_order_is_a_permutation_however_little_of_it_is_asked_for(count, seed, batch):
    whole = shuffled(0, count, count, seed)
    parts = [shuffled(k, min(k + batch, count), count, seed) for k in range(0, count, batch)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(np.sort(whole), np.arange(count))


def test_it_learns_and_the_seed_is_what_matters():
    one, again, other = (Line(dropout=0.0, noise=0.0) for _ in range(3))
    options = replace(OPTIONS, epochs=100)
    assert train(one, options, 3)["validation"] < 0.05
    train(again, options, 3)
    train(other, options, 4)
    same(one.weights(), again.weights())
    assert any((one.weights()[name] != value).any() for name, value in other.weights().items())


DOOMED = """
import sys, time
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from test_trainer import Line, OPTIONS
from fracsim.learning.trainer import Run, train
class Slow(Line):
    def loss(self, rows, generator):
        time.sleep(0.01)
        return super().loss(rows, generator)
train(Slow(), OPTIONS.__class__(**{**vars(OPTIONS), "epochs": 50}), 3, Run(Path(sys.argv[2]), every=0.0))
"""


def test_a_process_that_is_killed_leaves_a_checkpoint_to_go_on_from(tmp_path):
    path = tmp_path / "c.safetensors"
    process = subprocess.Popen([sys.executable, "-c", DOOMED, os.path.dirname(__file__), str(path)])
    end = time.monotonic() + 60
    while not path.exists() and time.monotonic() < end and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.2)
    process.kill()
    process.wait()
    options = replace(OPTIONS, epochs=50)
    whole, resumed = Line(), Line()
    train(whole, options, 3)
    train(resumed, options, 3, Run(path, resume=True))
    assert 0 < len(resumed.seen) < 150
    same(whole.weights(), resumed.weights())


def test_patience_stops_it_and_keeps_the_best_weights(tmp_path):
    class Worsening(Line):
        values = iter((5.0, 3.0, 4.0, 3.5, 6.0, 1.0))
        kept = None

        def validate(self):
            value = next(self.values)
            if value == 3.0:
                self.kept = self.weights()
            return value

    line = Worsening()
    figures = train(line, replace(OPTIONS, patience=2), 0)
    assert (figures["epochs"], figures["best_step"], figures["validation"]) == (4, 6, 3.0)
    same(line.kept, line.weights())


def test_time_can_be_the_budget():
    line = Line()
    begin = time.perf_counter()
    figures = train(line, replace(OPTIONS, epochs=None, seconds=0.4), 0)
    assert 0.4 <= time.perf_counter() - begin < 5.0
    assert figures["steps"] == len(line.seen) > 0


def test_a_checkpoint_that_cannot_be_written_is_a_model_error(tmp_path):
    with pytest.raises(ModelError, match="folder does not exist"):
        train(Line(), OPTIONS, 3, Run(tmp_path / "nowhere" / "c.safetensors", every=0.0))


def test_a_checkpoint_of_something_else_is_not_taken(tmp_path):
    path = tmp_path / "c.safetensors"
    train(Line(), OPTIONS, 3, Run(path, resume=True))
    for seed, options, label in ((4, OPTIONS, ""), (3, replace(OPTIONS, rate=1e-3), ""), (3, OPTIONS, "other data")):
        with pytest.raises(ModelError, match="another training"):
            train(Line(), options, seed, Run(path, resume=True, label=label))
    longer = Line()
    train(longer, replace(OPTIONS, epochs=10), 3, Run(path, resume=True))  # how long is not what
    assert len(longer.seen) == 3
    path.write_bytes(b"nonsense")
    with pytest.raises(ModelError, match="not a checkpoint"):
        train(Line(), OPTIONS, 3, Run(path, resume=True))
    train(Line(), OPTIONS, 3, Run(path))  # anew
    assert len(load_file(path)) > 0


def test_divergence_is_an_error_and_leaves_the_last_good_checkpoint(tmp_path):
    line = Line()
    path = tmp_path / "c.safetensors"
    train(line, OPTIONS, 0, Run(path))
    before = path.read_bytes()
    line.x[0] = float("nan")
    with pytest.raises(ModelError, match="not finite; lower the rate"):
        train(line, OPTIONS, 0, Run(path))
    assert path.read_bytes() == before


def test_tensorboard_gets_the_losses(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(Line(), OPTIONS, 0, Run(log=tmp_path))
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert [event.step for event in events.Scalars("validation")] == list(range(3, 28, 3))
    assert events.Scalars("training/loss")[0].value > 0


WORKER = """
import sys
sys.path.insert(0, sys.argv[1])
from safetensors.numpy import save_file
from test_trainer import Line, OPTIONS
from fracsim.learning.devices import rank
from fracsim.learning.trainer import Run, train
line = Line(dropout=0.0, noise=0.0)
line.module[1] = __import__("torch").nn.Identity()  # whose statistics would be of a share of the batch
figures = train(line, OPTIONS, 3, Run(__import__("pathlib").Path(sys.argv[2], "c.safetensors")))
assert figures["processes"] == 2 and max(map(len, line.seen)) == 8
save_file(line.weights(), f"{sys.argv[2]}/{rank()}.safetensors")
"""


def test_two_processes_share_the_batches_and_agree_with_one(tmp_path):
    (tmp_path / "worker.py").write_text(WORKER)
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [*launch, str(tmp_path / "worker.py"), os.path.dirname(__file__), str(tmp_path)], check=True, env=environment
    )
    one = Line(dropout=0.0, noise=0.0)
    one.module[1] = torch.nn.Identity()
    train(one, OPTIONS, 3)
    first, second = (load_file(tmp_path / f"{k}.safetensors") for k in range(2))
    same(first, second)
    for name, value in one.weights().items():
        np.testing.assert_allclose(first[name], value, atol=1e-5)
    assert (tmp_path / "c.safetensors").exists()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"optimiser": "sgd"}, "unknown optimiser 'sgd'; use one of adam, adamw"),
        ({"schedule": "x"}, "unknown schedule"),
        ({"rate": 0.0}, "rate must be finite and above 0"),
        ({"decay": -1.0}, "decay must be finite and at least 0"),
        ({"batch": 0}, "batch must be a whole number and at least 1"),
        ({"epochs": None}, "needs a budget; give one of epochs, steps, seconds"),
    ],
)
def test_bad_options_are_refused(change, fault):
    with pytest.raises(ModelError, match=fault):
        replace(OPTIONS, **change)


@pytest.mark.parametrize("change", [{"device": "tpu9"}, {"precision": "bf16", "device": "cpu"}, {"device": "cuda:99"}])
def test_what_this_machine_cannot_do_is_said(change):
    with pytest.raises(ModelError, match="device"):
        train(Line(), replace(OPTIONS, **change), 0)


@dataclass(frozen=True)
class Shape:
    width: int = 3
    scale: float = 1.0
    flag: bool = False
    name: str = "a"
    limit: int | None = None
    training: TrainingOptions = field(default_factory=lambda: TrainingOptions(epochs=5))


def test_options_come_from_text_by_their_types():
    got = options_from(
        Shape, {"width": "7", "scale": "1e-2", "flag": "true", "name": "b", "limit": "4", "decay": "0.1"}
    )
    assert got == Shape(7, 0.01, True, "b", 4, TrainingOptions(epochs=5, decay=0.1))
    assert options_from(Shape, {"limit": "none"}, {"steps": 8}).training == TrainingOptions(epochs=None, steps=8)


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ({"depth": "7"}, "unknown option 'depth'; there are width, scale, flag"),
        ({"width": "wide"}, "width must be of type int, got 'wide'"),
        ({"flag": "yes"}, "flag must be true or false"),
        ({"training": "x"}, "unknown option 'training'"),
    ],
)
def test_unknown_options_and_values_are_typed_errors(settings, fault):
    with pytest.raises(ModelError, match=fault):
        options_from(Shape, settings)


def test_the_loss_is_the_thesis_one_and_can_dwell_on_filled_cracks():
    truth, guess = torch.tensor([0.0, 0.0, 0.3]), torch.tensor([0.1, -0.1, 0.2])
    assert float(amae_loss(guess, truth)) == pytest.approx(amae(truth.numpy(), guess.numpy()))
    assert float(amae_loss(guess, truth, 4.0)) == pytest.approx((0.1 * 5 + 0.1 + 0.025) / 3)


def test_targets_are_the_true_fields(torus_dataset):
    with Dataset(torus_dataset) as dataset:
        body, samples = BodyGeometry.read(dataset)
    labels = samples.labels[:50]
    assert labels.any(axis=1).any()
    assert not labels.any(axis=1).all()
    truth = body.fields(labels, nodes=True)
    targets = Targets(body, labels, torch.device("cpu"), nodes=True)
    rows = torch.tensor([3, 0, 49, 3])
    np.testing.assert_array_equal(targets(rows).numpy(), truth[rows])
    columns = torch.randint(0, truth.shape[1], (4, 6), generator=torch.Generator().manual_seed(0))
    np.testing.assert_array_equal(targets(rows, columns).numpy(), np.take_along_axis(truth[rows], columns.numpy(), 1))


# The command


def command(dataset, tmp_path, *more):
    return [
        *("train", str(dataset), "--model", "mlp", "--set", "width=24", "--set", "layers=2", "--batch", "256"),
        *("--quiet", "--out", str(tmp_path / "m.safetensors"), *more),
    ]


def test_the_command_trains_saves_and_says_how_well(torus_dataset, tmp_path, capsys):
    more = ("--steps", "60", "--rate", "3e-3", "--json", str(tmp_path / "m.json"), "--log", str(tmp_path / "log"))
    assert main(command(torus_dataset, tmp_path, *more)) == 0
    assert "validation AMAE" in capsys.readouterr().out
    figures = json.loads((tmp_path / "m.json").read_text())
    with Dataset(torus_dataset) as dataset:
        body, samples = BodyGeometry.read(dataset)
    model, metadata = load_model(tmp_path / "m.safetensors", body)
    assert metadata == figures
    assert figures["training"]["steps"] == 60
    held_out = samples.of_split(1).take(slice(200))
    error = amae(body.fields(held_out.labels), model.predict(held_out.impacts))
    assert error == pytest.approx(figures["validation"]["amae"])
    assert any((tmp_path / "log").iterdir())


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        (("--set", "depth=3"), "unknown option 'depth'"),
        (("--set", "width"), "--set takes NAME=VALUE"),
        (("--model", "magic"), "unknown model 'magic'"),
        (("--model", "nearest"), "batch cannot be set"),
        (("--steps", "-1"), "steps must be a whole number"),
        (("--checkpoint", "/nowhere/c"), r"/nowhere/c: the folder .*does not exist"),
        (("--device", "cuda:99", "--steps", "1"), "device"),
    ],
)
def test_the_command_names_what_is_wrong(torus_dataset, tmp_path, capsys, more, fault):
    assert main(command(torus_dataset, tmp_path, *more)) == 2
    assert re.search(fault, capsys.readouterr().err)
    assert not (tmp_path / "m.safetensors").exists()


def test_an_interrupted_command_says_how_to_go_on_and_does(torus_dataset, tmp_path):
    checkpoint, log, figures = tmp_path / "c.safetensors", tmp_path / "log", tmp_path / "m.json"
    more = ("--checkpoint", str(checkpoint), "--log", str(log))
    process = subprocess.Popen(
        [sys.executable, "-m", "fracsim.cli", *command(torus_dataset, tmp_path, "--steps", str(FOREVER), *more)],
        stderr=subprocess.PIPE,
        text=True,
    )
    end = time.monotonic() + 60
    while not log.exists() and time.monotonic() < end and process.poll() is None:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "run the same command again to go on" in err
    with safe_open(checkpoint, "np") as file:
        reached = json.loads(file.metadata()["fracsim_checkpoint"])["step"]
    assert reached > 0
    assert not (tmp_path / "m.safetensors").exists()
    assert main(command(torus_dataset, tmp_path, "--steps", str(reached + 5), *more, "--json", str(figures))) == 0
    training = json.loads(figures.read_text())["training"]
    assert training["steps"] == reached + 5
    assert training["seconds"] > 0.3  # those of the first sitting are among them
