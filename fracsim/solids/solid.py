"""The solid: a jittered tetrahedral lattice cut, exactly and conformingly, by the input surface.

Cutting the lattice with the surface itself, rather than meshing a cage around it, gives cells whose volumes,
shared areas and outer faces are those of the real body however thin its walls are: every later question
(which piece is this vertex in, where does the crack meet the surface) has an exact answer. Offline only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..geometry.complex import vertex_cells


@dataclass(frozen=True, eq=False)
class Solid:
    """A body as a conforming complex of cells: each a connected part of one tetrahedron, or several joined.

    points: (P, 3); the first V are the surface's vertices, in order.
    triangles: (M, 3) into points. sides: (M, 2), the cells behind and before each triangle, -1 outside;
    the normal points from the first to the second, so outer triangles face outward.
    source: (M,) the input face that an outer triangle is a part of, -1 for inner triangles.
    volumes: (C,); they add up to the body's. centroids: (C, 3).
    """

    points: FloatArray
    triangles: IntArray
    sides: IntArray
    source: IntArray
    volumes: FloatArray
    centroids: FloatArray


def shared_faces(triangles: IntArray, sides: IntArray, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """What neighbouring regions share: pairs (I, 2) with first < second, areas (I,), and the vector areas
    (I, 3) that point from the first to the second."""
    inner = (sides >= 0).all(axis=1) & (sides[:, 0] != sides[:, 1])
    corner = points[triangles[inner]]
    vector = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    pairs = np.sort(sides[inner], axis=1)
    vector = np.where((sides[inner, 0] == pairs[:, 0])[:, None], vector, -vector)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    count = len(unique)
    return unique, sum_by_index(inverse, np.linalg.norm(vector, axis=1), count), sum_by_index(inverse, vector, count)


def sum_by_index(index: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Rows of ``values`` (N,) or (N, k) added up by their ``index`` (N,): (count,) or (count, k)."""
    if values.ndim == 1:
        return np.asarray(np.bincount(index, values, minlength=count), dtype=np.float64)
    return np.stack([np.bincount(index, column, minlength=count) for column in values.T], axis=1)


def merge_small_regions(
    volumes: FloatArray, pairs: IntArray, bond: FloatArray, floor: float, label: IntArray | None = None
) -> IntArray:
    """Join every region smaller than ``floor`` to the neighbour it is most strongly bound to, until none is.

    volumes: (C,). pairs: (I, 2) neighbours. bond: (I,), the strength. label: (C,), the regions to begin with, from 0;
    each by itself by default. Returns (C,) the region each is now in.
    """
    label = np.arange(len(volumes)) if label is None else label
    while True:
        count = int(label.max()) + 1
        total = np.bincount(label, volumes, minlength=count)
        ends = label[pairs]
        between = ends[:, 0] != ends[:, 1]
        if not (total < floor).any() or not between.any():
            return label
        # One at a time, the smallest first: what it joins may no longer be small.
        joint, inverse = np.unique(np.sort(ends[between], axis=1), axis=0, return_inverse=True)
        weight = np.bincount(inverse.reshape(-1), bond[between])
        small = np.argsort(total, kind="stable")
        small = small[total[small] < floor]
        moved = np.zeros(count, dtype=bool)
        target = np.arange(count)
        best: dict[int, tuple[float, int]] = {}
        for (a, b), w in zip(joint.tolist(), weight.tolist(), strict=True):
            for x, y in ((a, b), (b, a)):
                if x not in best or (w, -y) > (best[x][0], -best[x][1]):
                    best[x] = (w, y)
        for region in small.tolist():
            if region in best and not moved[region] and not moved[best[region][1]]:
                target[region] = best[region][1]
                moved[[region, best[region][1]]] = True
        if not moved.any():
            return label
        _, label = np.unique(target[label], return_inverse=True)


def relabel(solid: Solid, label: IntArray) -> Solid:
    """The solid with cells joined by ``label`` and the triangles between joined cells dropped."""
    sides = np.where(solid.sides >= 0, label[solid.sides], -1)
    keep = sides[:, 0] != sides[:, 1]
    count = int(label.max()) + 1
    volumes = sum_by_index(label, solid.volumes, count)
    centroids = sum_by_index(label, solid.volumes[:, None] * solid.centroids, count)
    return Solid(
        solid.points,
        solid.triangles[keep],
        sides[keep],
        solid.source[keep],
        volumes,
        centroids / volumes[:, None],
    )


def surface_cells(solid: Solid, count: int) -> IntArray:
    """(V,) the cell that each of the surface's ``count`` vertices lies on."""
    return vertex_cells(solid.triangles, solid.sides, len(solid.points))[:count]


def solid_to_arrays(solid: Solid, prefix: str = "") -> dict[str, npt.NDArray[Any]]:
    """Take a solid apart for a file.

    Parameters
    ----------
    solid : Solid
        Of any cells.
    prefix : str
        Put before each array's name.

    Returns
    -------
    dict of ndarray
        Every attribute by its name.
    """
    return {prefix + field.name: getattr(solid, field.name) for field in fields(Solid)}


def solid_from_arrays(arrays: Mapping[str, npt.NDArray[Any]], prefix: str = "") -> Solid:
    """Make a solid again of what ``solid_to_arrays`` gave.

    Parameters
    ----------
    arrays : mapping of ndarray
        By prefix and name; there may be others.
    prefix : str
        As it was.

    Returns
    -------
    Solid
        With the same arrays.
    """
    return Solid(**{field.name: arrays[prefix + field.name] for field in fields(Solid)})
