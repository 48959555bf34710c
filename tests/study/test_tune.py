"""Tuning: folds without test samples, studies that survive killed processes, and the choice of the thesis."""

from __future__ import annotations

import json
import math
import platform
import signal
import subprocess
import sys
import time
import types
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import fracsim
from fracsim import learning
from fracsim.common.errors import FieldError, ModelError
from fracsim.data.dataset import Dataset
from fracsim.data.samples import FOLDS
from fracsim.learning.body import BodyGeometry
from fracsim.learning.model import Model
from fracsim.learning.search import Range
from fracsim.metrics import amae
from fracsim.segmentation import METHODS
from fracsim.study import optuna_study, tune
from fracsim.study.optuna_study import open_study
from fracsim.study.search_space import Search, search_space
from fracsim.study.tune import fold_of
from fracsim.study.tune_figures import importance_chart, parallel_chart, pareto_chart, write_figures
from fracsim.study.tune_summary import summary


@dataclass(frozen=True)
class FakeOptions:
    """What a fit does: its error falls with ``size``, ``cost`` is slept through in a query, and it may go wrong."""

    size: int = 1
    cost: float = 0.0
    wait: float = 0.0


class Fake(Model):
    """Answers with the truth, which it finds by its impacts, and an error of 0.1 / size."""

    kind = "fake"
    options_type = FakeOptions
    search_space: ClassVar[dict[str, Range]] = {"size": Range(1, 12), "cost": Range(0.0, 1e-4)}
    fitted: ClassVar[list[types.SimpleNamespace]] = []
    faults: ClassVar[dict[int, Exception | type[BaseException]]] = {}

    def __init__(self, body, samples, options):
        self.body, self.options = body, options
        truth = body.fields(samples.labels)
        self.known = {row.tobytes(): field for row, field in zip(samples.impacts.severities, truth, strict=True)}

    @classmethod
    def fit(cls, body, samples, options, seed, run):
        cls.fitted.append(types.SimpleNamespace(samples=samples, options=options, seed=seed))
        if options.size in cls.faults:
            raise cls.faults[options.size]
        time.sleep(options.wait)
        run.progress(1.0)
        return cls(body, samples, options), {}

    def predict(self, impacts):
        time.sleep(self.options.cost)
        fields = np.array([self.known[row.tobytes()] for row in impacts.severities])
        return np.full_like(fields, np.nan) if self.options.size == 13 else fields + np.float32(0.1 / self.options.size)


SPACE = Fake.search_space


def install(patch_item):
    """Make the fake one of the models."""
    patch_item(learning.MODELS, "fake", Fake)


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    install(monkeypatch.setitem)
    monkeypatch.setattr(Fake, "fitted", [])
    monkeypatch.setattr(Fake, "faults", {})
    return Fake


@pytest.fixture(scope="module")
def data(torus_dataset):
    with Dataset(torus_dataset) as dataset:
        body, samples = BodyGeometry.read(dataset)
    return body, samples.take(slice(200))


@pytest.fixture
def study(tmp_path):
    return open_study(str(tmp_path / "study.log"), "s", SEARCH)


SEARCH = Search("fake", FakeOptions(), SPACE, folds=2)


def go(data, study, trials, search=SEARCH, **more):
    tune.tune(search, *data, study, trials, **more)
    return summary(study, search)


# Folds and figures


def test_a_study_is_measured_with_one_registered_segmentation(data, study):
    asked = []

    def whole(graph, udf, parameter):
        asked.append(parameter)
        return np.zeros(len(graph), dtype=np.int64)

    fracsim.register_segmentation("whole", whole, 0.5)
    try:
        found = go(data, study, 1, segmentation="whole")
        assert found["segmentation"] == "whole"
        assert asked == [0.5] * len(asked)
        assert found["trials"][0]["ari"] == 0.0  # of one piece, against several
        with pytest.raises(ModelError, match="has trials with segmentation 'whole', not 'watershed'"):
            go(data, study, 2)
    finally:
        del METHODS["whole"]
    with pytest.raises(FieldError, match="unknown segmentation 'whole'"):
        go(data, study, 2, segmentation="whole")


def test_folds_never_hold_a_test_sample_and_validate_each_other_one_once(data):
    _, samples = data
    marked = samples.severities.sum(axis=1)
    test = set(marked[samples.split == 2])
    seen = []
    for fold in range(FOLDS):
        part = fold_of(samples, fold)
        train, validation = (part.of_split(k).severities.sum(axis=1) for k in (0, 1))
        assert len(train) + len(validation) == len(part) == (samples.fold >= 0).sum()
        assert test.isdisjoint(train)
        assert test.isdisjoint(validation)
        assert set(train).isdisjoint(validation)
        seen += list(validation)
    assert sorted(seen) == sorted(marked[samples.split != 2])


