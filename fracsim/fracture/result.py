"""TODO fracture.result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

from ..common.arrays import FloatArray, IntArray
from .arrays import Domain
from .pieces import Piece


@dataclass(frozen=True, eq=False)
class Fracture:
    """What an impact does to an asset.

    pieces: one for each label; a single one is the unbroken body. timings: ms by stage.
    severity: the impulse over mass times breaking velocity; clamped: whether it lay beyond what the model was
    trained on and was lowered to that.
    crack_area: m², of the cracks, each interface's projected on its mean plane.
    labels: (V,), the piece that each vertex lies on; -1 where it lies on none, as the asset is broken already.
    udf: (V,) m, distance to the nearest crack, capped. These two are worked out when first asked for: the pieces
    need the field along the interfaces only.
    """

    pieces: tuple[Piece, ...]
    timings: dict[str, float]
    predictor: str
    severity: float
    clamped: bool
    crack_area: float
    build_labels: Callable[[], IntArray] = field(repr=False)
    build_udf: Callable[[], FloatArray] = field(repr=False)

    @cached_property
    def labels(self) -> IntArray:
        return self.build_labels()

    @cached_property
    def udf(self) -> FloatArray:
        return self.build_udf()

    @property
    def broken(self) -> bool:
        return len(self.pieces) > 1


@dataclass(frozen=True, eq=False)
class Answer:
    """What is known of a fracture before its pieces are."""

    domain: Domain
    predictor: str
    severity: float
    clamped: bool
    timings: dict[str, float]
