"""What an impact does to an asset, as plain data; physics and a user read it.

Labels and field at the vertices are worked out when first asked for, or when a fracture is pickled or copied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .arrays import AssetArrays, Domain
from .pieces import Piece
from .predictor import field_from_scores


@dataclass(frozen=True, eq=False)
class VertexAnswer:
    """A fracture at the vertices of the surface, worked out.

    Attributes
    ----------
    labels : ndarray of int64, shape (V,)
        The piece of each vertex; -1 on atoms that are not part of what was struck.
    udf : ndarray of float64, shape (V,)
        m, distance to the nearest crack, capped.
    """

    labels: IntArray
    udf: FloatArray


@dataclass(frozen=True, eq=False)
class LateVertexAnswer:
    """What a fracture at the vertices follows from; labels and field are worked out when first asked for.

    It refers to arrays of the asset. Pickled or copied it becomes a `VertexAnswer`, which does not.

    Attributes
    ----------
    arrays : AssetArrays
        Those of the asset.
    domain : Domain
        The atoms and interfaces of what was struck.
    atom_labels : ndarray of int64, shape (A,)
        The piece of each of these atoms.
    values : ndarray of float64, shape (I,) or (V,)
        What the field follows from: the minimax score of each of these interfaces, or the field itself, in units of
        the largest extent, where a user gave it.
    are_scores : bool
        Which of the two.
    cap : float
        The largest value of the field, in units of the largest extent.
    scale : float
        m, the asset's largest extent.
    """

    arrays: AssetArrays
    domain: Domain
    atom_labels: IntArray
    values: FloatArray
    are_scores: bool
    cap: float
    scale: float

    @cached_property
    def labels(self) -> IntArray:
        """As `VertexAnswer.labels`."""
        of_atom = np.full(self.arrays.complex.count, -1)
        of_atom[self.domain.atoms] = self.atom_labels
        return of_atom[self.arrays.vertex_atom]

    @cached_property
    def udf(self) -> FloatArray:
        """As `VertexAnswer.udf`."""
        if not self.are_scores:
            return self.values * self.scale
        distances = self.arrays.distances[self.domain.interface_indices]
        return field_from_scores(self.values, distances, self.cap) * self.scale

    def __reduce__(self) -> tuple[Callable[..., VertexAnswer], tuple[Any, ...]]:
        return VertexAnswer, (self.labels, self.udf)


@dataclass(frozen=True, eq=False)
class Fracture:
    """What an impact does to an asset; plain data, which pickles and copies.

    Attributes
    ----------
    pieces : tuple of Piece
        One for each label; a single one is the unbroken body.
    timings : dict of str to float
        ms by stage.
    predictor : str
        What answered: "field", "interfaces", "simulator"; "given" for a user's field, "none" for no impulse.
    severity : float
        The sum of those of the impulses (`fracsim.fracture.severity`); of a piece that counts impulses, by its mass.
    clamped : bool
        Whether the severity lay beyond what the model was trained on, and was lowered to that.
    crack_area : float
        m², of the cracks, each interface's area projected on its mean plane.
    at_vertices : LateVertexAnswer or VertexAnswer
        Labels and field; the pieces need the field along the interfaces only.
    """

    pieces: tuple[Piece, ...]
    timings: dict[str, float]
    predictor: str
    severity: float
    clamped: bool
    crack_area: float
    at_vertices: LateVertexAnswer | VertexAnswer = field(repr=False)

    @property
    def labels(self) -> IntArray:
        """(V,) the piece of each vertex; -1 on atoms that are not part of what was struck."""
        return self.at_vertices.labels

    @property
    def udf(self) -> FloatArray:
        """(V,) m, the unsigned distance field: how far the nearest crack is along the surface, capped."""
        return self.at_vertices.udf

    @property
    def broken(self) -> bool:
        """Whether there is more than one piece."""
        return len(self.pieces) > 1
