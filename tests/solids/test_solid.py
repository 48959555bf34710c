"""The solid: cells that add up to the body, fit one another, and have its surface for their outside."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.common.errors import BakeError
from fracsim.fracture.rule import Interfaces, merge_small_pieces
from fracsim.solids.cut import cut_lattice
from fracsim.solids.lattice import lattice_spacing
from fracsim.solids.polygons import coarsen
from fracsim.solids.solid import merge_small_regions, relabel, shared_faces
from fracsim.solids.surface import Surface, read_surface

SHAPES = {
    "box": lambda: trimesh.creation.box((1.0, 0.6, 0.3)),
    "sphere": lambda: trimesh.creation.icosphere(2),
    "torus": lambda: trimesh.creation.torus(1.0, 0.3, 24, 12),
    "thin shell": lambda: trimesh.creation.annulus(0.97, 1.0, 1.0, sections=24),
    "rod": lambda: trimesh.creation.cylinder(0.03, 1.0, sections=12),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", [0, 1])
def test_cells_add_up_to_the_body_and_are_watertight(shape, seed):
    surface = read_surface(SHAPES[shape]())
    solid = cut_lattice(surface, 300, np.random.default_rng(seed))
    assert solid.volumes.sum() == pytest.approx(surface.trimesh.volume, rel=1e-12)
    assert (solid.volumes > 0).all()
    for cell in np.random.default_rng(seed).permutation(solid.count)[:40]:
        chosen = np.arange(solid.count) == cell
        vertices, faces, _ = solid.surface(chosen)
        mesh = trimesh.Trimesh(vertices, faces)
        assert mesh.is_watertight
        assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(solid.volumes[cell], rel=1e-6)


def test_coarsening_keeps_the_surface_exactly_and_drops_what_no_crack_needs():
    surface = read_surface(SHAPES["torus"]())
    cells = cut_lattice(surface, 400, np.random.default_rng(0))
    label = (cells.centroids[:, 0] > 0).astype(np.int64)
    joined = relabel(cells, label)
    solid = coarsen(joined, surface)
    assert len(solid.triangles) < len(joined.triangles)
    np.testing.assert_array_equal(solid.points[: len(surface.vertices)], surface.vertices)
    outer = solid.source >= 0
    corner = solid.points[solid.triangles[outer]]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    per_face = np.bincount(solid.source[outer], area, minlength=len(surface.faces))
    np.testing.assert_allclose(per_face, surface.trimesh.area_faces, rtol=1e-9)


def test_two_walls_closer_than_the_lattice_stay_apart():
    ring = trimesh.creation.annulus(0.5, 1.0, 0.2, sections=32)
    slot = trimesh.creation.box((0.8, 0.01, 1.0), trimesh.transformations.translation_matrix((0.8, 0, 0)))
    surface = read_surface(trimesh.boolean.difference([ring, slot], engine="manifold"))
    solid = cut_lattice(surface, 300, np.random.default_rng(0))
    pairs, _, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    # No cell reaches across the slot, and no two cells on its two sides are neighbours.
    upper = solid.centroids[:, 1] > 0
    near_slot = solid.centroids[:, 0] > 0.25
    across = near_slot[pairs].all(axis=1) & (upper[pairs[:, 0]] != upper[pairs[:, 1]])
    assert not across.any()


def test_a_surface_that_runs_through_itself_is_refused():
    one = trimesh.creation.icosphere(2)
    vertices = one.vertices.copy()
    vertices[:, 0] = np.where(vertices[:, 0] > 0.5, vertices[:, 0] - 1.8, vertices[:, 0])
    surface = Surface(vertices, np.asarray(one.faces), 1.0, np.zeros(3), "folded")
    with pytest.raises(BakeError, match=r"folded.*runs through itself"):
        cut_lattice(surface, 300, np.random.default_rng(0))


def test_the_lattice_spacing_gives_about_the_cells_asked_for():
    surface = read_surface(SHAPES["sphere"]())
    spacing = lattice_spacing(surface.trimesh.volume, surface.trimesh.area, 2000)
    assert 12 * surface.trimesh.volume / spacing**3 + 6 * surface.trimesh.area / spacing**2 == pytest.approx(2000)
    assert 1000 < len(cut_lattice(surface, 2000, np.random.default_rng(0)).volumes) < 2500


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.4))
def test_joining_leaves_nothing_small_and_only_joins_neighbours(seed, floor):
    rng = np.random.default_rng(seed)
    count = 12
    volumes = rng.dirichlet(np.ones(count))
    pairs = np.array([(k, k + 1) for k in range(count - 1)])  # a chain: regions must stay intervals
    label = merge_small_regions(volumes, pairs, rng.random(len(pairs)), floor)
    assert np.bincount(label, volumes).min() >= floor or label.max() == 0
    for region in range(label.max() + 1):
        members = np.flatnonzero(label == region)
        assert np.array_equal(members, np.arange(members[0], members[-1] + 1))


def test_where_small_regions_touch_the_rule_of_a_break_gives_other_pieces():
    """Why there are two rules, by a chain whose last three cells are small."""
    volumes, areas = np.array([0.56, 0.28, 0.01, 0.07, 0.08]), np.array([4.0, 3.0, 2.0, 1.0])
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    interfaces = Interfaces(pairs, areas, np.tile([1.0, 0.0, 0.0], (4, 1)), areas)
    # In one round cell 2 joins cell 1, and cell 4 joins cell 3, which was small when the round began.
    assert merge_small_regions(volumes, pairs, areas, 0.1).tolist() == [0, 1, 1, 2, 2]
    # One by one, cell 3 follows cell 2 before it is cell 4's turn.
    assert merge_small_pieces(np.arange(5), volumes, interfaces, 0.1).tolist() == [0, 1, 1, 1, 1]
