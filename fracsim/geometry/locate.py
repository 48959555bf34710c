"""The nearest points of triangles; fracture asks for them once an impulse."""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray


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
