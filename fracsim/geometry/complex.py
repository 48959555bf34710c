"""A solid as a conforming complex of cells; every room above uses it to measure cells and to read off surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray

CHUNK = 10_000  # triangles that points are looked for above at a time, for memory
Hull = tuple[FloatArray, IntArray]  # vertices (n, 3) and faces (k, 3) of a convex part


def vertex_cells(triangles: IntArray, sides: IntArray, count: int) -> IntArray:
    """Find the cell behind the outer triangles at each point of a complex.

    Parameters
    ----------
    triangles : ndarray of int64, shape (M, 3)
        Indices of points.
    sides : ndarray of int64, shape (M, 2)
        The cells behind and before each triangle; -1 is outside.
    count : int
        P, the number of points.

    Returns
    -------
    ndarray of int64, shape (P,)
        The cell of each point; -1 for points that lie inside.
    """
    result = np.full(count, -1)
    outer = sides[:, 1] < 0
    result[triangles[outer]] = sides[outer, :1]
    return result


@dataclass(frozen=True, eq=False)
class CellComplex:
    """A solid divided into cells, whose triangles meet edge to edge; any group of cells is read off it.

    The cells are those that a solid was cut into, or the atoms of an asset, which are unions of them.

    Attributes
    ----------
    points : ndarray of float64, shape (P, 3)
        The first V are the vertices of the surface, in order.
    triangles : ndarray of int64, shape (M, 3)
        Indices of points. The normal points from the cell behind to the cell before, so outer triangles face outward.
    sides : ndarray of int64, shape (M, 2)
        The cells behind and before each triangle; -1 is outside.
    """

    points: FloatArray
    triangles: IntArray
    sides: IntArray

    @property
    def count(self) -> int:
        """C, the number of cells."""
        return int(self.sides.max()) + 1

    def vertex_cells(self, vertices: int) -> IntArray:
        """Find the cell on which each vertex of the surface lies.

        Parameters
        ----------
        vertices : int
            V, how many of the points are vertices of the surface.

        Returns
        -------
        ndarray of int64, shape (V,)
            The cell of each vertex.
        """
        return vertex_cells(self.triangles, self.sides, len(self.points))[:vertices]

    def cells_at(self, points: FloatArray) -> IntArray:
        """Find the cell that each of many points lies in.

        Parameters
        ----------
        points : ndarray of float64, shape (K, 3)
            Anywhere; on a face, either side of it may be the answer.

        Returns
        -------
        ndarray of int64, shape (K,)
            The cell of each point; -1 outside.

        Notes
        -----
        The last triangle below a point, along z, has the point's cell on its upper side.
        """
        order = np.argsort(points[:, 0], kind="stable")
        chunks = range(0, len(self.triangles), CHUNK)
        found = [_triangles_below(points[order], self.points[self.triangles[at : at + CHUNK]]) for at in chunks]
        face = np.concatenate([rows + at for at, (rows, *_) in zip(chunks, found, strict=True)])
        point, height, upward = (np.concatenate([parts[k] for parts in found]) for k in (1, 2, 3))
        last = np.lexsort((height, point))
        face, point, upward = face[last], point[last], upward[last]
        result = np.full(len(points), -1)
        # Of one point's triangles, the highest is assigned last and stays.
        result[order[point]] = np.where(upward, self.sides[face, 1], self.sides[face, 0])
        return result

    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Integrate over every cell; exact for polyhedra.

        Returns
        -------
        volumes : ndarray of float64, shape (C,)
            ∫ 1.
        first : ndarray of float64, shape (C, 3)
            ∫ x.
        second : ndarray of float64, shape (C, 3, 3)
            ∫ x xᵀ.

        Notes
        -----
        By the divergence theorem: the signed sum over the tetrahedra that the triangles span with the origin.
        """
        count = self.count
        volume, first, second = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
        for side, sign in ((0, 1.0), (1, -1.0)):
            rows = np.flatnonzero(self.sides[:, side] >= 0)
            cell = self.sides[rows, side]
            corner = self.points[self.triangles[rows]]
            weight = sign * np.linalg.det(corner) / 6
            total = corner.sum(axis=1)
            np.add.at(volume, cell, weight)
            np.add.at(first, cell, weight[:, None] * total / 4)
            outer = np.einsum("nki,nkj->nij", corner, corner) + np.einsum("ni,nj->nij", total, total)
            np.add.at(second, cell, weight[:, None, None] * outer / 20)
        return volume, first, second

    def surface(self, chosen: BoolArray) -> tuple[FloatArray, IntArray, BoolArray]:
        """Read off the boundary of a group of cells, as a watertight mesh.

        Parameters
        ----------
        chosen : ndarray of bool, shape (C,)
            The cells that belong to the group.

        Returns
        -------
        vertices : ndarray of float64, shape (N, 3)
            Its vertices.
        faces : ndarray of int64, shape (K, 3)
            Its faces, outward.
        outer : ndarray of bool, shape (K,)
            Which faces lie on the surface of the whole; the others border on cells that are not chosen.
        """
        inside = np.append(chosen, False)[self.sides]  # outside is cell -1, hence the appended one
        back, front = inside[:, 0] & ~inside[:, 1], inside[:, 1] & ~inside[:, 0]
        faces = np.vstack([self.triangles[back], self.triangles[front][:, ::-1]])
        skin = np.concatenate([self.sides[back, 1] < 0, np.zeros(int(front.sum()), dtype=bool)])
        used, inverse = np.unique(faces, return_inverse=True)
        return separate_pinched_edges(self.points[used], inverse.reshape(-1, 3), skin)