def test_a_trial_is_the_mean_over_its_folds_and_the_median_of_single_queries(data, study):
    found = go(data, study, 1)
    (trial,) = found["trials"]
    body, samples = data
    assert [f.seed for f in Fake.fitted] == [0, 0]
    for k, (fit, error) in enumerate(zip(Fake.fitted, trial["folds"], strict=True)):
        assert fit.options == FakeOptions(**trial["parameters"])
        held_out = samples.take(samples.fold == k)
        np.testing.assert_array_equal(fit.samples.of_split(1).severities, held_out.severities)
        truth = body.fields(held_out.labels)
        assert error == pytest.approx(amae(truth, truth + np.float32(0.1 / fit.options.size)), rel=1e-5)
    assert trial["amae"] == pytest.approx(np.mean(trial["folds"]))
    assert trial["mse"] == pytest.approx((0.1 / trial["parameters"]["size"]) ** 2, rel=1e-4)
    assert trial["parameters"]["cost"] < trial["seconds"] < trial["parameters"]["cost"] + 0.01
    assert -1 <= trial["ari"] <= 1
    assert trial["bc"] >= 0
    assert study.trials[0].values == [trial["amae"], trial["seconds"]]


def test_the_search_finds_the_best_size_and_marks_the_front_and_the_choice_of_the_thesis(data, study, tmp_path):
    search = Search("fake", FakeOptions(), SPACE, folds=1)
    found = go(data, study, 24, search, population=6)
    trials = found["trials"]
    assert len(trials) == found["counts"]["finished"] == 24
    assert min(t["amae"] for t in trials) == min(t["amae"] for t in trials if t["front"])
    for trial in trials:
        figures = trial["amae"], trial["seconds"]
        others = {(t["amae"], t["seconds"]) for t in trials} - {figures}
        assert trial["front"] != any(amae <= figures[0] and seconds <= figures[1] for amae, seconds in others)
    cost = {t["number"]: math.sqrt(t["seconds"] ** 2 + 3 * t["amae"] ** 2) for t in trials}
    assert found["chosen"] == min(cost, key=cost.get)
    assert len({t["parameters"]["cost"] for t in trials}) > 12  # values are drawn anew, not repeated
    assert max(found["importances"]["amae"], key=found["importances"]["amae"].get) == "size"
    assert sum(found["importances"]["seconds"].values()) == pytest.approx(1)
    paths = write_figures(found, tmp_path)
    assert [path.name for path in paths] == ["trials.json", "pareto.png", "parallel.png", "importances.png"]
    assert json.loads(paths[0].read_text()) == found
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths[1:])
    check_charts(found)


def check_charts(found):
    """The charts show every trial, the choice and the importances of a study."""
    trials, chosen = found["trials"], found["trials"][found["chosen"]]
    axes = pareto_chart(found).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time of a query, ms", "AMAE, mean over the folds")
    lines = {line.get_label().split(":")[0]: line.get_xydata() for line in axes.lines}
    points = np.vstack([lines["dominated trials"], lines["Pareto front"]])
    expected = [(trial["seconds"] * 1e3, trial["amae"]) for trial in trials]
    np.testing.assert_allclose(sorted(points.tolist()), sorted(expected))
    assert len(lines["Pareto front"]) == sum(trial["front"] for trial in trials)
    np.testing.assert_allclose(lines["chosen"], [[chosen["seconds"] * 1e3, chosen["amae"]]])

    axes = parallel_chart(found).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["AMAE", "size", "cost"]
    lines = [line for line in axes.lines if len(line.get_xdata()) == 3]
    assert len(lines) == len(trials)
    bold = next(line for line in lines if line.get_label() == "chosen")
    sizes = (chosen["parameters"]["size"] - 1) / (12 - 1), chosen["parameters"]["cost"] / 1e-4
    np.testing.assert_allclose(bold.get_ydata()[1:], sizes)

    axes = importance_chart(found).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["size", "cost"]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    bars = dict(zip(labels, axes.containers, strict=True))
    widths = [bar.get_width() for bar in bars["AMAE"]]
    np.testing.assert_allclose(widths, [found["importances"]["amae"][name] for name in ("size", "cost")])


def test_one_seed_draws_one_first_generation(data, tmp_path):
    def drawn(name, seed):
        search = Search("fake", FakeOptions(), SPACE, folds=1, seed=seed)
        found = go(data, open_study(str(tmp_path / name), "s", search), 3, search)
        return [trial["parameters"] for trial in found["trials"]]

    assert drawn("a", 1) == drawn("b", 1)
    assert drawn("c", 1) != drawn("d", 2)


# Faults


