"""The modal simulator is independent of the frame, the size and the numbering of its solid, and of its lattice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import ks_2samp

from fracsim.data.impacts import draw_impacts
from fracsim.fracture.rule import separated
from fracsim.simulators.base import Impacts
from fracsim.simulators.fracture_modes import fracture_modes
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.cut import cut_lattice
from fracsim.solids.solid import Solid
from fracsim.solids.surface import Surface, read_surface, refine


def wedge():
    """A body without symmetry, so that no two of its modes are alike."""
    points = [(0, 0, 0), (1, 0, 0), (0.9, 0.45, 0), (0, 0.3, 0), (0.1, 0.05, 0.5), (0.7, 0.1, 0.25), (0.2, 0.3, 0.35)]
    return trimesh.convex.convex_hull(np.array(points))


@pytest.fixture(scope="module")
def body():
    surface = refine(read_surface(wedge()))
    cells = cut_lattice(surface, 600, np.random.default_rng(0))
    simulator = ModalSimulator.from_modes(surface, cells, fracture_modes(cells, 4), 1e-3)
    impacts, _ = draw_impacts(surface, 200, np.random.default_rng(1))
    ratio = np.exp(np.random.default_rng(2).uniform(np.log(0.3), np.log(5), 200))
    return surface, cells, simulator, impacts.times(ratio * simulator.thresholds(impacts))


def moved(surface, cells, rotation, shift, order, triangle_order):
    """The same solid somewhere else, with its cells and triangles in another order."""
    rank = np.argsort(order)
    sides = np.where(cells.sides >= 0, rank[cells.sides], -1)[triangle_order]
    turned = rotation.apply(cells.points) + shift
    solid = Solid(
        turned,
        cells.triangles[triangle_order],
        sides,
        cells.source[triangle_order],
        cells.volumes[order],
        (rotation.apply(cells.centroids) + shift)[order],
    )
    return Surface(turned[: len(surface.vertices)], surface.faces, surface.scale, surface.offset, "moved"), solid


@settings(max_examples=6, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_moving_turning_and_renumbering_the_solid_changes_nothing_but_the_frame(body, seed):
    surface, cells, simulator, impacts = body
    rng = np.random.default_rng(seed)
    rotation, shift = Rotation.random(random_state=seed % 2**31), rng.standard_normal(3)
    order, triangles = rng.permutation(len(cells.volumes)), rng.permutation(len(cells.triangles))
    other_surface, other_cells = moved(surface, cells, rotation, shift, order, triangles)
    other = ModalSimulator.from_modes(other_surface, other_cells, fracture_modes(other_cells, 4), 1e-3)
    # The same atoms, by another number: a one-to-one map.
    pairs = np.unique(np.stack([simulator.fine_to_cell[order], other.fine_to_cell]), axis=1)
    assert pairs.shape[1] == len(simulator.cells.volumes) == len(other.cells.volumes)
    number = pairs[1]
    np.testing.assert_allclose(other.impact_field[:, number], simulator.impact_field, rtol=1e-8, atol=1e-9)
    directions = rotation.apply(impacts.directions.reshape(-1, 3)).reshape(impacts.directions.shape)
    turned = replace(impacts, directions=directions)
    np.testing.assert_allclose(other.thresholds(turned), simulator.thresholds(impacts), rtol=1e-7)
    mine, theirs = simulator.fracture(impacts).labels, other.fracture(turned).labels[:, number]
    ends = simulator.interfaces.pairs
    np.testing.assert_array_equal(separated(mine, ends), separated(theirs, ends))


@pytest.mark.parametrize("scale", [2.0**-9, 8.0])
def test_the_size_of_the_mesh_changes_nothing(body, scale):
    _, _, simulator, impacts = body
    mesh = wedge()
    mesh.apply_scale(scale)  # by powers of two, which do not round
    surface = refine(read_surface(mesh))
    assert surface.scale == scale
    cells = cut_lattice(surface, 600, np.random.default_rng(0))
    other = ModalSimulator.from_modes(surface, cells, fracture_modes(cells, 4), 1e-3)
    np.testing.assert_array_equal(other.fine_to_cell, simulator.fine_to_cell)
    np.testing.assert_array_equal(other.thresholds(impacts), simulator.thresholds(impacts))


def test_the_size_of_the_solid_changes_no_mode(body):
    _, cells, _, _ = body
    larger = replace(cells, points=3 * cells.points, volumes=27 * cells.volumes, centroids=3 * cells.centroids)
    one, other = fracture_modes(cells, 3), fracture_modes(larger, 3)
    np.testing.assert_allclose(np.abs(other.values), np.abs(one.values), atol=1e-3)
    for small, large in zip(one.objectives, other.objectives, strict=True):
        assert large[-1] == pytest.approx(9 * small[-1], rel=1e-3)


def test_through_another_lattice_pieces_are_as_many_and_break_as_often():
    """On a symmetric shape modes may be any of their equals; what comes of them has the same distribution."""
    surface = refine(read_surface(trimesh.creation.box((1.0, 0.6, 0.5))))
    severe = 6.0
    counts = []
    impacts, kind = draw_impacts(surface, 1500, np.random.default_rng(9))
    single = kind == 0
    impacts = Impacts(
        *(getattr(impacts, name)[single] for name in ("faces", "barycentric", "directions", "severities"))
    )
    for seed in range(8):
        simulator = make_simulator(surface, SimulatorOptions(cells=800, modes=6), seed)
        labels = simulator.fracture(impacts.times(np.full(len(impacts), severe))).labels
        counts.append(labels.max(axis=1) + 1)
    even, odd = np.concatenate(counts[::2]), np.concatenate(counts[1::2])
    means = np.array([count.mean() for count in counts])
    broke = np.array([(count > 1).mean() for count in counts])
    # Eight lattices, not impacts, are what is sampled here. Their means have a scatter of some 7 %.
    assert means / means.mean() == pytest.approx(np.ones(8), abs=0.2)
    assert (broke > 0.99).all()
    assert even.mean() == pytest.approx(odd.mean(), rel=0.1)
    assert ks_2samp(even, odd).statistic < 0.1
