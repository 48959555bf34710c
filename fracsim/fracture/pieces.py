"""Pieces of a broken asset, as plain data; physics makes bodies of them, and a user draws or saves them.

A piece's surface and hulls are worked out when first asked for, or when it is pickled or copied.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..geometry.complex import CellComplex, Hull


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """Convex parts as an engine takes them in, made once an asset and shared by all sizes and pieces of it.

    Attributes
    ----------
    points : tuple of ndarray of float64, shape (n, 3) each
        The corners of each part; such a point x lies at ``scale * x + offset``.
    blocks : tuple of bytes
        Each part as an OBJ group. Its indices count back, so that any of them put one after the other are a file.
    scale : float
        m, the unit of the points.
    offset : ndarray of float64, shape (3,)
        m, where the origin of the points lies.
    """

    points: tuple[FloatArray, ...]
    blocks: tuple[bytes, ...]
    scale: float
    offset: FloatArray

    @classmethod
    def of(cls, points: Sequence[FloatArray], scale: float = 1.0, offset: FloatArray | None = None) -> Self:
        """Make them of their corners.

        Parameters
        ----------
        points : sequence of ndarray of float64, shape (n, 3) each
            The corners of each part.
        scale : float
            m, the unit of the points.
        offset : ndarray of float64, shape (3,), optional
            m, where the origin of the points lies; the frame's own origin by default.

        Returns
        -------
        ConvexParts
            The parts.
        """
        offset = np.zeros(3) if offset is None else offset
        return cls(tuple(points), tuple(_obj_group(corners) for corners in points), scale, offset)

    def select(self, chosen: Sequence[int]) -> ConvexParts:
        """Return some of the parts.

        Parameters
        ----------
        chosen : sequence of int
            Which, in order.

        Returns
        -------
        ConvexParts
            These parts; they share the arrays.
        """
        points, blocks = tuple(self.points[k] for k in chosen), tuple(self.blocks[k] for k in chosen)
        return ConvexParts(points, blocks, self.scale, self.offset)

    def __len__(self) -> int:
        return len(self.points)


def _obj_group(points: FloatArray) -> bytes:
    """Only the points matter to a convex part, so it has just the faces that name every point."""
    n = len(points)
    corners = np.arange(-(-n // 3) * 3) % n - n
    text = "o part\n" + "v %.9g %.9g %.9g\n" * n % tuple(points.ravel().tolist())
    return (text + "f %d %d %d\n" * (len(corners) // 3) % tuple(corners.tolist())).encode()


@dataclass(frozen=True, eq=False)
class PieceShape:
    """What a piece looks like, worked out.

    Attributes
    ----------
    hulls : tuple of (ndarray of float64, shape (n, 3); ndarray of int64, shape (k, 3))
        m, vertices and faces of its convex parts.
    surface : (ndarray of float64, shape (N, 3); ndarray of int64, shape (M, 3); ndarray of bool, shape (M,))
        m, vertices, faces, and which faces lie on the asset's surface.
    """

    hulls: tuple[Hull, ...]
    surface: tuple[FloatArray, IntArray, BoolArray]


@dataclass(frozen=True, eq=False)
class LatePieceShape:
    """What a piece's shape follows from; each part of it is worked out when first asked for.

    It refers to arrays of the asset. Pickled or copied it becomes a `PieceShape`, which does not.

    Attributes
    ----------
    complex : CellComplex
        The asset's atoms, in units of its largest extent.
    atoms : ndarray of int64, shape (n,)
        Those that the piece consists of.
    unit_hulls : tuple of (ndarray of float64, shape (n, 3); ndarray of int64, shape (k, 3))
        Vertices and faces of all atoms' convex parts, in units of the largest extent.
    chosen : sequence of int
        Those of the piece.
    scale : float
        m, the asset's largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the origin of these units lies.
    """

    complex: CellComplex
    atoms: IntArray
    unit_hulls: tuple[Hull, ...]
    chosen: Sequence[int]
    scale: float
    offset: FloatArray

    @cached_property
    def hulls(self) -> tuple[Hull, ...]:
        """As `PieceShape.hulls`."""
        chosen = (self.unit_hulls[k] for k in self.chosen)
        return tuple((points * self.scale + self.offset, faces) for points, faces in chosen)

    @cached_property
    def surface(self) -> tuple[FloatArray, IntArray, BoolArray]:
        """As `PieceShape.surface`."""
        vertices, faces, outer = self.complex.surface(np.isin(np.arange(self.complex.count), self.atoms))
        return vertices * self.scale + self.offset, faces, outer

    def __reduce__(self) -> tuple[Callable[..., PieceShape], tuple[Any, ...]]:
        return PieceShape, (self.hulls, self.surface)


@dataclass(frozen=True, eq=False)
class Piece:
    """One solid piece of a broken asset, in the asset's frame; plain data, which pickles and copies.

    Attributes
    ----------
    volume : float
        m³.
    mass : float
        kg.
    center_of_mass : ndarray of float64, shape (3,)
        m.
    inertia : ndarray of float64, shape (3, 3)
        kg·m² about the centre of mass, along the asset's axes.
    convex_parts : ConvexParts
        What an engine collides.
    atoms : ndarray of int64, shape (n,)
        Which of the asset's atoms it consists of.
    shape : LatePieceShape or PieceShape
        Its surface and its hulls; a simulation without a window never asks for them.
    """

    volume: float
    mass: float
    center_of_mass: FloatArray
    inertia: FloatArray
    convex_parts: ConvexParts
    atoms: IntArray
    shape: LatePieceShape | PieceShape = field(repr=False)

    @property
    def hulls(self) -> tuple[Hull, ...]:
        """Convex parts, as vertices (n, 3) in m and faces (k, 3) each; those of different pieces are disjoint."""
        return self.shape.hulls

    @property
    def vertices(self) -> FloatArray:
        """(N, 3) m, of the watertight surface."""
        return self.shape.surface[0]

    @property
    def faces(self) -> IntArray:
        """(M, 3) indices of vertices, outward."""
        return self.shape.surface[1]

    @property
    def outer(self) -> BoolArray:
        """(M,) which faces lie on the asset's surface; the others are cracks."""
        return self.shape.surface[2]
