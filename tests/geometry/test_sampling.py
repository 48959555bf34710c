"""Points of a surface: uniform over its area, and values between its vertices."""

from __future__ import annotations

import numpy as np

from fracsim.geometry.sampling import SEVERITY, SurfacePoints, ratios

VERTICES = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 3, 2]])  # of areas 1.5 and 0.5


def test_points_are_uniform_over_the_area():
    points = SurfacePoints(VERTICES, FACES)
    np.testing.assert_allclose(points.share, [0.75, 0.25])
    face, barycentric = points.draw(20000, np.random.default_rng(0))
    assert abs((face == 0).mean() - 0.75) < 5 * np.sqrt(0.75 * 0.25 / 20000)
    places = points.at(face, barycentric)
    np.testing.assert_allclose(places[face == 0, 2], 0.0, atol=1e-15)
    # The mean of a triangle is its middle; x has the standard deviation 3 / sqrt(18).
    count = (face == 0).sum()
    assert np.abs(places[face == 0].mean(axis=0) - [1, 1 / 3, 0]).max() < 5 * 3 / np.sqrt(18 * count)


def test_normals_are_outward_unit_vectors():
    np.testing.assert_allclose(SurfacePoints(VERTICES, FACES).normals, [[0, 0, -1], [-1, 0, 0]])


def test_rows_are_linear_between_the_vertices():
    points = SurfacePoints(VERTICES, FACES)
    rng = np.random.default_rng(1)
    face, barycentric = points.draw(40, rng)
    face, barycentric = face.reshape(20, 2), barycentric.reshape(20, 2, 3)
    field = VERTICES @ rng.normal(size=(3, 5)) + 1.0
    expected = np.stack([points.at(face[:, k], barycentric[:, k]) for k in range(2)], axis=1)
    rows = points.rows(field, face, barycentric)
    np.testing.assert_allclose(rows, expected @ np.linalg.lstsq(VERTICES, field - 1.0, rcond=None)[0] + 1.0)


def test_ratios_are_log_uniform():
    logs = np.log(ratios(20000, np.random.default_rng(2)))
    low, high = np.log(SEVERITY)
    assert low <= logs.min()
    assert logs.max() <= high
    counts, _ = np.histogram(logs, bins=10, range=(low, high))
    assert np.abs(counts - 2000).max() < 5 * np.sqrt(2000)
