"""Surfaces and moments of random groups of cells: watertight, however the cells touch."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.geometry.complex import CellComplex
from fracsim.solids.cut import cut_lattice
from fracsim.solids.polygons import coarsen
from fracsim.solids.surface import read_surface


@pytest.fixture(scope="module")
def cells():
    surface = read_surface(trimesh.creation.icosphere(2))
    solid = coarsen(cut_lattice(surface, 300, np.random.default_rng(0)), surface)
    return CellComplex(solid.points, solid.triangles, solid.sides), solid.volumes


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_any_group_of_cells_is_watertight_and_has_their_volume(cells, seed, share):
    atoms, volumes = cells
    chosen = np.random.default_rng(seed).random(atoms.count) < share
    if not chosen.any():
        return
    vertices, faces, _ = atoms.surface(chosen)
    # A random half of the cells touches itself along dozens of edges; merged vertices must not undo the parting.
    assert trimesh.Trimesh(vertices, faces).is_watertight
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volumes[chosen].sum(), rel=1e-9)


def test_moments_are_those_of_the_solid(cells):
    atoms, volumes = cells
    zeroth, first, second = atoms.moments()
    np.testing.assert_allclose(zeroth, volumes, rtol=1e-9)
    vertices, faces, outer = atoms.surface(np.ones(atoms.count, dtype=bool))
    whole = trimesh.Trimesh(vertices, faces, process=False)
    assert outer.all()
    np.testing.assert_allclose(first.sum(axis=0), whole.center_mass * whole.volume, atol=1e-12)
    total = second.sum(axis=0)
    center = first.sum(axis=0) / zeroth.sum()
    spread = total - zeroth.sum() * np.outer(center, center)
    np.testing.assert_allclose(np.trace(spread) * np.eye(3) - spread, whole.moment_inertia, atol=1e-12)


def test_the_cell_at_a_point_is_the_one_that_holds_it(cells):
    atoms, volumes = cells
    points = np.random.default_rng(0).uniform(-0.55, 0.55, (4000, 3))
    found = atoms.cells_at(points)
    sphere = trimesh.Trimesh(*atoms.surface(np.ones(atoms.count, dtype=bool))[:2], process=False)
    height = np.einsum("fi,fi->f", sphere.face_normals, sphere.triangles[:, 0])  # of every face over the origin
    inside = (points @ sphere.face_normals.T <= height).all(axis=1)
    np.testing.assert_array_equal(found >= 0, inside)
    counts = np.bincount(found[inside], minlength=atoms.count)
    np.testing.assert_allclose(counts / inside.sum(), volumes / volumes.sum(), atol=0.01)
    for cell in (0, atoms.count // 2):
        # The winding number of the cell's own surface: 1 within, 0 without.
        vertices, faces, _ = atoms.surface(np.arange(atoms.count) == cell)
        a, b, c = np.moveaxis(vertices[faces] - points[:200, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
        top = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
        dots = (np.einsum("pfi,pfi->pf", v, w) for v, w in ((a, b), (b, c), (c, a)))
        ab, bc, ca = dots
        winding = 2 * np.arctan2(top, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (4 * np.pi)
        np.testing.assert_array_equal(found[:200] == cell, winding > 0.5)