def test_a_fit_that_fails_is_a_failed_trial_and_counts(data, study):
    Fake.faults = dict.fromkeys(range(1, 7), ModelError("training diverged"))
    found = go(data, study, 8, Search("fake", FakeOptions(), SPACE, folds=1))
    for trial in found["trials"]:
        diverged = trial["parameters"]["size"] < 7
        assert trial["state"] == ("fail" if diverged else "complete")
        assert ("amae" in trial) != diverged
        assert trial.get("fault") == ("ModelError: training diverged" if diverged else None)
    assert found["counts"]["failed"] > 0
    assert found["counts"]["finished"] == 8 - found["counts"]["failed"] > 0


def test_answers_that_are_not_finite_fail_the_trial(data, tmp_path):
    search = Search("fake", FakeOptions(), {"size": Range(13, 13)}, folds=1)
    found = go(data, open_study(str(tmp_path / "j"), "s", search), 2, search)
    assert found["chosen"] is None
    assert found["counts"] == {"finished": 0, "failed": 2, "interrupted": 0, "under way": 0}
    assert "finite" in found["trials"][0]["fault"]
    assert [path.name for path in write_figures(found, tmp_path)] == ["trials.json"]


def test_a_fault_of_the_program_is_recorded_and_raised(data, study):
    Fake.faults = dict.fromkeys(range(1, 13), TypeError("a slip"))
    with pytest.raises(TypeError, match="a slip"):
        go(data, study, 3)
    assert [t.user_attrs["fault"] for t in study.trials] == ["TypeError: a slip"]


def test_an_interrupted_trial_is_tried_again_and_does_not_count(data, study):
    go(data, study, 1)
    Fake.faults = dict.fromkeys(range(1, 13), KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        go(data, study, 3)
    Fake.faults = {}
    found = go(data, study, 3)
    assert [t["state"] for t in found["trials"]] == ["complete", "fail", "complete", "complete"]
    assert found["trials"][2]["parameters"] == found["trials"][1]["parameters"]
    assert found["counts"]["interrupted"] == 1


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: search_space("modes"), "unknown model 'modes'"),
        (lambda: search_space("mlp", {"depth": "1:2"}), "'depth' is not sought; mlp has width, layers"),
        (lambda: search_space("mlp", {"width": "1.5:2"}), "whole numbers, got '1.5:2'"),
        (lambda: search_space("mlp", {"width": "9:2"}), "do not fall"),
        (lambda: Range(0.0, 1.0, log=True), "above 0"),
        (lambda: Search("fake", FakeOptions(), SPACE, folds=6), "there are 5 folds"),
        (lambda: Search("fake", FakeOptions(), SPACE, seed=-1), "seed"),
        (
            lambda: Search("fake", FakeOptions(), {"depth": Range(1, 2)}),
            "unknown option 'depth'",
        ),
    ],
)
def test_what_cannot_be_sought_is_refused(make, fault):
    with pytest.raises(ModelError, match=fault):
        make()


def test_every_space_fits_the_options_of_its_model():
    for kind in learning.MODELS:
        if kind != "fake":
            options = learning.model_class(kind).options_type()
            search = Search(kind, options, search_space(kind))
            high = search.with_values({name: ends.high for name, ends in search.ranges.items()})
            assert high != options
    assert search_space("mlp", {"width": "64", "layers": "2:3"}) == {"width": Range(64, 64), "layers": Range(2, 3)}


def test_an_empty_fold_is_refused_before_anything_is_fitted(data, study):
    body, samples = data
    with pytest.raises(ModelError, match="fold 0 is empty"):
        go((body, samples.take(samples.fold != 0)), study, 1)
    assert not Fake.fitted
    assert not study.trials


# Studies


def test_a_study_is_not_mixed_with_one_about_something_else(tmp_path):
    storage = str(tmp_path / "j")
    open_study(storage, "s", SEARCH)
    assert not open_study(storage, "s", SEARCH).trials
    with pytest.raises(ModelError, match="folds was 2"):
        open_study(storage, "s", Search("fake", FakeOptions(), SPACE, folds=3))
    open_study(storage, "other", Search("fake", FakeOptions(), SPACE, folds=3))


def test_a_database_does_as_well(data, tmp_path):
    url = f"sqlite:///{tmp_path / 'study.db'}"
    go(data, open_study(url, "s", SEARCH), 1)
    assert len(go(data, open_study(url, "s", SEARCH), 2)["trials"]) == 2


@pytest.mark.parametrize(
    ("storage", "fault"),
    [
        ("postgresql://me:secret@127.0.0.1:1/x", "the database of the study cannot be opened"),
        ("/nowhere/j", "create the folder first"),
    ],
)
def test_a_storage_that_is_not_there_is_a_typed_error(storage, fault):
    with pytest.raises(ModelError, match=fault) as caught:
        open_study(storage, "s", SEARCH)
    assert "secret" not in str(caught.value)


