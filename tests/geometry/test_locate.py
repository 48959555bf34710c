"""The nearest points of triangles, against a dense search over them."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.geometry.locate import closest_on_surface, closest_on_triangles


def test_no_point_of_a_triangle_is_nearer_than_the_closest():
    rng = np.random.default_rng(1)
    points, triangles = rng.normal(size=(200, 3)), rng.normal(size=(200, 3, 3))
    barycentric, squared = closest_on_triangles(points, triangles)
    assert (barycentric >= -1e-12).all()
    np.testing.assert_allclose(barycentric.sum(axis=1), 1.0)
    found = np.einsum("nk,nki->ni", barycentric, triangles)
    np.testing.assert_allclose(((found - points) ** 2).sum(axis=1), squared)
    others = np.einsum("mk,nki->nmi", rng.dirichlet(np.full(3, 0.5), 4000), triangles)
    distance = ((others - points[:, None]) ** 2).sum(axis=2)
    assert (distance.min(axis=1) >= squared - 1e-12).all()
    assert (distance.min(axis=1) <= squared + 0.05).all()


def test_the_closest_point_of_a_surface_is_the_closest_of_all_its_triangles():
    trimesh = pytest.importorskip("trimesh")
    torus = trimesh.creation.torus(0.4, 0.1, major_sections=24, minor_sections=12)
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.4
    face, barycentric = closest_on_surface(points, torus.vertices, torus.faces)
    found = np.einsum("nk,nki->ni", barycentric, torus.triangles[face])
    _, square = closest_on_triangles(points[:, None], torus.triangles[None])
    np.testing.assert_allclose(np.linalg.norm(found - points, axis=1), np.sqrt(square.min(axis=1)))
