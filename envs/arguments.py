"""What the environments check of the arguments that somebody gives; each check returns the value in its proper type."""

from __future__ import annotations

from numbers import Real
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from fracsim import FracsimError


@runtime_checkable
class Scalable(Protocol):
    """An object that can be made in the size that somebody asks for; `World.add` checks the rest of it."""

    @property
    def size(self) -> float:
        """Largest extent, m."""

    def scaled(self, scale: float) -> Scalable:
        """Make the same object, `scale` times as large."""


def positive(value: object, name: str) -> float:
    """Require a positive number.

    Parameters
    ----------
    value : object
        What somebody gave.
    name : str
        Name of the argument, for the message.

    Returns
    -------
    float
        The number.

    Raises
    ------
    FracsimError
        Where it is none, not finite, or not positive.
    """
    if not (isinstance(value, Real) and 0.0 < float(value) < np.inf):
        raise FracsimError(f"{name} must be a positive number, got {value!r}")
    return float(value)


def whole(value: object, name: str) -> int:
    """Require a whole positive number.

    Parameters
    ----------
    value : object
        What somebody gave.
    name : str
        Name of the argument, for the message.

    Returns
    -------
    int
        The number.

    Raises
    ------
    FracsimError
        Where it is no positive number, or has a fraction.
    """
    number = positive(value, name)
    if not number.is_integer():
        raise FracsimError(f"{name} must be a whole number, got {value!r}")
    return int(number)


def numbers(value: object, count: int, name: str) -> npt.NDArray[np.float64]:
    """Require so many numbers; infinity is one.

    Parameters
    ----------
    value : object
        What somebody gave.
    count : int
        How many numbers it should be.
    name : str
        Name of the argument, for the message.

    Returns
    -------
    ndarray of float64, shape (count,)
        The numbers.

    Raises
    ------
    FracsimError
        Where it is of another shape, no numbers, or NaN.
    """
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (count,) or np.isnan(vector).any():
        raise FracsimError(f"{name} must be {count} numbers, got {value}")
    return vector


def rotation(value: object, name: str) -> npt.NDArray[np.float64]:
    """Require a rotation, as a quaternion of any length but zero.

    Parameters
    ----------
    value : object
        What somebody gave.
    name : str
        Name of the argument, for the message.

    Returns
    -------
    ndarray of float64, shape (4,)
        The unit quaternion (x, y, z, w).

    Raises
    ------
    FracsimError
        Where it is not four numbers, zero or infinite.
    """
    quaternion = numbers(value, 4, f"{name}, a quaternion (x, y, z, w),")
    length = float(np.linalg.norm(quaternion))
    if not 0.0 < length < np.inf:
        raise FracsimError(f"{name} must be a rotation, such as (0, 0, 0, 1), got {quaternion.tolist()}")
    return quaternion / length
