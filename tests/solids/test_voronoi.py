"""Voronoi cells of a body: they add up, fit one another, meet in planes, and follow the walls."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.common.errors import BakeError
from fracsim.solids.cut import measure_cells
from fracsim.solids.interior import sample_interior, wall_thickness
from fracsim.solids.solid import shared_faces
from fracsim.solids.surface import Surface, read_surface
from fracsim.solids.voronoi import place_seeds, solid_of_seeds, voronoi_solid


def stepped_plate():
    """A slab of 1 x 0.5 that is 0.2 thick on one half and 0.03 on the other."""
    thick = trimesh.creation.box((0.5, 0.5, 0.2), trimesh.transformations.translation_matrix((-0.25, 0, 0)))
    thin = trimesh.creation.box((0.6, 0.5, 0.03), trimesh.transformations.translation_matrix((0.2, 0, 0)))
    return trimesh.boolean.union([thick, thin], engine="manifold")


SHAPES = {
    "box": lambda: trimesh.creation.box((1.0, 0.6, 0.3)),
    "sphere": lambda: trimesh.creation.icosphere(2),
    "torus": lambda: trimesh.creation.torus(1.0, 0.3, 24, 12),
    "thin shell": lambda: trimesh.creation.annulus(0.97, 1.0, 1.0, sections=24),
    "rod": lambda: trimesh.creation.cylinder(0.03, 1.0, sections=12),
    "stepped plate": stepped_plate,
}


@pytest.mark.parametrize("shape", SHAPES)
def test_cells_add_up_to_the_body_and_each_is_one_watertight_part(shape):
    surface = read_surface(SHAPES[shape]())
    solid = voronoi_solid(surface, 60, np.random.default_rng(0))
    assert 0.8 * 60 <= solid.count <= 1.3 * 60
    assert solid.volumes.sum() == pytest.approx(surface.trimesh.volume, rel=1e-12)
    # The volumes are those of the triangles that come out, exactly.
    again = measure_cells(solid.points, solid.triangles, solid.sides, solid.source)
    np.testing.assert_allclose(again.volumes, solid.volumes, rtol=1e-11)
    np.testing.assert_array_equal(solid.points[: len(surface.vertices)], surface.vertices)
    for cell in range(solid.count):
        vertices, faces, _ = solid.surface(np.arange(solid.count) == cell)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.is_watertight
        assert mesh.body_count == 1
        assert mesh.volume == pytest.approx(solid.volumes[cell], rel=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_outside_is_the_surface_and_neighbours_meet_in_planes(shape):
    surface = read_surface(SHAPES[shape]())
    solid = voronoi_solid(surface, 60, np.random.default_rng(1))
    outer = solid.source >= 0
    corner = solid.points[solid.triangles[outer]]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    per_face = np.bincount(solid.source[outer], area, minlength=len(surface.faces))
    np.testing.assert_allclose(per_face, surface.trimesh.area_faces, rtol=1e-9)
    _, areas, vectors = shared_faces(solid.triangles, solid.sides, solid.points)
    planar = np.linalg.norm(vectors, axis=1) > (1 - 1e-9) * areas
    assert planar.mean() > 0.9  # all but those of a cell that a sliver was joined to


def test_the_same_generator_gives_the_same_bits_and_another_does_not():
    surface = read_surface(SHAPES["torus"]())
    one, two, other = (voronoi_solid(surface, 40, np.random.default_rng(seed)) for seed in (3, 3, 4))
    for name in ("points", "triangles", "sides", "source", "volumes", "centroids"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert one.points.shape != other.points.shape or not np.array_equal(one.points, other.points)


def test_a_thin_wall_has_one_cell_through_it_and_smaller_ones_than_a_thick_part():
    surface = read_surface(stepped_plate())
    solid = voronoi_solid(surface, 200, np.random.default_rng(0))
    assert 0.85 * 200 <= solid.count <= 1.15 * 200
    thin = solid.centroids[:, 0] > 0.1
    # The wall's cells lie about its middle plane, so each reaches from side to side.
    assert (np.abs(solid.centroids[thin, 2]) < 0.005).all()
    assert 20 <= thin.sum() <= 100
    across = np.sqrt(np.median(solid.volumes[thin]) / 0.03)
    assert across < 0.9 * np.cbrt(np.median(solid.volumes[~thin]))


def test_seeds_stay_apart_and_near_everything():
    surface = read_surface(SHAPES["box"]())
    seeds, inside = place_seeds(surface, 50, np.random.default_rng(0))
    size = np.cbrt(surface.trimesh.volume / 50)
    apart = np.linalg.norm(seeds[:, None] - seeds, axis=2) + 9.0 * np.eye(50)
    assert apart.min() > 0.5 * size
    assert np.linalg.norm(inside[:, None] - seeds, axis=2).min(axis=1).max() < 1.5 * size


def test_cells_of_given_seeds_are_nearest_to_them():
    surface = read_surface(SHAPES["box"]())
    seeds = np.array([[-0.3, 0.0, 0.0], [0.1, 0.1, 0.05], [0.3, -0.1, 0.0]])
    inside, _ = sample_interior(surface, 500, np.random.default_rng(0))
    solid = solid_of_seeds(surface, seeds, inside, np.random.default_rng(0))
    assert solid.count == 3
    for cell in range(3):
        own = np.unique(solid.triangles[(solid.sides == cell).any(axis=1)])
        distance = np.linalg.norm(solid.points[own][:, None] - seeds, axis=2)
        nearest = np.argmin(np.linalg.norm(solid.centroids[cell] - seeds, axis=1))
        np.testing.assert_allclose(distance[:, nearest], distance.min(axis=1), atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_samples_of_the_inside_lie_inside_and_weigh_what_the_body_does(shape):
    surface = read_surface(SHAPES[shape]())
    points, volumes = sample_interior(surface, 2000, np.random.default_rng(0))
    assert 1500 < len(points) < 6000
    assert volumes.sum() == pytest.approx(surface.trimesh.volume, rel=0.1)
    some = np.random.default_rng(1).permutation(len(points))[:50]
    assert (winding_numbers(surface, points[some]) == 1).all()


def winding_numbers(surface, points):
    """By the solid angles of the faces (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces][None] - points[:, None, None], 2, 0)
    x, y, z = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
    below = x * y * z + sum(np.einsum("nfi,nfi->nf", p, q) * r for p, q, r in ((a, b, z), (b, c, x), (c, a, y)))
    return np.rint(np.arctan2(volume, below).sum(axis=1) / (2 * np.pi)).astype(int)


