"""Planar polygons: loops of edges, their triangles, and a solid's outside without the lattice's marks.

Offline only. ``cut`` triangulates with it; the simulators simplify their atoms with ``coarsen``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from .solid import Solid
from .surface import Surface

try:
    import manifold3d
except ImportError as error:
    raise MissingExtraError("manifold3d", "bake") from error

STRAIGHT = 1e-6  # rad; two edges that turn by less are one: far above rounding, far below what can be seen


def boundary_loops(points: FloatArray, start: IntArray, end: IntArray, frame: FloatArray) -> list[list[int]]:
    """Chain directed planar edges into closed loops, with the region to their left.

    Parameters
    ----------
    points : ndarray of float64, shape (P, 3)
        What the edges join.
    start, end : ndarray of int64, shape (N,)
        The edges.
    frame : ndarray of float64, shape (3, 2)
        Two axes in the plane.

    Returns
    -------
    list of list of int
        The points of each loop in order. Regions that touch in a point get loops of their own.
    """
    next_points: dict[int, list[int]] = {}
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        next_points.setdefault(a, []).append(b)
    # Where the region touches itself, the way on is the first one clockwise from the way back: it bounds the
    # same wedge of the region.
    after: dict[tuple[int, int], int] = {}
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        choices = next_points[b]
        if len(choices) > 1:
            arms = (points[[a, *choices]] - points[b]) @ frame
            angle = np.arctan2(arms[:, 1], arms[:, 0])
            choices = [choices[int(np.argmin((angle[0] - angle[1:]) % (2 * np.pi)))]]
        after[a, b] = choices[0]
    loops = []
    while after:
        edge = next(iter(after))
        loop = []
        while edge in after:
            loop.append(edge[1])
            edge = edge[1], after.pop(edge)
        loops.append(loop)
    return loops


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b of two vectors; of so few, plain numbers are faster than ``numpy.cross``."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def triangulate_polygon(
    points: FloatArray,
    start: IntArray,
    end: IntArray,
    triangle: FloatArray,
    needed: npt.NDArray[np.bool_] | None = None,
) -> IntArray:
    """Triangulate the planar region to the left of directed edges.

    Parameters
    ----------
    points : ndarray of float64, shape (P, 3)
        What the edges join.
    start, end : ndarray of int64, shape (N,)
        The edges.
    triangle : ndarray of float64, shape (3, 3)
        Three points of the plane, wound as the result shall be.
    needed : ndarray of bool, shape (P,), optional
        Which points the result must keep; the others must lie on straight stretches of the rim.

    Returns
    -------
    ndarray of int64, shape (T, 3)
        Triangles of the points.
    """
    if len(start) == 3 and (needed is None or needed[start].all()):
        (a, b, c), last = start.tolist(), int(end[0])
        return np.array([[last, b if last == c else c, a]])
    across, second = triangle[1] - triangle[0], triangle[2] - triangle[0]
    up = _cross(_cross(across, second), across)
    frame = np.stack([across / np.linalg.norm(across), up / np.linalg.norm(up)], axis=1)
    loops = [
        loop if needed is None else [point for point in loop if needed[point]]
        for loop in boundary_loops(points, start, end, frame)
    ]
    if len(loops) == 1 and len(loops[0]) == 3:
        return np.array(loops)
    flat = [(points[loop] - triangle[0]) @ frame for loop in loops]
    return np.concatenate(loops)[np.asarray(manifold3d.triangulate(flat)).astype(np.int64)]


def coarsen(solid: Solid, surface: Surface, plane: IntArray | None = None) -> Solid:
    """Undo the lattice's marks on the outer faces wherever no inner triangle needs them.

    Parameters
    ----------
    solid : Solid
        A union of cells of a cut lattice.
    surface : Surface
        What was cut.
    plane : ndarray of int64, shape (M,), optional
        A number of the plane that each inner triangle lies in, and anything for outer ones. Inner faces are then
        triangulated again as well, and only what is a corner of theirs stays on the outside.

    Returns
    -------
    Solid
        Of the same cells. Each input face comes out as one polygon for each cell that it touches, triangulated again;
        inner triangles stay unless their planes are given, so the complex stays closed. Points that nothing uses are
        dropped; the surface's vertices stay first.
    """
    inner = solid.source < 0
    needed = np.zeros(len(solid.points), dtype=bool)
    needed[: len(surface.vertices)] = True
    faces = surface.vertices[surface.faces]
    keys = np.column_stack([np.where(inner, -1, solid.source), solid.sides])
    if plane is None:
        again = np.flatnonzero(~inner)
        needed[solid.triangles[inner]] = True
    else:
        keys[inner, 0] = -1 - plane[inner]
        again = np.arange(len(inner))
    rows, group = np.unique(keys[again], axis=0, return_inverse=True)
    group = group.reshape(-1)
    triangles = solid.triangles[again]
    # Three points of each polygon's plane: of the input face, or of the largest inner triangle.
    corner = solid.points[triangles]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    largest = np.lexsort((-area, group))[np.searchsorted(np.sort(group), np.arange(len(rows)))]
    corners = np.where((rows[:, 0] < 0)[:, None, None], corner[largest], faces[np.maximum(rows[:, 0], 0)])
    start, end, owner = _rims(triangles, group)
    if plane is not None:
        needed |= _bends(solid.points, start, end)
    cuts = np.searchsorted(owner, np.arange(len(rows) + 1))
    blocks = [
        triangulate_polygon(solid.points, start[low:high], end[low:high], corners[k], needed)
        for k, (low, high) in enumerate(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
    ]
    kept = np.setdiff1d(np.arange(len(inner)), again)
    made = np.repeat(rows, [len(block) for block in blocks], axis=0)
    triangles = np.vstack([*blocks, solid.triangles[kept]])
    sides = np.vstack([made[:, 1:], solid.sides[kept]])
    source = np.concatenate([np.maximum(made[:, 0], -1), solid.source[kept]])
    needed[triangles] = True
    rank = np.cumsum(needed) - 1
    return Solid(solid.points[needed], rank[triangles], sides, source, solid.volumes, solid.centroids)


def _rims(triangles: IntArray, group: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """List the directed edges around each group of triangles, without the pairs that cancel inside it, by group."""
    start, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    owner = np.repeat(group, 3)
    edge = np.column_stack([np.maximum(start, end), np.minimum(start, end), owner])
    order = np.lexsort(edge.T)
    same = (edge[order][1:] == edge[order][:-1]).all(axis=1)
    rim = np.ones(len(start), dtype=bool)
    rim[order[1:][same]] = rim[order[:-1][same]] = False
    start, end, owner = start[rim], end[rim], owner[rim]
    order = np.argsort(owner, kind="stable")
    return start[order], end[order], owner[order]


def _bends(points: FloatArray, start: IntArray, end: IntArray) -> npt.NDArray[np.bool_]:
    """Mark the points, (P,), where rims branch or turn; a rim that runs straight through a point does not need it."""
    edges = np.unique(np.sort(np.column_stack([start, end]), axis=1), axis=0)
    ends, others = edges.ravel(), edges[:, ::-1].ravel()
    order = np.argsort(ends, kind="stable")
    degree = np.bincount(ends, minlength=len(points))
    first = np.cumsum(degree) - degree
    passed = np.flatnonzero(degree == 2)
    before, after = (points[others[order[first[passed] + k]]] - points[passed] for k in (0, 1))
    before /= np.linalg.norm(before, axis=1)[:, None]
    after /= np.linalg.norm(after, axis=1)[:, None]
    result = degree > 0
    result[passed] = np.linalg.norm(before + after, axis=1) > STRAIGHT
    return np.asarray(result)
