"""The structural simulator: rods snap, answers follow from force alone, repeat themselves, and outlive a file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fracsim.common.errors import BakeError
from fracsim.common.material import PRESETS
from fracsim.simulators.base import Impacts, interfaces_between
from fracsim.simulators.elastic import single_impacts
from fracsim.simulators.registry import make_simulator, options_for, options_for_body
from fracsim.simulators.structural import StructuralOptions, StructuralSimulator, group_cells
from fracsim.solids.solid import shared_faces
from fracsim.solids.surface import read_surface, refine


@pytest.fixture(scope="module")
def rod():
    """A rod 12 times as long as it is thick, along z, of 0.2 m of ceramic."""
    mesh = trimesh.creation.cylinder(0.2 / 24, 0.2, sections=16).subdivide_to_size(0.02)
    surface = refine(read_surface(mesh))
    return make_simulator(surface, options_for_body("structural", PRESETS["ceramic"], 0.2, cells=150), 0)


@pytest.fixture(scope="module")
def slab():
    surface = refine(read_surface(trimesh.creation.box((0.3, 0.2, 0.03))))
    return make_simulator(surface, options_for_body("structural", PRESETS["glass"], 0.3, cells=120, atoms=20), 1)


def across(simulator, height):
    """An impact on the side of a rod, at a share of its length."""
    centers = simulator.surface.trimesh.triangles_center
    normals = simulator.surface.trimesh.face_normals
    beside = np.abs(normals[:, 2]) < 0.1
    z = centers[:, 2] - simulator.surface.vertices[:, 2].min()
    face = int(np.argmin(np.abs(z / np.ptp(simulator.surface.vertices[:, 2]) - height) + ~beside))
    return Impacts(np.array([[face]]), np.full((1, 1, 3), 1 / 3), -normals[face][None, None], np.ones((1, 1)))


def shares(simulator, labels):
    volumes = simulator.cells.volumes
    return np.sort(np.bincount(labels, volumes) / volumes.sum())[::-1]


def test_a_rod_that_is_hit_in_its_middle_snaps_in_two(rod):
    impact = across(rod, 0.5)
    threshold = rod.thresholds(impact)
    assert not rod.fracture(impact.times(0.98 * threshold)).labels.any()
    parts = shares(rod, rod.fracture(impact.times(1.1 * threshold)).labels[0])
    large = parts[parts > 0.05]
    assert len(large) == 2
    assert ((large > 0.4) & (large < 0.6)).all()
    for factor in (2.0, 4.0):
        assert (shares(rod, rod.fracture(impact.times(factor * threshold)).labels[0]) > 0.01).sum() >= 2


def test_a_rod_that_is_hit_nearer_its_end_breaks_nearer_that_end(rod):
    impact = across(rod, 0.25)
    labels = rod.fracture(impact.times(1.1 * rod.thresholds(impact))).labels[0]
    parts = shares(rod, labels)
    assert 0.6 < parts[0] < 0.85
    low = rod.cells.centroids[labels != np.argmax(np.bincount(labels, rod.cells.volumes)), 2].mean()
    assert low < 0.0


def test_nothing_breaks_before_a_first_crack(slab):
    impacts = single_impacts(slab.surface, 20, np.random.default_rng(0))
    first = slab.first_crack(impacts)
    response = slab.fracture(impacts.times(0.999 * first))
    assert not response.labels.any()
    assert not response.broken.any()
    np.testing.assert_allclose(slab.stiffness_left(impacts.times(0.999 * first)), 1.0, rtol=1e-12)
    assert (slab.thresholds(impacts.times(first)) >= 1.0 - 1e-12).all()


def test_pieces_are_connected_and_not_too_small_and_grow_in_number(slab):
    impacts = single_impacts(slab.surface, 12, np.random.default_rng(1))
    first = slab.first_crack(impacts)
    counts = []
    for factor in (1.0, 2.0, 6.0):
        response = slab.fracture(impacts.times(factor * first))
        for labels, broken in zip(response.labels, response.broken, strict=True):
            if labels.any():
                assert shares(slab, labels).min() >= slab.min_piece_volume_fraction
            pairs = slab.interfaces.pairs
            np.testing.assert_array_equal(broken, labels[pairs[:, 0]] != labels[pairs[:, 1]])
            for piece in range(labels.max() + 1):
                inside = pairs[(labels[pairs] == piece).all(axis=1)]
                reached, size = {int(np.argmax(labels == piece))}, 0
                while size != len(reached):
                    size = len(reached)
                    reached |= {int(c) for pair in inside if reached & set(pair.tolist()) for c in pair}
                assert len(reached) == (labels == piece).sum()
        counts.append(response.labels.max(axis=1).mean())
    assert counts[0] < counts[1] < counts[2]


def test_a_brittle_body_breaks_at_the_same_force_whatever_its_size_and_a_tough_small_one_later(rod):
    impact = across(rod, 0.5)
    softening = rod.softening
    brittle = replace(rod, softening=replace(softening, brittleness=1e-4)).first_crack(impact)
    less = replace(rod, softening=replace(softening, brittleness=1e-3)).first_crack(impact)
    tough = replace(rod, softening=replace(softening, brittleness=1.0)).first_crack(impact)
    assert brittle == less
    assert tough > 2.0 * brittle


def test_two_builds_and_a_copy_out_of_a_state_answer_with_the_same_bits(slab):
    again = make_simulator(slab.surface, options_for_body("structural", PRESETS["glass"], 0.3, cells=120, atoms=20), 1)
    restored = StructuralSimulator.restore(slab.surface, slab.cells, interfaces_between(slab.cells), *slab.state())
    impacts = single_impacts(slab.surface, 5, np.random.default_rng(2))
    impacts = impacts.times(2.0 * slab.first_crack(impacts))
    for other in (again, restored):
        np.testing.assert_array_equal(other.stiffness_left(impacts), slab.stiffness_left(impacts))
        np.testing.assert_array_equal(other.fracture(impacts).labels, slab.fracture(impacts).labels)
    np.testing.assert_array_equal(slab.fracture(impacts).labels, slab.fracture(impacts).labels)


def test_every_vertex_gives_way(slab):
    compliance = slab.compliance
    assert compliance.shape == (len(slab.surface.vertices),)
    assert (compliance > 0.0).all()
    # A plate gives way more at its corners than in its middle.
    corner = np.argmax(np.abs(slab.surface.vertices[:, :2]).sum(axis=1))
    middle = np.argmin(np.abs(slab.surface.vertices[:, :2]).sum(axis=1))
    assert compliance[corner] > compliance[middle]


def test_no_force_breaks_nothing(slab):
    impacts = single_impacts(slab.surface, 2, np.random.default_rng(0)).times(np.zeros(2))
    assert not slab.fracture(impacts).labels.any()


def test_atoms_are_connected_and_hold_enough(slab):
    fine = slab.fine_cells
    pairs, areas, _ = shared_faces(fine.triangles, fine.sides, fine.points)
    floor = 0.02 * float(fine.volumes.sum())
    region = group_cells(fine, pairs, areas, 10, floor, np.random.default_rng(0))
    assert np.bincount(region, fine.volumes).min() >= floor
    np.testing.assert_allclose(slab.cells.volumes.sum(), fine.volumes.sum(), rtol=1e-12)
    np.testing.assert_allclose(np.bincount(slab.fine_to_cell, fine.volumes), slab.cells.volumes, rtol=1e-9)


@pytest.mark.parametrize(
    ("option", "value"),
    [("brittleness", 0.0), ("strain", -1.0), ("poisson_ratio", 0.5), ("speed_number", np.nan), ("atoms", 1)],
)
def test_options_out_of_range_are_refused(option, value):
    with pytest.raises(BakeError, match=option):
        options_for("structural", **{option: value})


def test_the_defaults_are_those_of_a_ceramic_body_of_a_tenth_of_a_metre():
    assert options_for_body("structural", PRESETS["ceramic"], 0.1) == StructuralOptions(name="structural")
