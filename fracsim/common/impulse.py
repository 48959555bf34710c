"""Impulses: what a contact hands to the fracture model; every room may make and read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .arrays import FloatArray
from .checks import finite_vector, is_number
from .errors import ImpulseError


@dataclass(frozen=True, eq=False)
class Impulse:
    """An impulse on an asset, in the asset's own frame.

    Parameters
    ----------
    point : array_like, shape (3,)
        m, where it acts.
    direction : array_like, shape (3,)
        Where it pushes the body; of any length but zero.
    magnitude : float
        N·s, at least 0.

    Attributes
    ----------
    point : ndarray of float64, shape (3,)
        m, where it acts; an asset takes the nearest point of its surface. Read-only.
    direction : ndarray of float64, shape (3,)
        Where it pushes the body, as a unit vector. Read-only.
    magnitude : float
        N·s.

    Raises
    ------
    ImpulseError
        If a shape is wrong, the direction is zero, or a value is not finite.

    Examples
    --------
    >>> import fracsim
    >>> impulse = fracsim.Impulse(point=(0.0, 0.0, 0.1), direction=(0.0, 0.0, -2.0), magnitude=0.5)
    >>> impulse.direction.tolist()
    [0.0, 0.0, -1.0]
    """

    point: FloatArray
    direction: FloatArray
    magnitude: float

    def __post_init__(self) -> None:
        point = finite_vector(self.point, "impulse point", 3, ImpulseError)
        direction = finite_vector(self.direction, "impulse direction", 3, ImpulseError)
        largest = float(np.abs(direction).max())
        if largest == 0.0:
            raise ImpulseError("impulse direction is zero; give the direction in which the body is pushed")
        direction = direction / largest  # first, so that the norm neither overflows nor vanishes
        direction = direction / np.linalg.norm(direction)
        for vector in (point, direction):
            vector.setflags(write=False)
        if not is_number(self.magnitude) or self.magnitude < 0.0:
            raise ImpulseError(f"impulse magnitude must be finite and at least 0 N·s, got {self.magnitude!r}")
        object.__setattr__(self, "point", point)
        object.__setattr__(self, "direction", direction)
        object.__setattr__(self, "magnitude", float(self.magnitude))


def as_impulses(impulses: Impulse | Sequence[Impulse]) -> tuple[Impulse, ...]:
    """Read one impulse, or several that act together.

    Parameters
    ----------
    impulses : Impulse or sequence of Impulse
        What a user passed in.

    Returns
    -------
    tuple of Impulse
        At least one.

    Raises
    ------
    ImpulseError
        If there is none, or something else is among them.
    """
    result = (impulses,) if isinstance(impulses, Impulse) else tuple(impulses)
    if not result:
        raise ImpulseError("no impulse given; pass one Impulse or a non-empty sequence of them")
    for item in result:
        if not isinstance(item, Impulse):
            raise ImpulseError(f"expected fracsim.Impulse, got {type(item).__name__}")
    return result
