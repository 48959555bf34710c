"""A model of the user's own goes through every command by its name; names and classes that do not fit are refused."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import trimesh

import fracsim
from fracsim import learning
from fracsim.cli.main import main
from fracsim.data.dataset import Dataset
from fracsim.learning.body import BodyGeometry
from fracsim.learning.model import Model, load_model, save_model
from fracsim.learning.options import training_of
from fracsim.learning.search import Range


@dataclass(frozen=True)
class MeanOptions:
    factor: float = 1.0


class MeanField(Model):
    """Answers every impact with the mean field of the training samples, times a factor."""

    kind = "mean_field"
    options_type = MeanOptions
    search_space: ClassVar[Mapping[str, Range]] = {"factor": Range(0.5, 1.5)}

    def __init__(self, body, field):
        self.body, self.field = body, field

    @classmethod
    def fit(cls, body, samples, options, seed, run=None):
        field = body.fields(samples.of_split(0).labels).mean(axis=0) * np.float32(options.factor)
        return cls(body, field), {"factor": options.factor}

    def predict(self, impacts):
        return np.repeat(self.field[None], len(impacts), axis=0)

    def state(self):
        return {"field": self.field}, {}

    @classmethod
    def restore(cls, body, arrays, numbers):
        return cls(body, arrays["field"])


@pytest.fixture
def registered():
    fracsim.register_model("mean_field", MeanField)
    yield
    del learning.MODELS["mean_field"]


def test_a_registered_model_is_trained_saved_and_read(registered, torus_dataset, tmp_path):
    out = tmp_path / "m.safetensors"
    command = ["train", str(torus_dataset), "--model", "mean_field", "--set", "factor=0.5", "--quiet"]
    assert main([*command, "--out", str(out), "--json", str(tmp_path / "m.json")]) == 0
    with Dataset(torus_dataset) as dataset:
        body, samples = BodyGeometry.read(dataset)
    model, metadata = load_model(out, body)
    assert isinstance(model, MeanField)
    assert metadata["options"] == {"factor": 0.5}
    expected = 0.5 * body.fields(samples.of_split(0).labels).mean(axis=0)
    np.testing.assert_allclose(model.predict(samples.take(slice(2)).impacts), [expected, expected], rtol=1e-6)
    assert json.loads((tmp_path / "m.json").read_text())["training"] == {"factor": 0.5}


def test_a_fault_in_a_models_own_code_is_not_called_a_damaged_file(registered, torus_dataset, tmp_path, monkeypatch):
    with Dataset(torus_dataset) as dataset:
        body, samples = BodyGeometry.read(dataset)
    path = tmp_path / "m.safetensors"
    save_model(MeanField.fit(body, samples, MeanOptions(), 0)[0], path)

    def slip(cls, body, arrays, numbers):
        raise TypeError("a slip")

    monkeypatch.setattr(MeanField, "restore", classmethod(slip))
    with pytest.raises(TypeError, match="a slip"):
        load_model(path, body)
    monkeypatch.setattr(MeanField, "restore", classmethod(lambda cls, body, arrays, numbers: numbers["factor"]))
    with pytest.raises(fracsim.ModelError, match=r"m\.safetensors: .*there is no entry 'factor'"):
        load_model(path, body)


def test_a_registered_model_is_tuned_in_its_own_search_space(registered, torus_dataset, tmp_path):
    pytest.importorskip("optuna")
    out = tmp_path / "tuned"
    command = ["tune", str(torus_dataset), "--model", "mean_field", "--samples", "120", "--folds", "2", "--quiet"]
    assert main([*command, "--trials", "3", "--out", str(out)]) == 0
    summary = json.loads((out / "trials.json").read_text())
    factors = [trial["parameters"]["factor"] for trial in summary["trials"]]
    assert len(set(factors)) == 3
    assert all(0.5 <= factor <= 1.5 for factor in factors)
    assert summary["counts"]["finished"] == 3


PLAN = """
[simulator]
cells = 300
modes = 4

[[meshes]]
name = "ring"
file = "ring.obj"
samples = 400
tested = 8
slow = 4
timed = 1

[[models]]
name = "mean"
kind = "mean_field"
options = { factor = 0.9 }
"""


def test_a_registered_model_is_evaluated_by_a_plan(registered, tmp_path):
    pytest.importorskip("matplotlib")
    trimesh.creation.torus(0.5, 0.2, major_sections=20, minor_sections=10).export(tmp_path / "ring.obj")
    (tmp_path / "plan.toml").write_text(PLAN)
    found = tmp_path / "found.json"
    command = ["evaluate", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "out"), "--json", str(found), "--quiet"]
    assert main(command) == 0
    figures = json.loads(found.read_text())
    assert figures["missing"] == []
    assert {row["model"] for row in figures["rows"]} == {"mean"}
    segmentations = {row["segmentation"] for row in figures["rows"]}
    assert "watershed" in segmentations
    # It answers with fields at the vertices only.
    assert not segmentations & {"none: labels", "midpoints and links"}
    assert all(row["impulses"] <= 8 for row in figures["rows"])


def test_a_name_that_is_taken_or_a_class_that_lacks_something_is_refused(registered):
    with pytest.raises(fracsim.ModelError, match="the model name 'mlp' is taken"):
        fracsim.register_model("mlp", MeanField)
    with pytest.raises(fracsim.ModelError, match="its kind is 'mean_field'"):
        fracsim.register_model("other", MeanField)

    class Bare:
        kind = "bare"
        options_type = MeanOptions

    with pytest.raises(fracsim.ModelError, match="Bare: lacks search_space, cost, slow"):
        fracsim.register_model("bare", Bare)
    assert "bare" not in learning.MODELS


def test_a_class_can_be_registered_by_its_place_and_is_imported_when_it_is_used(monkeypatch):
    monkeypatch.setattr(learning, "MODELS", {})
    fracsim.register_model("mean_field", f"{__name__}:MeanField")
    assert learning.model_class("mean_field") is MeanField
    fracsim.register_model("elsewhere", f"{__name__}:Nothing")
    with pytest.raises(fracsim.ModelError, match=r"'elsewhere': .*has no class 'Nothing'"):
        learning.model_class("elsewhere")
    fracsim.register_model("other", f"{__name__}:MeanField")
    with pytest.raises(fracsim.ModelError, match="its kind is 'mean_field'"):
        learning.model_class("other")


def test_every_model_of_the_package_carries_what_is_looked_up():
    for name in learning.MODELS:
        cls = learning.model_class(name)
        assert all(hasattr(cls, attribute) for attribute in learning.REQUIRED), name
        assert cls.kind == name
        options = cls.options_type()
        known = set(vars(options)) | (set(vars(options.training)) if training_of(options) else set())
        assert set(cls.search_space) <= known
