"""Pieces: watertight solids with exact mass properties, built from a labelling of the asset's atoms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..geometry.complex import Hull


@dataclass(frozen=True, eq=False)
class ConvexParts:
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

    def select(self, chosen: Sequence[int]) -> ConvexParts:
        """These of them."""
        points, blocks = tuple(self.points[k] for k in chosen), tuple(self.blocks[k] for k in chosen)
        return ConvexParts(points, blocks, self.scale, self.offset)

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
    convex_parts: ConvexParts
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
