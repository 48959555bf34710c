"""A solid as sample points over its hull: which lie inside, and what a convex part gains by holding each.

Offline only; ``convex_partition`` measures its parts by them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from ..common.arrays import BoolArray, FloatArray, IntArray
from .hulls import within

REACH = 0.01  # of the largest extent: how far a part may stick out of its solid
SAMPLES = 1500  # points inside each solid by which volumes are measured
EXCESS = 0.4  # how bad volume outside of the solid is, measured by volume lost; gaps are lost whatever is done
# A sequence that fills the unit square evenly whatever its length (Roberts 2018, R2), and the golden ratio for heights
R2 = np.array([0.7548776662466927, 0.5698402909980532])
GOLDEN = 0.618033988749895
BLOCK = 2_000_000  # pairs of a column and a triangle that are worked on at a time, for memory


@dataclass(frozen=True, eq=False)
class SampledSolid:
    """A closed surface and points spread evenly over its hull and a little further.

    Attributes
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Of the surface.
    points : ndarray of float64, shape (N, 3)
        About SAMPLES of them are inside.
    inside : ndarray of bool, shape (N,)
        Which lie inside of the solid.
    value : ndarray of float64, shape (N,)
        The volume that each stands for; times -EXCESS outside.
    volume : float
        Of the solid.
    """

    vertices: FloatArray
    points: FloatArray
    inside: BoolArray
    value: FloatArray
    volume: float

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> SampledSolid:
        """Sample a solid.

        Parameters
        ----------
        vertices : ndarray of float64, shape (V, 3)
            Of its surface.
        faces : ndarray of int64, shape (F, 3)
            Outward and watertight.

        Returns
        -------
        SampledSolid
            The same surface gives the same points.
        """
        volume = float(np.linalg.det(vertices[faces]).sum()) / 6
        hull = ConvexHull(vertices)
        low, high = vertices.min(axis=0) - REACH, vertices.max(axis=0) + REACH
        spacing = (volume / SAMPLES) ** (1 / 3)
        across, levels = (high - low)[:2], int(np.ceil((high - low)[2] / spacing))
        columns = int(np.ceil(across.prod() / spacing**2))
        k = np.arange(columns)[:, None]
        ground = low[:2] + across * ((0.5 + k * R2) % 1.0)
        heights = low[2] + (high - low)[2] * (np.arange(levels) + k * GOLDEN % 1.0) / levels
        inside = _below_odd(ground, heights, vertices[faces])
        columns_3d = [np.repeat(ground[:, None], levels, axis=1), heights[..., None]]
        points = np.concatenate(columns_3d, axis=2).reshape(-1, 3)
        close = within(points, hull.equations, REACH)
        points, inside = points[close], inside.ravel()[close]
        weight = volume / max(1, int(inside.sum()))
        return cls(vertices, points, inside, np.where(inside, 1.0, -EXCESS) * weight, volume)


def _below_odd(ground: FloatArray, heights: FloatArray, triangles: FloatArray) -> BoolArray:
    """Decide which heights (C, L) over points (C, 2) are inside a closed surface: an odd number of faces lies below."""
    column, depth = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.moveaxis(triangles, 0, -1)
    block = max(1, BLOCK // len(triangles))
    for begin in range(0, len(ground), block):
        x, y = ground[begin : begin + block, :, None].transpose(1, 0, 2)
        u = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        v = (cx - bx) * (y - by) - (cy - by) * (x - bx)
        w = (ax - cx) * (y - cy) - (ay - cy) * (x - cx)
        row, face = np.nonzero(((u >= 0) == (v >= 0)) & ((v >= 0) == (w >= 0)) & (u + v + w != 0))
        p, q, r = u[row, face], v[row, face], w[row, face]
        column.append(row + begin)
        depth.append((q * az[face] + r * bz[face] + p * cz[face]) / (p + q + r))
    low, high = triangles[..., 2].min(), triangles[..., 2].max()
    scale = 0.5 / (high - low)
    key = np.sort(np.concatenate(column) + 0.25 + (np.concatenate(depth) - low) * scale)
    row = np.arange(len(ground))[:, None]
    wanted = row + 0.25 + np.clip((heights - low) * scale, -0.2, 0.7)
    below: BoolArray = (np.searchsorted(key, wanted) - np.searchsorted(key, row)) % 2 == 1
    return below
