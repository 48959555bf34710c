"""Impulses: what a contact hands to the fracture model; every room may make and read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from .arrays import FloatArray
from .checks import Vector, finite_vector, is_number
from .contact import HALF_SINE, LOAD_DURATION
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
    duration : float, optional
        s, for which the contact lasts, above 0. None: that of something hard and heavy, by the contact law
        (`fracsim.common.contact`).

    Attributes
    ----------
    point : ndarray of float64, shape (3,)
        m, where it acts; an asset takes the nearest point of its surface. Read-only.
    direction : ndarray of float64, shape (3,)
        Where it pushes the body, as a unit vector. Read-only.
    magnitude : float
        N·s.
    duration : float or None
        s.

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
    duration: float | None = None

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
        if self.duration is not None:
            if not is_number(self.duration) or self.duration <= 0.0:
                raise ImpulseError(f"impulse duration must be finite and above 0 s, or None, got {self.duration!r}")
            object.__setattr__(self, "duration", float(self.duration))

    @classmethod
    def from_force(cls, point: Vector, direction: Vector, force: float) -> Self:
        """Describe a force that lasts: a weight, a grip.

        Parameters
        ----------
        point, direction : array_like, shape (3,)
            As of `Impulse`.
        force : float
            N, at least 0.

        Returns
        -------
        Impulse
            Its `peak_force` is the force. As an impulse, which simulators count in that know no forces, it is what
            the force gives in `LOAD_DURATION`.

        Raises
        ------
        ImpulseError
            If the force is not finite or negative.

        Notes
        -----
        A simulator takes it as an impact of that peak force: what it presses on gives way, and the force falls.
        """
        if not is_number(force) or force < 0.0:
            raise ImpulseError(f"a force must be finite and at least 0 N, got {force!r}")
        return cls(np.asarray(point), np.asarray(direction), force * LOAD_DURATION, HALF_SINE * LOAD_DURATION)

    @property
    def peak_force(self) -> float | None:
        """N, the largest force of the contact, a half-sine pulse; None where it follows from what is struck."""
        return None if self.duration is None else HALF_SINE * self.magnitude / self.duration

    def times(self, factor: float) -> Impulse:
        """Make the same impulse stronger or weaker.

        Parameters
        ----------
        factor : float
            At least 0, on the magnitude, and on the force where the duration is known.

        Returns
        -------
        Impulse
            Of the same duration.
        """
        return Impulse(self.point, self.direction, self.magnitude * factor, self.duration)


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
