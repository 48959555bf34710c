"""Checks of numbers and vectors that a user passes in; called once, where a public function begins.

Every room may use them; the caller says which error of fracsim a wrong value raises.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .arrays import FloatArray
from .errors import FracsimError, PhysicsError

Vector = Sequence[float] | FloatArray


def is_number(value: object) -> bool:
    """Whether a value is one finite number.

    Parameters
    ----------
    value : object
        Anything that a user passed in.

    Returns
    -------
    bool
        False for NaN, infinity, and whatever is no number.
    """
    try:
        return bool(np.isfinite(value))  # type: ignore[call-overload]
    except (TypeError, ValueError):
        return False


def at_least(value: float, minimum: float, name: str, error: type[FracsimError] = PhysicsError) -> float:
    """Return a finite number that is not below a minimum.

    Parameters
    ----------
    value : float
        The number to check.
    minimum : float
        The smallest number allowed.
    name : str
        What the number is called in the message.
    error : type of FracsimError
        What to raise.

    Returns
    -------
    float
        The number.

    Raises
    ------
    FracsimError
        Of the type ``error``, if the value is no finite number or is below ``minimum``.
    """
    if not is_number(value) or value < minimum:
        raise error(f"{name} must be a number of at least {minimum:g}, got {value!r}")
    return float(value)


def vector_of(value: object, length: int) -> FloatArray | None:
    """Read a vector of a known length; NaN and infinity are let through.

    Parameters
    ----------
    value : object
        Anything that a user passed in.
    length : int
        How many numbers it must hold.

    Returns
    -------
    ndarray of float64, shape (length,), or None
        A copy of the values; None if they are not that many numbers.
    """
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return vector if vector.shape == (length,) else None


def finite_vector(value: Vector, name: str, length: int = 3, error: type[FracsimError] = PhysicsError) -> FloatArray:
    """Return a vector of finite numbers.

    Parameters
    ----------
    value : array_like, shape (length,)
        The numbers to check.
    name : str
        What the vector is called in the message.
    length : int
        How many numbers it must hold.
    error : type of FracsimError
        What to raise.

    Returns
    -------
    ndarray of float64, shape (length,)
        A copy of the values.

    Raises
    ------
    FracsimError
        Of the type ``error``, if the values are not ``length`` finite numbers.
    """
    vector = vector_of(value, length)
    if vector is None or not np.isfinite(vector).all():
        raise error(f"{name} must be {length} finite numbers, got {value}")
    return vector
