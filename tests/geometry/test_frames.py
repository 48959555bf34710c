"""Frames: right-handed and orthonormal for every normal, and to the bit those that data was drawn with."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.geometry.frames import cross, tangent_basis
from fracsim.geometry.sampling import cone


def unit_vectors(count):
    vectors = np.random.default_rng(5).normal(size=(count, 3))
    return np.concatenate([vectors / np.linalg.norm(vectors, axis=1)[:, None], np.eye(3), -np.eye(3)])


def test_cross_products_are_numpys_to_the_bit():
    a, b = np.random.default_rng(0).normal(size=(2, 500, 3))
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))
    np.testing.assert_array_equal(cross(a[0], b), np.cross(a[0], b))


@pytest.mark.parametrize("seed", ["first", "smallest"])
def test_tangents_and_normal_are_a_right_handed_orthonormal_frame(seed):
    normals = unit_vectors(500)
    frame = np.stack([*tangent_basis(normals, seed), normals], axis=1)
    np.testing.assert_allclose(frame @ np.swapaxes(frame, 1, 2), np.tile(np.eye(3), (len(frame), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0)


@pytest.mark.parametrize("seed", ["first", "smallest"])
def test_one_normal_has_the_frame_that_it_has_among_others(seed):
    normals = unit_vectors(20)
    first, second = tangent_basis(normals, seed)
    for k, normal in enumerate(normals):
        np.testing.assert_array_equal(tangent_basis(normal, seed), (first[k], second[k]))


def test_directions_of_a_cone_are_drawn_as_before_the_frames_were_shared():
    axes = unit_vectors(300)
    drawn = cone(axes, 1.0, np.random.default_rng(3))
    rng = np.random.default_rng(3)
    cosine, turn = rng.uniform(np.cos(1.0), 1.0, len(axes)), rng.uniform(0.0, 2 * np.pi, len(axes))
    helper = np.where(np.abs(axes[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(axes, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(axes, first)
    sine = np.sqrt(1.0 - cosine**2)
    expected = cosine[:, None] * axes + (sine * np.cos(turn))[:, None] * first + (sine * np.sin(turn))[:, None] * second
    np.testing.assert_array_equal(drawn, expected)


def test_directions_of_a_cone_are_uniform_over_its_cap():
    drawn = cone(np.tile([0.0, 0.6, 0.8], (20000, 1)), np.pi / 3, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0)
    height = drawn @ [0.0, 0.6, 0.8]
    assert height.min() >= 0.5 - 1e-12
    # Archimedes: heights of points uniform over a cap are uniform.
    counts, _ = np.histogram(height, bins=10, range=(0.5, 1.0))
    assert np.abs(counts - 2000).max() < 5 * np.sqrt(2000)
