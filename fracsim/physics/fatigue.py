"""Fatigue by Miner's rule: impacts that break nothing use up a body's strength.

The verdicts ask it how much an impact weakens a body, and how a weakened body feels impulses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ..common.impulse import Impulse


@dataclass(frozen=True)
class FatigueSettings:
    """How the impulse that just breaks a body is searched for.

    Attributes
    ----------
    largest_factor : float
        Factor at which the search ends, dimensionless. What a thousand times the impact does not break is weakened by
        less than any exponent of 1 or more lets one notice.
    bisections : int
        Halvings of the range of a factor of two that holds the breaking one; 5 leave 2 %.
    least_strength : float
        Share of the strength that always stays, so that a worn-out body divides by no zero.
    """

    largest_factor: float = 1e3
    bisections: int = 5
    least_strength: float = 1e-6


SETTINGS = FatigueSettings()


def felt_impulses(impulses: Sequence[Impulse], damage: float) -> tuple[Impulse, ...]:
    """Give impulses as a body feels them that earlier impacts have weakened.

    Parameters
    ----------
    impulses : sequence of Impulse
        What acts on the body, in its own frame (m, N·s).
    damage : float
        Share of its strength that is used up, 0 to 1.

    Returns
    -------
    tuple of Impulse
        The same impulses over the strength that is left.
    """
    if damage == 0.0:
        return tuple(impulses)
    return multiplied(impulses, 1.0 / max(1.0 - damage, SETTINGS.least_strength))


def damage_of(impulses: Sequence[Impulse], exponent: float, breaks: Callable[[tuple[Impulse, ...]], bool]) -> float:
    """Work out the share of a body's strength that an impact uses up which does not break it.

    Parameters
    ----------
    impulses : sequence of Impulse
        The impact, in the body's frame (m, N·s).
    exponent : float
        Slope n of the Wöhler curve, at least 1.
    breaks : callable
        Tells whether impulses break the undamaged body.

    Returns
    -------
    float
        r**n, where r is the impact as a share of the one of the same kind that just breaks the body.

    Notes
    -----
    Palmgren-Miner linear damage: M. A. Miner, "Cumulative damage in fatigue", J. Appl. Mech. 12 (1945).
    """
    low, high = 1.0, 1.0
    while high < SETTINGS.largest_factor and not breaks(multiplied(impulses, high)):
        low, high = high, 2.0 * high
    for _ in range(SETTINGS.bisections):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if breaks(multiplied(impulses, middle)) else (middle, high)
    return float(high**-exponent)


def multiplied(impulses: Sequence[Impulse], factor: float) -> tuple[Impulse, ...]:
    """Multiply the magnitude of each impulse.

    Parameters
    ----------
    impulses : sequence of Impulse
        Any impulses.
    factor : float
        At least 0, dimensionless.

    Returns
    -------
    tuple of Impulse
        The same points, directions and durations, other magnitudes.
    """
    return tuple(impulse.times(factor) for impulse in impulses)
