"""A piece of a broken asset as something that breaks in turn; ``BreakableAsset.breakable_piece`` makes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..common.impulse import Impulse, as_impulses
from ..common.material import Material
from .arrays import Domain
from .pieces import ConvexParts, Piece
from .result import Fracture
from .severity import MassProperties

if TYPE_CHECKING:
    from .asset import BreakableAsset


@dataclass(frozen=True, eq=False)
class BreakablePiece:
    """A piece of a broken asset that breaks in turn, by the asset's own model; in the asset's frame.

    Attributes
    ----------
    asset : BreakableAsset
        What the piece comes from.
    piece : Piece
        The piece.
    """

    asset: BreakableAsset
    piece: Piece

    @cached_property
    def domain(self) -> Domain:
        """Its atoms, and the interfaces between them."""
        arrays = self.asset.arrays
        return Domain.of(self.piece.atoms, arrays.interfaces, arrays.moments[0])

    @property
    def name(self) -> str:
        """The asset's name."""
        return self.asset.name

    @property
    def material(self) -> Material:
        """The asset's material."""
        return self.asset.material

    @property
    def size(self) -> float:
        """m, the largest extent of the whole asset."""
        return self.asset.size

    @property
    def mass(self) -> float:
        """Mass, kg."""
        return self.piece.mass

    @property
    def volume_fraction(self) -> float:
        """Its share of the asset's volume."""
        return self.piece.volume / self.asset.volume

    @property
    def center_of_mass(self) -> FloatArray:
        """(3,) m."""
        return self.piece.center_of_mass

    @property
    def convex_parts(self) -> ConvexParts:
        """What an engine collides."""
        return self.piece.convex_parts

    @cached_property
    def reach(self) -> float:
        """m, from the centre of mass to the furthest point of the convex parts."""
        parts = self.piece.convex_parts
        points = np.concatenate(parts.points) * parts.scale + parts.offset
        return float(np.linalg.norm(points - self.piece.center_of_mass, axis=1).max())

    @property
    def bearable_impulse(self) -> float:
        """N·s; impulses that sum to less break nothing, wherever they act."""
        query = self.asset.query
        bound = float(query.weakest[1].min())
        return query.severity.bearable_impulse(bound, self.asset.vertices, self.mass_properties)

    @property
    def severity_kind(self) -> str:
        """What breaks it, as the asset's simulator counts it: "impulse" or "force"."""
        return self.asset.severity_kind

    @property
    def bearable_force(self) -> float:
        """N; lasting forces that sum to less break nothing, wherever they act."""
        return self.asset.bearable_force

    @property
    def mass_properties(self) -> MassProperties:
        """Mass, centre of mass and inertia."""
        return MassProperties(self.piece.mass, self.piece.center_of_mass, self.piece.inertia)

    def compliance_at(self, points: FloatArray) -> FloatArray:
        """Look up how far the asset's surface gives way to forces where the piece has it.

        Parameters
        ----------
        points : ndarray of float64, shape (K, 3)
            m, in the asset's frame.

        Returns
        -------
        ndarray of float64, shape (K,)
            m/N, of the whole asset.
        """
        return self.asset.query.severity.compliance_at(*self.locate(points))

    def may_break(self, impulses: Impulse | Sequence[Impulse]) -> bool:
        """Tell whether impulses can break the piece; asks no model.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in the asset's frame (m, N·s).

        Returns
        -------
        bool
            False where they are surely too weak.
        """
        impulses = as_impulses(impulses)
        if len(self.piece.atoms) == 1:
            return False
        query = self.asset.query
        return query.may_break(query.on_surface(impulses, self.locate, self.mass_properties), whole=False)

    def fracture(
        self, impulses: Impulse | Sequence[Impulse], predictor: str = "field", *, skip_weak: bool = True
    ) -> Fracture:
        """Break the piece.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in the asset's frame (m, N·s).
        predictor : str
            As for `BreakableAsset.fracture`.
        skip_weak : bool
            As for `BreakableAsset.fracture`.

        Returns
        -------
        Fracture
            Its pieces, of the asset's atoms again. The severity counts the piece's own mass.
        """
        query, impulses = self.asset.query, as_impulses(impulses)
        return query.fracture(impulses, predictor, skip_weak, self.domain, self.locate, self.mass_properties)

    def unbroken(self) -> Fracture:
        """Return the answer to no impulse at all; asks no model.

        Returns
        -------
        Fracture
            A single piece.
        """
        return self.asset.query.unbroken(self.domain)

    def breakable_piece(self, piece: Piece) -> BreakablePiece:
        """Make one of its pieces something that breaks in turn.

        Parameters
        ----------
        piece : Piece
            One of the pieces of its fracture.

        Returns
        -------
        BreakablePiece
            The same, as breakable as this one.
        """
        return BreakablePiece(self.asset, piece)

    @cached_property
    def _outside(self) -> tuple[IntArray, cKDTree]:
        """The vertices of the asset's surface that the piece has (all, if it has none), to be found by place."""
        arrays = self.asset.arrays
        mine = np.flatnonzero(np.isin(arrays.vertex_atom, self.piece.atoms))
        mine = mine if len(mine) else np.arange(self.asset.vertex_count)
        return mine, cKDTree(arrays.points[mine])

    def locate(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """Find the vertices of the asset's surface that the piece has and that are nearest to given points.

        An impact on a crack so counts where the surface is nearest.

        Parameters
        ----------
        points : ndarray of float64, shape (K, 3)
            m, in the asset's frame.

        Returns
        -------
        corners : ndarray of int64, shape (K, 3)
            The vertex of each point, three times.
        barycentric : ndarray of float64, shape (K, 3)
            Coordinates that name the first of the three.
        """
        mine, tree = self._outside
        nearest = mine[tree.query((points - self.asset.offset) / self.asset.scale)[1]]
        return np.repeat(nearest[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(points), 1))
