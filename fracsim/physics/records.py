"""What is known of each breakable body between two steps, and how closely bodies are observed.

`Activity` keeps the records; verdicts and replacement read them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from .bodies import Body
from .breakable import Breakable
from .impacts import ContactImpulse
from .states import AT_REST, BodyContacts, Motion, Triple

NEVER = 1 << 62  # a step that no simulation reaches


@dataclass(frozen=True, slots=True)
class ActivitySettings:
    """How closely the breakable bodies are observed.

    Attributes
    ----------
    steps_to_sleep : int
        Steps for which a body has to be slow before it counts as asleep. A body that turns back at the top of its way
        is slow for a few.
    steps_of_flight : int
        Steps for which a body in free flight is left alone, at most. More would need boxes so large that something is
        always in them.
    steps_between_inspections : int
        Steps between two looks at what nothing else would notice: bodies put elsewhere by somebody, loads.
    steps_between_flight_checks : int
        Steps between two looks at whether bodies in flight are where their flight takes them.
    steps_between_contact_checks : int
        Steps after which the contacts of a body with a mover near are asked for even where the mover does not touch
        it, since it may press through others.
    seen_speed : float
        Largest speed, m/s, at which something is seen to come a step before it hits. Something faster may first be
        seen in the step in which it hits.
    load_steps : int
        Steps for which a force has to last to be a load; an impact is over after two or three.
    load_speed : float
        Limit for `is_slow`, m/s, of a body that is held still; only on one does a force count as a load.
    suspect_share : float
        Change of the speed of some point of a body in one step, as a share of the impact speed threshold, from which
        the body is a suspect. Below 1, as an impact takes a fraction of its time in a first step.
    flight_tolerance : float
        Distance between a body in flight and where its flight takes it, as a share of its reach, from which somebody
        has put it elsewhere.
    box_margin : float
        Margin of the box around a body, as a share of its reach; to this comes what the seen speed makes in a step.
    box_use : float
        Share of that margin that a body may use up before its box is made anew.
    contact_reach : float
        Reach of the box that something has to meet to touch a body, in units of the body's reach; more than 1 for the
        collision margin.
    contact_steps : float
        Steps of the seen speed that are added to it.
    mover_steps : float
        Steps of its own motion by which the box of a mover is widened: the last one and half of the next.
    creep_safety : float
        How many times faster than now a body asleep may creep before it leaves its box unseen.
    creep_share : float
        Share of its slack that a body asleep may have moved and still counts as lying where it was.
    """

    steps_to_sleep: int = 12
    steps_of_flight: int = 12
    steps_between_inspections: int = 16
    steps_between_flight_checks: int = 4
    steps_between_contact_checks: int = 4
    seen_speed: float = 10.0
    load_steps: int = 4
    load_speed: float = 0.4
    suspect_share: float = 0.75
    flight_tolerance: float = 0.05
    box_margin: float = 0.01
    box_use: float = 0.5
    contact_reach: float = 1.01
    contact_steps: float = 0.2
    mover_steps: float = 1.5
    creep_safety: float = 3.0
    creep_share: float = 0.25


SETTINGS = ActivitySettings()


@dataclass(eq=False, slots=True)
class BodyRecord:
    """A breakable body and what is known of it.

    A body is *observed* in every step, or it is left alone until a given step: because it is asleep, or because it
    flies where nothing is. A *mover* is anything that moves and has no record.

    Attributes
    ----------
    body : Body
        The body in the engine.
    breakable : Breakable
        What breaks: an asset or a piece.
    damping : tuple of float
        Linear and angular damping, 1/s.
    reach : float
        Distance from the centre of mass to the furthest point, m.
    bearable_force : float
        Sum of lasting forces that surely breaks nothing, N.
    generation : int
        0 for what was added, 1 for its pieces, and so on.
    motion : Motion
        When last observed, m/s and rad/s.
    motion_before : Motion, optional
        One step earlier; None where it was not observed then.
    center : list of float, length 3
        Centre of mass, m, carried on with the motion.
    box_low, box_high : tuple of float
        Corners of the box, m, that the body keeps to while its place is not asked for.
    box_slack : float
        Distance that it may still move before the box is made anew, m.
    contact_box : tuple of float, length 6
        Lowest x, y, z and highest x, y, z of the box that something has to meet to touch the body while it is asleep,
        m.
    unobserved_until : int
        Step until which it is left alone; 0 where it is observed.
    unobserved_since : int
        Step from which it is left alone.
    asleep : bool
        Whether it is left alone because it lies still.
    slow_steps : int
        Steps for which it has been slow.
    flight_checked : int
        Step in which it was last asked whether its way is free.
    mover_near : bool
        Whether a mover was near when last observed.
    mover_touches : bool
        Whether one pushed on it.
    pressed_steps : int
        Steps for which more than a bearable force has pressed on it.
    lightest_contacts : BodyContacts, optional
        Its contacts in that of these steps in which the force was least.
    recent_impacts : list of (float, ContactImpulse)
        Impacts within the last `IMPACT_WINDOW`, with the time of each, s.
    damage : float
        Share of its strength that earlier impacts used up, 0 to 1.
    damage_before : tuple of float
        Time of the last impact that added damage, s, and the damage before it.
    immune_to : frozenset of int
        Ids of bodies that cannot break it, since they took part in the break that it comes from.
    immune_until : float
        Time until which that holds, s.
    """

    body: Body
    breakable: Breakable
    damping: tuple[float, float]
    reach: float
    bearable_force: float
    generation: int = 0
    motion: Motion = AT_REST
    motion_before: Motion | None = AT_REST
    center: list[float] = field(default_factory=list)
    box_low: Triple = (0.0, 0.0, 0.0)
    box_high: Triple = (0.0, 0.0, 0.0)
    box_slack: float = 0.0
    contact_box: tuple[float, ...] = ()
    unobserved_until: int = 0
    unobserved_since: int = 0
    asleep: bool = False
    slow_steps: int = 0
    flight_checked: int = 0
    mover_near: bool = False
    mover_touches: bool = False
    pressed_steps: int = 0
    lightest_contacts: BodyContacts | None = None
    recent_impacts: list[tuple[float, ContactImpulse]] = field(default_factory=list)
    damage: float = 0.0
    damage_before: tuple[float, float] = (-1.0, 0.0)
    immune_to: frozenset[int] = frozenset()
    immune_until: float = 0.0
