"""Pieces: watertight solids with exact mass properties, built from a labelling of the asset's atoms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Hull = tuple[FloatArray, IntArray]


@dataclass(frozen=True, eq=False)
class Parts:
    """Convex parts as an engine takes them in: point x of a part lies at ``scale`` x + ``offset`` (3,) m.

    points: (n, 3) each. blocks: each as an OBJ group, whose indices count back, so that any of them put one after the
    other are a file. Both are made once an asset, and shared by all sizes of it and all pieces.
    """

    points: tuple[FloatArray, ...]
    blocks: tuple[bytes, ...]
    scale: float
    offset: FloatArray

    @classmethod
    def of(cls, points: Sequence[FloatArray], scale: float = 1.0, offset: FloatArray | None = None) -> Self:
        offset = np.zeros(3) if offset is None else offset
        return cls(tuple(points), tuple(_group(some) for some in points), scale, offset)

    def some(self, chosen: Sequence[int]) -> Parts:
        """These of them."""
        points, blocks = tuple(self.points[k] for k in chosen), tuple(self.blocks[k] for k in chosen)
        return Parts(points, blocks, self.scale, self.offset)

    def __len__(self) -> int:
        return len(self.points)


def _group(points: FloatArray) -> bytes:
    """Only the points matter to a convex part, so it has just the faces that name every point."""
    n = len(points)
    corners = np.arange(-(-n // 3) * 3) % n - n
    text = "o part\n" + "v %.9g %.9g %.9g\n" * n % tuple(points.ravel().tolist())
    return (text + "f %d %d %d\n" * (len(corners) // 3) % tuple(corners.tolist())).encode()


@dataclass(frozen=True, eq=False)
class Piece:
    """One solid fragment of a broken asset, in the asset's frame.

    volume: m³. mass: kg. center_of_mass: (3,) m.
    inertia: (3, 3) kg·m² about the centre of mass, along the asset's axes.
    hulls: convex parts as (vertices (n, 3) m, faces (k, 3)); parts of different pieces are disjoint.
    parts: the same as an engine takes them in. atoms: the indices of the asset's atoms.
    vertices: (N, 3) m. faces: (M, 3), outward, watertight. outer: (M,), which faces are the asset's surface;
    the others are cracks. These three and ``hulls`` are built when first asked for: a headless simulation never does.
    """

    volume: float
    mass: float
    center_of_mass: FloatArray
    inertia: FloatArray
    parts: Parts
    atoms: IntArray
    build_hulls: Callable[[], tuple[Hull, ...]] = field(repr=False)
    build_surface: Callable[[], tuple[FloatArray, IntArray, BoolArray]] = field(repr=False)

    @cached_property
    def hulls(self) -> tuple[Hull, ...]:
        return self.build_hulls()

    @cached_property
    def _surface(self) -> tuple[FloatArray, IntArray, BoolArray]:
        return self.build_surface()

    @property
    def vertices(self) -> FloatArray:
        return self._surface[0]

    @property
    def faces(self) -> IntArray:
        return self._surface[1]

    @property
    def outer(self) -> BoolArray:
        return self._surface[2]


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
        return _part_pinches(self.points[used], inverse.reshape(-1, 3), skin)


def _part_pinches(points: FloatArray, faces: IntArray, skin: BoolArray) -> tuple[FloatArray, IntArray, BoolArray]:
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
