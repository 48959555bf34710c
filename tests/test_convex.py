"""Convex parts keep apart from those of other atoms and keep most of the volume."""

from __future__ import annotations

import itertools

import manifold3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from fracsim.convex import GAP, HULL_VERTICES, clip_apart, decompose


def gaps(parts):
    solids = [(k, manifold3d.Manifold.hull_points(points)) for k, some in enumerate(parts) for points in some]
    return [a.min_gap(b, 1.0) for (i, a), (j, b) in itertools.combinations(solids, 2) if i != j]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_clipped_parts_of_different_atoms_never_come_nearer_than_the_gap(seed):
    rng = np.random.default_rng(seed)
    parts = [[rng.normal(size=(12, 3)) * 0.2 + centre] for centre in np.eye(3) * 0.5]
    pairs = np.array([[0, 1], [1, 2]])
    normals = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]]) / np.sqrt(2)
    clipped = clip_apart(parts, pairs, normals)
    assert min(gaps(clipped)) >= GAP * (1 - 1e-6)


def test_two_halves_of_a_box_lose_only_the_gap():
    cube = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    parts = [[cube], [cube + np.array([0.8, 0, 0])]]
    clipped = clip_apart(parts, np.array([[0, 1]]), np.array([[1.0, 0, 0]]))
    kept = sum(ConvexHull(points).volume for some in clipped for points in some)
    assert kept == pytest.approx(1.8 - GAP, rel=1e-6)


def test_a_convex_surface_is_one_part_and_a_bent_one_is_several(slab_mesh):
    box = (np.asarray(slab_mesh.vertices), np.asarray(slab_mesh.faces))
    bend = manifold3d.Manifold.cube((1, 1, 0.2)) + manifold3d.Manifold.cube((0.2, 1, 1))
    mesh = bend.to_mesh64()
    angle = (np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64))
    one, several = decompose([box, angle], workers=1)
    assert len(one) == 1
    assert len(several) > 1
    assert sum(ConvexHull(points).volume for points in several) == pytest.approx(bend.volume(), rel=0.1)
    assert max(len(points) for points in one + several) <= HULL_VERTICES
