"""``fracsim tune``: what it writes, how it goes on after an interruption, and how it names what is wrong."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from fracsim.cli.main import main
from fracsim.solids.geodesics import CAP


def until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.02)


def command(dataset, out, *more):
    return [
        *("tune", str(dataset), "--model", "mlp", "--samples", "200", "--folds", "2", "--steps", "20"),
        *("--batch", "128", "--range", "width=8:32", "--range", "layers=1:2", "--quiet", "--out", str(out), *more),
    ]


def test_the_command_tunes_a_perceptron_goes_on_and_says_what_it_chose(torus_dataset, tmp_path, capsys):
    out, figures = tmp_path / "t", tmp_path / "t.json"
    assert main(command(torus_dataset, out, "--trials", "1")) == 0
    assert main(command(torus_dataset, out, "--trials", "3", "--json", str(figures))) == 0
    data = json.loads(figures.read_text())
    assert data == json.loads((out / "trials.json").read_text())
    assert [trial["state"] for trial in data["trials"]] == ["complete"] * 3
    for trial in data["trials"]:
        assert 0 < trial["amae"] < CAP
        assert 8 <= trial["parameters"]["width"] <= 32
    chosen = data["trials"][data["chosen"]]["parameters"]
    assert f"--set width={chosen['width']}" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"study.log", "trials.json", "pareto.png", "parallel.png"}


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        (("--model", "magic"), "unknown model 'magic'"),
        (("--range", "width"), "--range takes NAME=VALUE"),
        (("--range", "width=8:many"), "--range width takes LOW:HIGH"),
        (("--set", "depth=3"), "unknown option 'depth'"),
        (("--samples", "0"), "--samples must be at least 1"),
        (("--samples", "2"), "is empty; make more"),
        (("--folds", "9"), "there are 5 folds"),
        (("--trials", "-1"), "trials must be at least 0"),
        (("--trials", "0"), "no trial finished"),
        (("--storage", "/nowhere/j"), "the folder /nowhere does not exist; create it first"),
    ],
)
def test_the_command_names_what_is_wrong(torus_dataset, tmp_path, capsys, more, fault):
    assert main(command(torus_dataset, tmp_path / "t", *more)) == 2
    assert fault in capsys.readouterr().err


def test_an_interrupted_command_says_how_to_go_on(torus_dataset, tmp_path):
    out = tmp_path / "t"
    process = subprocess.Popen(
        [sys.executable, "-m", "fracsim.cli", *command(torus_dataset, out, "--trials", "99999")],
        stderr=subprocess.PIPE,
        text=True,
    )

    def held():
        name = f"{Path(torus_dataset).stem} mlp"
        storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(out / "study.log")))
        return optuna.load_study(study_name=name, storage=storage).get_trials(states=(TrialState.COMPLETE,))

    until(lambda: (out / "study.log").exists() and b"found" in (out / "study.log").read_bytes())
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "finished trials are kept; run the same command again to go on" in err
    kept = len(held())
    assert main(command(torus_dataset, out, "--trials", str(kept + 1))) == 0
    assert len(held()) == kept + 1