def test_thickness_is_that_of_walls_and_half_that_of_rods():
    surface = read_surface(trimesh.creation.box((1.0, 1.0, 0.04)))
    points, volumes = sample_interior(surface, 4000, np.random.default_rng(0))
    thickness = wall_thickness(surface, points, volumes, 0.1, np.random.default_rng(1))
    middle = (np.abs(points[:, :2]) < 0.3).all(axis=1)
    assert np.median(thickness[middle]) == pytest.approx(0.04, rel=0.1)
    surface = read_surface(trimesh.creation.cylinder(0.05, 1.0, sections=24))
    points, volumes = sample_interior(surface, 4000, np.random.default_rng(0))
    thickness = wall_thickness(surface, points, volumes, 0.1, np.random.default_rng(1))
    assert np.median(thickness[np.abs(points[:, 2]) < 0.3]) == pytest.approx(0.05, rel=0.1)


def test_a_surface_that_runs_through_itself_is_refused():
    one = trimesh.creation.icosphere(2)
    vertices = one.vertices.copy()
    vertices[:, 0] = np.where(vertices[:, 0] > 0.5, vertices[:, 0] - 1.8, vertices[:, 0])
    surface = Surface(vertices, np.asarray(one.faces), 1.0, np.zeros(3), "folded")
    with pytest.raises(BakeError, match=r"folded.*runs through itself"):
        voronoi_solid(surface, 40, np.random.default_rng(0))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.tuples(st.floats(0.02, 1.0), st.floats(0.02, 1.0)), st.integers(4, 60))
def test_any_box_is_tiled_exactly(seed, sizes, cells):
    surface = read_surface(trimesh.creation.box((1.0, *sizes)))
    solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
    assert 1 <= solid.count <= cells  # convex, so no cell has two parts
    assert solid.volumes.sum() == pytest.approx(sizes[0] * sizes[1], rel=1e-12)
    assert (solid.volumes > 0).all()
    middle = solid.volumes @ solid.centroids / solid.volumes.sum()
    np.testing.assert_allclose(middle, 0.0, atol=1e-9)
