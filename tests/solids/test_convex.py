"""Convex parts keep apart from those of other solids, keep most of the volume, and have few corners."""

from __future__ import annotations

import itertools

import manifold3d
import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from fracsim.baking import remake_convex
from fracsim.common.errors import BakeError
from fracsim.solids.convex import BODY_VERTICES, clip_apart, decompose, separate
from fracsim.solids.convex_partition import GAP
from fracsim.solids.hulls import HULL_VERTICES, coacd_parts
from fracsim.solids.sampled_solid import REACH

NO_HINTS = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3))


def surface(solid):
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64)


def hull(points):
    return manifold3d.Manifold.hull_points(points)


def union(parts):
    return manifold3d.Manifold.batch_boolean([hull(points) for points in parts], manifold3d.OpType.Add)


def nearest(parts):
    solids = [(k, hull(points)) for k, some in enumerate(parts) for points in some]
    return min(a.min_gap(b, 1.0) for (i, a), (j, b) in itertools.combinations(solids, 2) if i != j)


def box(size, at=(0, 0, 0)):
    return manifold3d.Manifold.cube(size).translate(at)


@pytest.fixture(scope="module")
def hook():
    """A bent bar and a block in its elbow: no plane parts the two."""
    bar = box((1, 0.3, 0.2)) + box((0.2, 0.3, 0.8))
    return bar, box((0.4, 0.3, 0.5), (0.2, 0, 0.2))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_parts_of_different_solids_never_come_nearer_than_the_gap(seed):
    rng = np.random.default_rng(seed)
    solids = [hull(rng.normal(size=(12, 3)) * 0.15 + centre) for centre in np.eye(3) * 0.5]
    pairs = np.array([[0, 1], [1, 2]])
    normals = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]]) / np.sqrt(2)
    try:
        parts = decompose([surface(solid) for solid in solids], pairs, normals)
    except BakeError:  # one solid within another has no part left; too many of these examples would fail the test
        reject()
    assert nearest(parts) >= GAP * (1 - 1e-6)
    assert all(len(points) <= HULL_VERTICES for some in parts for points in some)


def test_two_boxes_that_touch_lose_only_the_gap():
    parts = decompose([surface(box((1, 1, 1))), surface(box((1, 1, 1), (1, 0, 0)))], *NO_HINTS)
    assert [len(some) for some in parts] == [1, 1]
    assert nearest(parts) == pytest.approx(GAP, rel=1e-6)
    kept = sum(hull(points).volume() for some in parts for points in some)
    assert kept == pytest.approx(2 - GAP, rel=2e-2)


def test_a_part_is_split_only_where_that_pays(hook):
    parts = decompose([surface(solid) for solid in hook], *NO_HINTS)
    assert 1 < len(parts[0]) <= 3
    assert len(parts[1]) <= 2
    assert nearest(parts) >= GAP * (1 - 1e-6)
    for solid, some in zip(hook, parts, strict=True):
        both = (union(some) ^ solid).volume()
        assert union(some).volume() + solid.volume() - 2 * both < 0.06 * solid.volume()


def test_no_part_sticks_out_of_the_hull_of_all_solids_or_far_out_of_its_own(hook):
    sphere = manifold3d.Manifold.sphere(0.5, 48)
    halves = sphere.split_by_plane((1, 0, 0), 0.0)
    for solids in (hook, halves):
        surfaces = [surface(solid) for solid in solids]
        around = ConvexHull(np.vstack([vertices for vertices, _ in surfaces])).equations
        for (vertices, _), some in zip(surfaces, decompose(surfaces, *NO_HINTS), strict=True):
            points = np.vstack(some)
            assert (points @ around[:, :3].T + around[:, 3]).max() < 1e-9
            own = ConvexHull(vertices).equations
            assert (points @ own[:, :3].T + own[:, 3]).max() < 2 * REACH


def test_round_solids_keep_nearly_their_volume_with_few_corners():
    halves = manifold3d.Manifold.sphere(0.5, 48).split_by_plane((1, 0, 0), 0.0)
    parts = decompose([surface(solid) for solid in halves], *NO_HINTS)
    for solid, some in zip(halves, parts, strict=True):
        assert max(len(points) for points in some) <= HULL_VERTICES
        assert union(some).volume() > 0.8 * solid.volume()


def test_the_same_solids_give_the_same_bytes(hook):
    surfaces = [surface(solid) for solid in hook]
    once, again = (decompose(surfaces, *NO_HINTS) for _ in range(2))
    assert [[points.tobytes() for points in some] for some in once] == [
        [points.tobytes() for points in some] for some in again
    ]


def test_live_parts_are_several_where_a_surface_is_bent_and_are_apart(hook):
    parts = separate([surface(solid) for solid in hook], *NO_HINTS)
    points = [[points for points, _ in some] for some in parts]
    assert len(points[0]) > 1
    assert nearest(points) >= GAP * (1 - 1e-6)
    for some in parts:
        for corners, faces in some:
            assert len(corners) <= HULL_VERTICES
            assert np.linalg.det(corners[faces]).sum() / 6 == pytest.approx(ConvexHull(corners).volume)
    kept = [union(some).volume() / solid.volume() for some, solid in zip(points, hook, strict=True)]
    assert kept == pytest.approx([1, 1], abs=0.06)


def test_coacd_gives_the_same_parts_in_one_process_or_two(hook):
    surfaces = [surface(solid) for solid in hook]
    for one, two in zip(coacd_parts(surfaces, 1), coacd_parts(surfaces, 2), strict=True):
        np.testing.assert_array_equal(np.vstack(one), np.vstack(two))


def test_a_solid_that_lies_within_another_is_named():
    outer, inner = surface(box((1, 1, 1))), surface(box((0.02, 0.02, 0.02), (0.49, 0.49, 0.49)))
    with pytest.raises(BakeError, match="atom 1 lost its last convex part"):
        clip_apart([outer, inner], [[outer[0]], [inner[0]]], *NO_HINTS)


def test_a_bake_and_a_remake_give_the_same_parts(slab):
    again = remake_convex(slab)
    for name in ("hull_points", "hull_faces", "hull_sizes", "hull_atoms", "body_points", "body_faces", "body_sizes"):
        old, new = getattr(slab.arrays, name), getattr(again.arrays, name)
        np.testing.assert_array_equal(new, old)
    assert again.metadata == slab.metadata
    assert again.arrays.body_sizes[:, 0].max() <= BODY_VERTICES
