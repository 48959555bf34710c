"""The nearest points of triangles and of surfaces made of them; fracture asks for them once an impulse."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray

NEAREST_FACES = 16  # by their middles, of which the nearest face by distance is one on any mesh of ordinary triangles


def closest_on_triangles(points: FloatArray, triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the nearest point of each of many triangles.

    Parameters
    ----------
    points : ndarray of float64, shape (..., 3)
        Where to measure from.
    triangles : ndarray of float64, shape (..., 3, 3)
        The corners of a triangle for each point; the leading axes broadcast.

    Returns
    -------
    barycentric : ndarray of float64, shape (..., 3)
        The nearest point of the triangle, in barycentric coordinates.
    squared : ndarray of float64, shape (...)
        The squared distance to it.

    Examples
    --------
    >>> import numpy as np
    >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> barycentric, squared = closest_on_triangles(np.array([2.0, 0.0, 0.0]), corners)
    >>> barycentric.tolist(), float(squared)
    ([0.0, 1.0, 0.0], 1.0)
    """
    a, b, c = np.moveaxis(triangles, -2, 0)
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (np.einsum("...i,...i->...", x, y) for x, y in ((u, u), (u, v), (v, v)))
    uw, vw = (np.einsum("...i,...i->...", x, w) for x in (u, v))
    determinant = uu * vv - uv**2
    s, t = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    along_u, along_v = np.clip(uw / uu, 0, 1), np.clip(vw / vv, 0, 1)
    edge = np.clip((vw - uw - uv + uu) / (uu - 2 * uv + vv), 0, 1)
    zero = np.zeros_like(s)
    options = np.stack(
        [np.stack([along_u, zero], -1), np.stack([zero, along_v], -1), np.stack([1 - edge, edge], -1)], axis=-2
    )
    reach = options[..., :1] * u[..., None, :] + options[..., 1:] * v[..., None, :] - w[..., None, :]
    nearest = np.argmin((reach**2).sum(-1), axis=-1)
    on_edge = np.take_along_axis(options, nearest[..., None, None], axis=-2)[..., 0, :]
    st = np.where(inside[..., None], np.stack([s, t], -1), on_edge)
    gap = st[..., :1] * u + st[..., 1:] * v - w
    return np.concatenate([1 - st.sum(-1, keepdims=True), st], axis=-1), (gap**2).sum(-1)


def closest_on_surface(
    points: FloatArray, vertices: FloatArray, faces: IntArray, tree: cKDTree | None = None
) -> tuple[IntArray, FloatArray]:
    """Find the nearest points of a surface.

    Parameters
    ----------
    points : ndarray of float64, shape (K, 3)
        Where to measure from.
    vertices : ndarray of float64, shape (V, 3)
        Of the surface.
    faces : ndarray of int64, shape (F, 3)
        Of the surface; triangles of ordinary shape, as ``solids.surface.refine`` leaves them.
    tree : scipy.spatial.cKDTree, optional
        Of the faces' middles, where somebody has it.

    Returns
    -------
    face : ndarray of int64, shape (K,)
        The face that each nearest point lies on.
    barycentric : ndarray of float64, shape (K, 3)
        Where on that face.

    Examples
    --------
    >>> import numpy as np
    >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    >>> face, barycentric = closest_on_surface(np.array([[1.0, 1.0, 2.0]]), corners, np.array([[0, 1, 2], [1, 3, 2]]))
    >>> face.tolist(), barycentric.tolist()
    ([1], [[0.0, 1.0, 0.0]])
    """
    count = min(NEAREST_FACES, len(faces))
    if tree is None:
        tree = cKDTree(vertices[faces].mean(axis=1))
    _, nearest = tree.query(points, k=np.arange(1, count + 1))
    barycentric, square = closest_on_triangles(points[:, None], vertices[faces[nearest]])
    best = np.argmin(square, axis=1)
    row = np.arange(len(points))
    return np.asarray(nearest[row, best], dtype=np.int64), barycentric[row, best]
