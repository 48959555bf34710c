"""TODO common.checks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .arrays import FloatArray
from .errors import PhysicsError

Vector = Sequence[float] | FloatArray


def is_number(value: object) -> bool:
    try:
        return bool(np.isfinite(value))  # type: ignore[call-overload]
    except (TypeError, ValueError):
        return False


def at_least(value: float, least: float, name: str) -> float:
    if not is_number(value) or value < least:
        raise PhysicsError(f"{name} must be a number of at least {least:g}, got {value!r}")
    return float(value)


def vector_of(value: object, count: int) -> FloatArray | None:
    """(count,) what somebody gave, NaN and infinity included; None where it is not so many numbers."""
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return vector if vector.shape == (count,) else None


def finite_vector(value: Vector, name: str, length: int) -> FloatArray:
    vector = vector_of(value, length)
    if vector is None or not np.isfinite(vector).all():
        raise PhysicsError(f"{name} must be {length} finite numbers, got {value}")
    return vector