def _triangles_below(points: FloatArray, triangles: FloatArray) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Find the triangles (M, 3, 3) below points (K, 3) of rising x: pairs of both, the height, and who faces up."""
    x, y, z = points.T
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.moveaxis(triangles, 0, -1)
    # A point and a triangle may meet only if the point's x and y lie within the triangle's.
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    begin = np.searchsorted(x, low[:, 0])
    count = np.searchsorted(x, high[:, 0], side="right") - begin
    face = np.repeat(np.arange(len(triangles)), count)
    point = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count) + begin[face]
    near = (y[point] >= low[face, 1]) & (y[point] <= high[face, 1])
    face, point = face[near], point[near]
    u = (bx[face] - x[point]) * (cy[face] - y[point]) - (by[face] - y[point]) * (cx[face] - x[point])
    v = (cx[face] - x[point]) * (ay[face] - y[point]) - (cy[face] - y[point]) * (ax[face] - x[point])
    w = (ax[face] - x[point]) * (by[face] - y[point]) - (ay[face] - y[point]) * (bx[face] - x[point])
    area = u + v + w  # twice that of the triangle seen along z; positive where its normal points up
    over = (((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))) & (area != 0)
    face, point, area = face[over], point[over], area[over]
    height = (u[over] * az[face] + v[over] * bz[face] + w[over] * cz[face]) / area
    below = height <= z[point]
    return face[below], point[below], height[below], area[below] > 0


def mass_of_moments(
    zeroth: float, first: FloatArray, second: FloatArray, density: float, scale: float, offset: FloatArray
) -> tuple[float, float, FloatArray, FloatArray]:
    """Turn the moments of a body into its mass properties.

    Parameters
    ----------
    zeroth : float
        ∫ 1, in units of the largest extent.
    first : ndarray of float64, shape (3,)
        ∫ x.
    second : ndarray of float64, shape (3, 3)
        ∫ x xᵀ.
    density : float
        kg/m³.
    scale : float
        m, the largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the origin of these units lies.

    Returns
    -------
    volume : float
        m³.
    mass : float
        kg.
    center : ndarray of float64, shape (3,)
        m, the centre of mass.
    inertia : ndarray of float64, shape (3, 3)
        kg·m² about the centre of mass.
    """
    center = first / zeroth
    spread = second - zeroth * np.outer(center, center)
    volume = float(zeroth) * scale**3
    inertia = (np.trace(spread) * np.eye(3) - spread) * (density * scale**5)
    return volume, volume * density, center * scale + offset, inertia


def separate_pinched_edges(
    points: FloatArray, faces: IntArray, skin: BoolArray
) -> tuple[FloatArray, IntArray, BoolArray]:
    """Make every edge of a closed mesh one of exactly two faces, without a change of shape.

    Cells of one group may meet along an edge only, which then has four faces. Each of its two wedges gets a point of
    its own on that edge, at different places, so that they share no edge.

    Parameters
    ----------
    points : ndarray of float64, shape (N, 3)
        The vertices.
    faces : ndarray of int64, shape (K, 3)
        The faces; every edge has an even number of them.
    skin : ndarray of bool, shape (K,)
        A flag of each face, which the faces that it is split into keep.

    Returns
    -------
    points, faces, skin : tuple of ndarray
        The same mesh with more vertices and faces.
    """
    while True:
        start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
        key = np.minimum(start, end) * len(points) + np.maximum(start, end)
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        third = np.flatnonzero(ordered[2:] == ordered[:-2])
        if len(third) == 0:
            return points, faces, skin
        # A triangle may have two pinched edges, so they are mended one after the other.
        halves = order[ordered == ordered[third[0]]]
        low, high = divmod(int(ordered[third[0]]), len(points))
        axis = points[high] - points[low]
        rows = halves // 3
        tips = faces[rows, (halves + 2) % 3]
        arms = points[tips] - points[low]
        arms -= np.outer(arms @ axis, axis) / (axis @ axis)
        arms /= np.linalg.norm(arms, axis=1)[:, None]
        side = np.cross(axis, arms[0]) / np.linalg.norm(axis)
        angle = np.arctan2(arms @ side, arms @ arms[0]) % (2 * np.pi)
        forward = start[halves] == low
        new_points, new_faces, new_skin = [points], [np.delete(faces, rows, axis=0)], [np.delete(skin, rows)]
        count = len(points)
        # Seen along the axis from low to high, a face that runs forward has the solid clockwise of it; its wedge
        # ends at the first backward face that way.
        free = set(np.flatnonzero(~forward).tolist())
        for k in np.flatnonzero(forward).tolist():
            mate = min(free, key=lambda j: (angle[k] - angle[j]) % (2 * np.pi))
            free.discard(mate)
            new_points.append((points[low] + axis * (len(new_points) / (len(halves) // 2 + 1)))[None])
            for j in (k, mate):
                a, b, c = start[halves[j]], end[halves[j]], tips[j]
                new_faces.append(np.array([[a, count, c], [count, b, c]]))
                new_skin.append(np.repeat(skin[rows[j]], 2))
            count += 1
        points, faces, skin = np.vstack(new_points), np.vstack(new_faces), np.concatenate(new_skin)
