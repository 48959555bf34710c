"""The faces at which the cells of a solid meet, measured for the springs and cracks of a lattice. Offline only.

``lattice`` joins rigid cells with springs over them; the lattice simulators run their cracks along them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..solids.solid import Solid, sum_by_index
from .base import interfaces_between

CORNERS = 16  # of a face that are kept at most; of more, those farthest in so many directions
SKEWED = 0.5  # of the distance of two centroids: a shorter projection on the normal is no length of a spring
SHORTEST = 0.25  # of the smaller cell's size: no two centroids count as nearer


@dataclass(frozen=True, eq=False)
class CellFaces:
    """The I faces between neighbouring cells of a solid, one for each pair of cells that share an area.

    Lengths are in units of the largest extent.

    Attributes
    ----------
    pairs : ndarray of int64, shape (I, 2)
        The two cells, the smaller index first, in the order of ``interfaces_between``.
    areas : ndarray of float64, shape (I,)
        What they share.
    centroids : ndarray of float64, shape (I, 3)
        Of the area.
    normals : ndarray of float64, shape (I, 3)
        Unit vectors from the first cell to the second; the mean where a face is not planar.
    second_moments : ndarray of float64, shape (I, 3, 3)
        ∫ y yᵀ dA, y the position from the centroid, projected along the normal where the face is not planar.
    spring_lengths : ndarray of float64, shape (I,)
        The distance of the two cells' centroids along the normal.
    corners : ndarray of float64, shape (I, K, 3)
        Corners of the face's outline, from the centroid; K is at most CORNERS. The first is repeated at the end of
        faces that have fewer.
    corner_counts : ndarray of int64, shape (I,)
        How many corners are the face's own.
    fronts : ndarray of int64, shape (E, 3)
        Triples of faces, in ascending order, that meet along an inner edge with exactly three cells around it. A crack
        that is one of them ends there and can go on along either of the others.
    """

    pairs: IntArray
    areas: FloatArray
    centroids: FloatArray
    normals: FloatArray
    second_moments: FloatArray
    spring_lengths: FloatArray
    corners: FloatArray
    corner_counts: IntArray
    fronts: IntArray

    def __len__(self) -> int:
        """I, the number of faces."""
        return len(self.areas)


def cell_faces(solid: Solid) -> CellFaces:
    """Measure the faces between the cells of a solid.

    Parameters
    ----------
    solid : Solid
        Of C cells.

    Returns
    -------
    CellFaces
        One face for each pair of cells that share an area.

    Notes
    -----
    A spring is as long as the two centroids are apart along the normal, so that a uniform strain moves both sides of
    every face alike. Where cells lie so askew that this is less than half their distance, the distance is taken.
    """
    interfaces = interfaces_between(solid)
    pairs, areas = interfaces.pairs, interfaces.areas
    count = len(pairs)
    inner = np.flatnonzero((solid.sides >= 0).all(axis=1) & (solid.sides[:, 0] != solid.sides[:, 1]))
    triangles = solid.triangles[inner]
    ordered = np.sort(solid.sides[inner], axis=1)
    face = np.searchsorted(pairs[:, 0] * solid.count + pairs[:, 1], ordered[:, 0] * solid.count + ordered[:, 1])
    corner = solid.points[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    centroids = sum_by_index(face, area[:, None] * corner.mean(axis=1), count) / areas[:, None]
    arm = corner - centroids[face, None]
    arm -= np.einsum("nki,ni->nk", arm, interfaces.normals[face])[:, :, None] * interfaces.normals[face, None]
    total = arm.sum(axis=1)
    outer = np.einsum("nki,nkj->nij", arm, arm) + np.einsum("ni,nj->nij", total, total)
    moments = sum_by_index(face, (area[:, None, None] * outer / 12).reshape(-1, 9), count).reshape(-1, 3, 3)
    across = solid.centroids[pairs[:, 1]] - solid.centroids[pairs[:, 0]]
    along = np.einsum("fi,fi->f", across, interfaces.normals)
    size = np.cbrt(solid.volumes[pairs].min(axis=1))
    distance = np.maximum(np.linalg.norm(across, axis=1), SHORTEST * size)
    lengths = np.where(along < SKEWED * distance, distance, along)
    rim = _rim(triangles, face)
    corners, counts = _corners(solid.points, rim, centroids, interfaces.normals)
    fronts = _fronts(solid.triangles, inner, face)
    return CellFaces(pairs, areas, centroids, interfaces.normals, moments, lengths, corners, counts, fronts)


def _edges(triangles: IntArray) -> IntArray:
    """List the edges of triangles, (3 N, 2), the smaller point first; those of a triangle follow each other."""
    return np.asarray(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1))


def _rim(triangles: IntArray, face: IntArray) -> IntArray:
    """List each face and the points on its outline, (N, 2), unique and sorted."""
    edges = np.column_stack([np.repeat(face, 3), _edges(triangles)])
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    once = unique[counts == 1]
    return np.asarray(np.unique(np.vstack([once[:, [0, 1]], once[:, [0, 2]]]), axis=0))


def _corners(
    points: FloatArray, rim: IntArray, centroids: FloatArray, normals: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Choose at most CORNERS points of each face's outline: (I, K, 3) from the centroid, and how many, (I,)."""
    count = len(centroids)
    face, arm = rim[:, 0], points[rim[:, 1]] - centroids[rim[:, 0]]
    # Axes in the plane of each face: the coordinate axis that is least along the normal, made square to it.
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normals, first)
    u, v = np.einsum("ni,ni->n", arm, first[face]), np.einsum("ni,ni->n", arm, second[face])
    chosen = np.bincount(face, minlength=count)[face] <= CORNERS
    for angle in 2 * np.pi * np.arange(CORNERS) / CORNERS:
        reach = u * np.cos(angle) + v * np.sin(angle)
        order = np.lexsort((-reach, face))
        chosen[order[np.searchsorted(face[order], np.arange(count))]] = True
    face, arm = face[chosen], arm[chosen]
    counts = np.bincount(face, minlength=count)
    start = np.cumsum(counts) - counts
    step = np.arange(int(counts.max()))
    rows = start[:, None] + np.where(step < counts[:, None], step, 0)
    return arm[rows], counts.astype(np.int64)


def _fronts(triangles: IntArray, inner: IntArray, face: IntArray) -> IntArray:
    """Find the triples of faces around inner edges of three cells: (E, 3)."""
    on_face = np.full(len(triangles), -1)
    on_face[inner] = face
    edges = _edges(triangles)
    _, edge, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    around = np.repeat(on_face, 3)
    order = np.lexsort((around, edge))
    start = np.cumsum(counts) - counts
    three = order[start[counts == 3][:, None] + np.arange(3)]
    triples = around[three]  # sorted, as the order is
    inside = triples[:, 0] >= 0
    return np.asarray(np.unique(triples[inside], axis=0))
