"""TODO geometry.locate."""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray


def closest_on_triangles(points: FloatArray, triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nearest points on triangles: barycentric coordinates (..., 3) and squared distances (...)."""
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
