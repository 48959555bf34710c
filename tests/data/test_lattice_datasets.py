"""Datasets of the lattice simulators: the same bits again, from the file and in other processes."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import trimesh

from fracsim.common.material import as_material
from fracsim.data.dataset import Dataset
from fracsim.data.impacts import draw_impacts
from fracsim.data.writing import make_dataset, regenerate
from fracsim.simulators.capabilities import reference_factors
from fracsim.simulators.registry import make_simulator, options_for_body
from fracsim.solids.surface import read_surface, refine

BLOCK = 8  # samples, instead of 400, which take half a minute


@pytest.fixture(scope="module")
def surface():
    return refine(read_surface(trimesh.creation.box((0.3, 0.2, 0.03))))


@pytest.mark.parametrize("name", ["structural", "sequential"])
def test_a_lattice_makes_a_dataset_that_is_gone_on_with_and_made_again(name, surface, tmp_path, monkeypatch):
    for module in ("samples", "writing"):
        monkeypatch.setattr(f"fracsim.data.{module}.BLOCK", BLOCK)
    monkeypatch.setattr("fracsim.data.repeatability.IMPACTS", 10)
    options = options_for_body(name, as_material("glass"), 0.3, cells=60)
    made = tmp_path / "made.h5"
    make_dataset(made, surface, BLOCK, 2, options)
    make_dataset(made, surface, 2 * BLOCK, 2, options)  # goes on from the file
    with Dataset(made) as dataset:
        assert dataset.header["simulator"] == {**dataset.header["simulator"], "name": name, "cells": 60}
        assert (dataset.severity_kind, dataset.header["ratio_to"]) == ("force", "first crack")
        assert dataset.header["repeatability"]["impacts"] > 0
        drawn, simulator = dataset.samples(), dataset.simulator
    assert drawn.labels.any()
    broke = drawn.labels.any(axis=1)
    assert (drawn.ratio[broke] >= 1.0 - 1e-9).all()  # nothing breaks before its first crack
    np.testing.assert_array_equal(simulator.fracture(drawn.impacts).labels, drawn.labels)
    again = tmp_path / "again.h5"
    regenerate(made, again)
    with Dataset(again) as dataset:
        for key, values in vars(dataset.samples()).items():
            np.testing.assert_array_equal(values, getattr(drawn, key))


@pytest.mark.parametrize("name", ["structural", "sequential"])
def test_a_lattice_that_has_answered_goes_to_other_processes_and_answers_the_same(name, surface):
    simulator = make_simulator(surface, options_for_body(name, as_material("glass"), 0.3, cells=60), 0)
    impacts, _ = draw_impacts(surface, 6, np.random.default_rng(0))
    hard = impacts.times(3.0 * reference_factors(simulator, impacts))
    labels = simulator.fracture(hard).labels
    copy = pickle.loads(pickle.dumps(simulator))
    np.testing.assert_array_equal(copy.fracture(hard).labels, labels)
    np.testing.assert_array_equal(reference_factors(copy, impacts), reference_factors(simulator, impacts))
    np.testing.assert_array_equal(copy.compliance, simulator.compliance)
