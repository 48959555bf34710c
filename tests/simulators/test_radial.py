"""Radial cracks: true to their thresholds, longer the harder the impact, and fit to bake from."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import fracsim
from fracsim.data.samples import sample
from fracsim.fracture.rule import separated
from fracsim.learning.atoms import atoms_for, observe_fractures
from fracsim.simulators.base import Impacts
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.surface import read_surface, refine


@pytest.fixture(scope="module")
def radial():
    surface = refine(read_surface(trimesh.creation.box((1.0, 0.6, 0.3))))
    return make_simulator(surface, SimulatorOptions(name="radial", cells=900), 0)


def test_radial_cracks_break_from_their_threshold_on_into_connected_pieces(radial):
    drawn = sample(radial, 400, 0)
    np.testing.assert_array_equal(drawn.labels.any(axis=1), drawn.ratio >= 1)
    assert drawn.broken.shape == (400, 0)
    volumes, pairs = radial.cells.volumes, radial.interfaces.pairs
    for labels in drawn.labels[drawn.labels.any(axis=1)][:40]:
        share = np.bincount(labels, volumes) / volumes.sum()
        assert share.min() >= radial.min_piece_volume_fraction
        for piece in range(labels.max() + 1):
            inside = (labels[pairs] == piece).all(axis=1)
            reached, grown = np.flatnonzero(labels == piece)[:1], -1
            while grown != len(reached):
                grown = len(reached)
                touched = np.isin(pairs, reached).any(axis=1) & inside
                reached = np.union1d(reached, pairs[touched])
            assert len(reached) == (labels == piece).sum()


def test_radial_cracks_start_where_the_body_is_struck_and_run_further_the_harder(radial):
    points = radial.surface.trimesh
    face = int(np.argmax(points.triangles_center @ [0, 0, 1] - np.abs(points.triangles_center[:, 0])))
    impact = Impacts(
        np.full((2, 1), face), np.full((2, 1, 3), 1 / 3), np.tile([[[0.0, 0.0, -1.0]]], (2, 1, 1)), np.ones((2, 1))
    )
    factor = radial.thresholds(impact) * np.array([1.01, 3.0])
    labels = radial.fracture(impact.times(factor)).labels
    where = points.triangles_center[face]
    parted = separated(labels, radial.interfaces.pairs)
    middle = radial.cells.centroids[radial.interfaces.pairs].mean(axis=1)
    reach = [np.linalg.norm(middle[row] - where, axis=1) for row in parted]
    assert reach[0].min() < 0.15
    assert reach[0].max() < 0.4 < reach[1].max()
    assert labels[1].max() > labels[0].max()


def test_atoms_seen_in_fractures_say_again_what_these_said(radial):
    built = atoms_for(radial, observe_fractures(radial, 0), 1e-3)
    assert not built.are_the_simulators
    assert 20 < len(built.solid.volumes) <= 150
    assert built.solid.volumes.sum() == pytest.approx(radial.cells.volumes.sum(), rel=1e-12)
    drawn = sample(radial, 400, 1)
    projected = built.project(drawn)
    assert projected.labels.shape == (400, len(built.solid.volumes))
    np.testing.assert_array_equal(projected.broken, separated(projected.labels, built.interfaces.pairs))
    count = len(radial.surface.vertices)
    free, blocks = radial.cells.vertex_cells(count), built.solid.vertex_cells(count)
    broke = drawn.labels.any(axis=1)
    scores = [
        fracsim.metrics.ari(a[free], b[blocks])
        for a, b in zip(drawn.labels[broke], projected.labels[broke], strict=True)
    ]
    assert np.mean(scores) > 0.6


def test_another_simulator_bakes_into_an_asset_that_breaks_and_names_its_simulator(crate, tmp_path):
    assert crate.metadata["simulator"] == "radial"
    assert crate.metadata["test"]["ari_of_the_atoms"] > 0.3
    assert crate.metadata["test"]["balanced_accuracy"] > 0.7
    path = tmp_path / "radial.frac"
    crate.save(path)
    again = fracsim.load(path)
    assert again.baked_from == crate.baked_from
    impulses = again.sample_impulses(40, 0)
    pieces = [len(again.fracture(impulse).pieces) for impulse in impulses]
    assert max(pieces) > 1 == min(pieces)
    weak = fracsim.Impulse(impulses[0].point, impulses[0].direction, 0.5 * float(again.breaking_impulse[0]))
    assert not again.may_break(weak)
    with pytest.raises(fracsim.FracsimError, match="that it does not carry"):
        again.fracture(impulses[0], predictor="modes")
