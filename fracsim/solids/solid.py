"""The solid: a body cut into cells whose volumes, shared areas and outer faces are those of the real body.

``cut`` makes it by cutting a lattice with the surface itself rather than by meshing a cage around it, so every later
question (which piece is this vertex in, where does the crack meet the surface) has an exact answer however thin the
body's walls are. Offline only; the simulators and all that learns from them use it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..geometry.complex import CellComplex


@dataclass(frozen=True, eq=False)
class Solid(CellComplex):
    """A body as a complex of C cells that knows where its outer faces come from and how large its cells are.

    Each cell is a connected part of one tetrahedron of a lattice, or several joined.

    Attributes
    ----------
    points, triangles, sides : ndarray
        As of ``CellComplex``. The first V points are the surface's vertices, in order.
    source : ndarray of int64, shape (M,)
        The face of the input surface that an outer triangle is a part of; -1 for inner triangles.
    volumes : ndarray of float64, shape (C,)
        In units of the largest extent cubed; they add up to the body's.
    centroids : ndarray of float64, shape (C, 3)
        In units of the largest extent.
    """

    source: IntArray
    volumes: FloatArray
    centroids: FloatArray


def shared_faces(triangles: IntArray, sides: IntArray, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Measure what neighbouring cells share.

    Parameters
    ----------
    triangles, sides, points : ndarray
        Of a ``CellComplex``.

    Returns
    -------
    pairs : ndarray of int64, shape (I, 2)
        Cells that share an area, the smaller index first.
    areas : ndarray of float64, shape (I,)
        The area that they share.
    vectors : ndarray of float64, shape (I, 3)
        The sum of its triangles' area vectors, which point from the first cell to the second.
    """
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
    """Add up the values that have the same index.

    Parameters
    ----------
    index : ndarray of int64, shape (N,)
        From 0 to ``count - 1``.
    values : ndarray of float64, shape (N,) or (N, k)
        One row for each index.
    count : int
        How many sums.

    Returns
    -------
    ndarray of float64, shape (count,) or (count, k)
        The sums; 0 where an index does not occur.

    Examples
    --------
    >>> import numpy as np
    >>> sum_by_index(np.array([0, 2, 0]), np.array([1.0, 5.0, 2.0]), 3)
    array([3., 0., 5.])
    """
    if values.ndim == 1:
        return np.asarray(np.bincount(index, values, minlength=count), dtype=np.float64)
    return np.stack([np.bincount(index, column, minlength=count) for column in values.T], axis=1)


def merge_small_regions(
    volumes: FloatArray, pairs: IntArray, bond: FloatArray, floor: float, label: IntArray | None = None
) -> IntArray:
    """Join every region of a solid that is too small to the neighbour it is most strongly bound to.

    Parameters
    ----------
    volumes : ndarray of float64, shape (C,)
        Of the cells.
    pairs : ndarray of int64, shape (I, 2)
        Neighbouring cells.
    bond : ndarray of float64, shape (I,)
        How strongly they are bound, such as the area they share.
    floor : float
        The volume that every region must have, in the unit of ``volumes``.
    label : ndarray of int64, shape (C,), optional
        The regions to begin with, numbered from 0; each cell by itself by default.

    Returns
    -------
    ndarray of int64, shape (C,)
        The region that each cell is in now. A region without neighbours stays, however small.

    See Also
    --------
    fracsim.fracture.rule.merge_small_pieces : the rule of a break.

    Notes
    -----
    This rule is for thousands of small cells. It works in rounds: in each, all small regions, the smallest first, join
    the neighbour that was best when the round began, except where one of the two has been joined in this round
    already. ``merge_small_pieces`` is for the few small pieces of one break, at run time: it joins one piece, the
    smallest, and looks for the next in what has come of it. Where small regions touch each other the two give different
    regions, so neither can stand in for the other: this one would change which pieces break off, and that one takes a
    round for every cell.
    """
    label = np.arange(len(volumes)) if label is None else label
    while True:
        count = int(label.max()) + 1
        total = np.bincount(label, volumes, minlength=count)
        ends = label[pairs]
        between = ends[:, 0] != ends[:, 1]
        if not (total < floor).any() or not between.any():
            return label
        joint, inverse = np.unique(np.sort(ends[between], axis=1), axis=0, return_inverse=True)
        weight = np.bincount(inverse.reshape(-1), bond[between])
        small = np.argsort(total, kind="stable")
        small = small[total[small] < floor]
        moved = np.zeros(count, dtype=bool)
        target = np.arange(count)
        best: dict[int, tuple[float, int]] = {}  # of each region: its strongest bond, and to which region
        for (a, b), w in zip(joint.tolist(), weight.tolist(), strict=True):
            for x, y in ((a, b), (b, a)):
                if x not in best or (w, -y) > (best[x][0], -best[x][1]):
                    best[x] = (w, y)
        for region in small.tolist():
            # What another region has joined in this round may no longer be small.
            if region in best and not moved[region] and not moved[best[region][1]]:
                target[region] = best[region][1]
                moved[[region, best[region][1]]] = True
        if not moved.any():
            return label
        _, label = np.unique(target[label], return_inverse=True)


def relabel(solid: Solid, label: IntArray) -> Solid:
    """Join cells of a solid, and drop the triangles between cells that were joined.

    Parameters
    ----------
    solid : Solid
        Of C cells.
    label : ndarray of int64, shape (C,)
        The new cell of each cell, numbered from 0.

    Returns
    -------
    Solid
        With ``label.max() + 1`` cells and the same points.
    """
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
