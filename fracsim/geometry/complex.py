"""TODO geometry.complex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray

Hull = tuple[FloatArray, IntArray]


def vertex_cells(triangles: IntArray, sides: IntArray, count: int) -> IntArray:
    """(P,) the cell behind the outer triangles at each of a complex's ``count`` points, -1 where there is none."""
    result = np.full(count, -1)
    outer = sides[:, 1] < 0
    result[triangles[outer]] = sides[outer, :1]
    return result


@dataclass(frozen=True, eq=False)
class AtomComplex:
    """The asset's atoms as one conforming complex, from which any grouping of them is read off.

    points: (P, 3), the first V being the surface's vertices. triangles: (M, 3). sides: (M, 2), the atoms
    behind and before each triangle; -1 is outside. Lengths are in units of the largest extent.
    """

    points: FloatArray
    triangles: IntArray
    sides: IntArray

    @property
    def count(self) -> int:
        return int(self.sides.max()) + 1

    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Per atom ∫1 (A,), ∫x (A, 3) and ∫xxᵀ (A, 3, 3), exact for polyhedra (divergence theorem)."""
        count = self.count
        volume, first, second = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
        for side, sign in ((0, 1.0), (1, -1.0)):
            rows = np.flatnonzero(self.sides[:, side] >= 0)
            atom = self.sides[rows, side]
            corner = self.points[self.triangles[rows]]
            weight = sign * np.linalg.det(corner) / 6
            total = corner.sum(axis=1)
            np.add.at(volume, atom, weight)
            np.add.at(first, atom, weight[:, None] * total / 4)
            outer = np.einsum("nki,nkj->nij", corner, corner) + np.einsum("ni,nj->nij", total, total)
            np.add.at(second, atom, weight[:, None, None] * outer / 20)
        return volume, first, second

    def surface(self, chosen: BoolArray) -> tuple[FloatArray, IntArray, BoolArray]:
        """The boundary of a group of atoms: vertices (N, 3), faces (M, 3), and which are the asset's surface.

        chosen: (A,), the atoms that belong to it.
        """
        inside = np.append(chosen, False)[self.sides]  # outside is atom -1, hence the appended one
        back, front = inside[:, 0] & ~inside[:, 1], inside[:, 1] & ~inside[:, 0]
        faces = np.vstack([self.triangles[back], self.triangles[front][:, ::-1]])
        skin = np.concatenate([self.sides[back, 1] < 0, np.zeros(int(front.sum()), dtype=bool)])
        used, inverse = np.unique(faces, return_inverse=True)
        return separate_pinched_edges(self.points[used], inverse.reshape(-1, 3), skin)


def separate_pinched_edges(
    points: FloatArray, faces: IntArray, skin: BoolArray
) -> tuple[FloatArray, IntArray, BoolArray]:
    """Make every edge one of exactly two faces.

    Atoms of one piece may meet along an edge only, which then has four faces. Each of its two wedges gets a
    point of its own on that edge, at different places, so that they share no edge and no shape changes.
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
