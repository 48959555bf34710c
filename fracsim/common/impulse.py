"""Impulses: what a contact hands to the fracture model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .arrays import FloatArray
from .errors import ImpulseError


def _vector(value: object, name: str) -> FloatArray:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ImpulseError(f"impulse {name} must be three numbers, got {value!r}") from error
    if vector.shape != (3,):
        raise ImpulseError(f"impulse {name} must have shape (3,), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise ImpulseError(f"impulse {name} must be finite, got {vector.tolist()}")
    vector.setflags(write=False)
    return vector


@dataclass(frozen=True, eq=False)
class Impulse:
    """An impulse on an asset, in the asset's own frame.

    point: (3,) m, where it acts; a query uses the nearest point of the surface.
    direction: (3,), the way the body is pushed; normalised here.
    magnitude: N·s, at least 0.

    Raises ImpulseError on a wrong shape, a zero direction, or a value that is not finite.
    """

    point: FloatArray
    direction: FloatArray
    magnitude: float

    def __post_init__(self) -> None:
        direction = _vector(self.direction, "direction")
        largest = float(np.abs(direction).max())
        if largest == 0.0:
            raise ImpulseError("impulse direction is zero; give the way the body is pushed")
        direction = direction / largest  # first, so that the norm neither overflows nor vanishes
        direction = direction / np.linalg.norm(direction)
        direction.setflags(write=False)
        try:
            magnitude = float(self.magnitude)
        except (TypeError, ValueError) as error:
            raise ImpulseError(f"impulse magnitude must be a number, got {self.magnitude!r}") from error
        if not (np.isfinite(magnitude) and magnitude >= 0.0):
            raise ImpulseError(f"impulse magnitude must be finite and at least 0 N·s, got {magnitude}")
        object.__setattr__(self, "point", _vector(self.point, "point"))
        object.__setattr__(self, "direction", direction)
        object.__setattr__(self, "magnitude", magnitude)


def as_impulses(impulses: Impulse | Sequence[Impulse]) -> tuple[Impulse, ...]:
    """One impulse, or several acting together, as a non-empty tuple."""
    result = (impulses,) if isinstance(impulses, Impulse) else tuple(impulses)
    if not result:
        raise ImpulseError("no impulse given; pass one Impulse or a non-empty sequence of them")
    for item in result:
        if not isinstance(item, Impulse):
            raise ImpulseError(f"expected fracsim.Impulse, got {type(item).__name__}")
    return result
