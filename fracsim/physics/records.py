"""TODO physics.records."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .bodies import Body
from .impacts import STILL, ContactImpulse
from .states import BodyContacts, Motion, Triple


@dataclass(eq=False)
class BodyRecord:
    """A breakable body and what is known of it.

    target: what breaks, an asset or a fragment; reach: m, from its centre of mass to its furthest point; bearable: N,
    a sum of lasting forces that surely does nothing. motion: as of the last look; before: a step earlier; None
    where it was left alone and flew.
    """

    body: Body
    target: Any
    damping: tuple[float, float]
    reach: float
    bearable: float
    generation: int = 0
    motion: Motion = STILL
    before: Motion | None = STILL
    center: list[float] = field(default_factory=list)
    low: Triple = (0.0, 0.0, 0.0)  # of the box that it stays in while nothing is asked
    high: Triple = (0.0, 0.0, 0.0)
    core: tuple[float, ...] = ()  # of one asleep: the box, lows then highs, that something has to meet to touch it
    slack: float = 0.0  # m that it may move before its box is made anew
    until: int = 0  # the step up to which it is left alone
    asleep: bool = False  # whether that is because it lies still
    since: int = 0  # the step from which it is left alone
    calm: int = 0
    tried: int = 0  # the step at which it last asked for free flight
    foreign: bool = False  # whether something that moves was near at the last look
    touched: bool = False  # and pushed on it
    pressed: int = 0  # steps for which more than a bearable force has
    loaded: bool = False  # whether that has lasted and is to be judged now
    lightest: BodyContacts | None = None  # of the last few of these
    hits: list[tuple[float, ContactImpulse]] = field(default_factory=list)  # of the last CHAIN seconds
    damage: float = 0.0
    tired: tuple[float, float] = (-1.0, 0.0)  # when an impact last added to it, and what it was before
    immune: frozenset[int] = frozenset()  # bodies that cannot break it
    immune_until: float = 0.0