def test_a_file_of_another_kind_is_left_as_it_is(tmp_path):
    for data in (b"\x89HDF\r\n\x1a\n no lines", b'{"a": 1}\n', b"{not json}\n{}\n"):
        (tmp_path / "j").write_bytes(data)
        with pytest.raises(ModelError, match="not a journal of a study"):
            open_study(str(tmp_path / "j"), "s", SEARCH)
        assert (tmp_path / "j").read_bytes() == data


def test_a_journal_that_was_cut_short_goes_on(data, tmp_path):
    path = tmp_path / "j"
    go(data, open_study(str(path), "s", SEARCH), 1)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"op_code":4,"wor')
    found = go(data, open_study(str(path), "s", SEARCH), 2)
    assert found["counts"]["finished"] == 2
    assert path.read_bytes().startswith(whole)


WORKER = """
import sys
sys.path.insert(0, sys.argv[1])
import test_tune
from fracsim.study.optuna_study import open_study
data = test_tune.read(sys.argv[2])
test_tune.install(dict.__setitem__)
print("ready", flush=True)
test_tune.go(data, open_study(sys.argv[3], "s", test_tune.slow(float(sys.argv[5]))), int(sys.argv[4]))
"""


def read(path):
    with Dataset(path) as dataset:
        body, samples = BodyGeometry.read(dataset)
    return body, samples.take(slice(200))


def slow(wait):
    return Search("fake", FakeOptions(wait=wait), SPACE, folds=1)


def worker(tmp_path, dataset, trials, wait):
    (tmp_path / "worker.py").write_text(WORKER)
    arguments = [Path(__file__).parent, dataset, tmp_path / "j", trials, wait]
    return subprocess.Popen([sys.executable, tmp_path / "worker.py", *map(str, arguments)], stdout=subprocess.PIPE)


def until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.02)


def test_two_processes_share_a_study_and_one_takes_over_what_the_other_was_killed_at(torus_dataset, tmp_path):
    search = slow(0.6)
    study = open_study(str(tmp_path / "j"), "s", search)
    workers = [worker(tmp_path, torus_dataset, 6, 0.6) for _ in range(2)]

    def begun(process):
        """Whether it has a trial well before its end."""
        mine = [t for t in study.trials if t.user_attrs.get("process") == optuna_study.process_name(str(process.pid))]
        return (
            mine and mine[-1].params.keys() == SPACE.keys() and time.time() < mine[-1].datetime_start.timestamp() + 0.3
        )

    until(lambda: begun(workers[1]))
    until(lambda: begun(workers[0]))
    workers[0].send_signal(signal.SIGKILL)
    workers[0].wait()
    assert workers[1].wait(120) == 0
    found = summary(study, search)
    assert 6 <= found["counts"]["finished"] <= 7
    assert len(found["trials"]) == found["counts"]["finished"] + 1
    assert found["counts"]["interrupted"] == 1
    (dead,) = (trial for trial in found["trials"] if trial["state"] == "fail")
    again = [t["parameters"] for t in found["trials"] if t["state"] == "complete"]
    assert again.count(dead["parameters"]) == 1
    assert len({t["cost"] for t in again}) == len(again)
    assert len({trial.user_attrs["process"] for trial in study.trials}) == 2


def test_a_trial_that_kills_its_process_again_is_given_up(data, study):
    def killed():
        trial = study.ask()
        trial.set_user_attr("process", f"{platform.node()}:{2**31}:1")
        return {name: ends.suggest(trial, name) for name, ends in SPACE.items()}

    first = killed()
    optuna_study.give_up_lost_trials(study)
    assert killed() == first
    found = go(data, study, 3)
    assert [trial["state"] for trial in found["trials"]] == ["fail"] * 2 + ["complete"] * 3
    assert first not in [trial["parameters"] for trial in found["trials"][2:]]
    assert found["counts"] == {"finished": 3, "failed": 0, "interrupted": 2, "under way": 0}


def test_a_trial_under_way_elsewhere_is_left_alone(data, study):
    elsewhere = study.ask()
    elsewhere.set_user_attr("process", "another-machine:1:2")
    found = go(data, study, 2)
    assert found["counts"] == {"finished": 2, "failed": 0, "interrupted": 0, "under way": 1}


def test_a_trial_under_way_here_is_not_started_twice(data, study):
    other = study.ask()
    other.set_user_attr("process", optuna_study.process_name("self"))
    found = go(data, study, 2)
    assert found["counts"] == {"finished": 1, "failed": 0, "interrupted": 0, "under way": 1}
