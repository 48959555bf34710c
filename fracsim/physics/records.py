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

    breakable: what breaks, an asset or a fragment; reach: m, from its centre of mass to its furthest point; bearable: N,
    a sum of lasting forces that surely does nothing. motion: as of the last look; before: a step earlier; None
    where it was left alone and flew.
    """

    body: Body
    breakable: Any
    damping: tuple[float, float]
    reach: float
    bearable_force: float
    generation: int = 0
    motion: Motion = STILL
    motion_before: Motion | None = STILL
    center: list[float] = field(default_factory=list)
    box_low: Triple = (0.0, 0.0, 0.0)  # of the box that it stays in while nothing is asked
    box_high: Triple = (0.0, 0.0, 0.0)
    contact_box: tuple[
        float, ...
    ] = ()  # of one asleep: the box, lows then highs, that something has to meet to touch it
    box_slack: float = 0.0  # m that it may move before its box is made anew
    unobserved_until: int = 0  # the step up to which it is left alone
    asleep: bool = False  # whether that is because it lies still
    unobserved_since: int = 0  # the step from which it is left alone
    slow_steps: int = 0
    flight_checked: int = 0  # the step at which it last asked for free flight
    mover_near: bool = False  # whether something that moves was near at the last look
    mover_touches: bool = False  # and pushed on it
    pressed_steps: int = 0  # steps for which more than a bearable force has
    load_due: bool = False  # whether that has lasted and is to be judged now
    lightest_contacts: BodyContacts | None = None  # of the last few of these
    recent_impacts: list[tuple[float, ContactImpulse]] = field(default_factory=list)  # of the last CHAIN seconds
    damage: float = 0.0
    damage_before: tuple[float, float] = (-1.0, 0.0)  # when an impact last added to it, and what it was before
    immune_to: frozenset[int] = frozenset()  # bodies that cannot break it
    immune_until: float = 0.0
