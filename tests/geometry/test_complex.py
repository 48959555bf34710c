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
