"""How things moved before the last step, and what contacts did in it.

Verdicts need it to predict impacts, and the replacement to put bodies back to before the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.frames import cross
from .bullet import Engine
from .rotations import rotation_of
from .states import ContactForces, Motion, Placement, Triple
from .world_state import WorldState


@dataclass(frozen=True)
class LastStepSettings:
    """How far a motion that was kept may be from the one that the contacts tell, before the latter counts.

    The differences below these are what damping, rounding and the contacts' own error make. Somebody who gave a body
    another velocity between two steps makes a larger one.

    Attributes
    ----------
    speed_tolerance : float
        Of the threshold of impact speeds; 2 % of it is no impact whatever it comes from.
    speed_share : float
        Of the speed itself; damping of 0.04 per second takes 2e-4 of it in a step.
    spin_tolerance : float
        Of the same threshold, as the speed of the body's furthest point. Contacts tell spin less exactly than speed,
        since the points where they push are known to the collision margin only.
    spin_share : float
        Of the spin itself.
    unknown_reach : float
        Distance that stands for the reach of a body that this world does not know, m.
    largest_turn : float
        Turn in one step above which the spin that the contacts tell is dropped, rad. No step resolves more than about
        one radian, and what the engine makes of it tells nothing.
    """

    speed_tolerance: float = 0.02
    speed_share: float = 1e-3
    spin_tolerance: float = 0.1
    spin_share: float = 0.1
    unknown_reach: float = 0.1
    largest_turn: float = 1.0


SETTINGS = LastStepSettings()


class LastStep:
    """What is known of the step just taken; worked out when first asked for and kept until `clear`.

    Parameters
    ----------
    state : WorldState
        The world that takes the steps.
    """

    def __init__(self, state: WorldState) -> None:
        self._state = state
        self._forces: ContactForces | None = None
        self._motions: dict[tuple[int, int], Motion] = {}

    def clear(self) -> None:
        """Forget what was worked out: another step was taken, or somebody changed bodies."""
        self._forces = None
        self._motions.clear()

    @property
    def contact_forces(self) -> ContactForces:
        """Contacts between any bodies that carried force in the step."""
        if self._forces is None:
            self._forces = self._state.engine.contact_forces()
        return self._forces

    def motion_before(self, body: int, link: int) -> Motion:
        """Find how a body or a link moved before the step.

        Parameters
        ----------
        body, link : int
            PyBullet ids; link -1 is the base.

        Returns
        -------
        Motion
            Linear and angular velocity in the world frame (m/s, rad/s): as it was kept, or as the contacts tell where
            it was not kept, or where somebody has changed it since.
        """
        if (body, link) not in self._motions:
            self._motions[body, link] = self._find_motion(body, link)
        return self._motions[body, link]

    def _find_motion(self, body: int, link: int) -> Motion:
        state, engine = self._state, self._state.engine
        kept = state.activity.motion_before(body, link)
        if link >= 0 or engine.is_articulated(body):
            return engine.link_motion(body, link) if kept is None else kept
        if engine.is_static(body):
            return engine.motion(body)
        if kept is not None and self._is_constrained(body):  # constraint forces are in no contact
            return kept
        clock = state.clock
        placement = engine.placement_before(body, clock.time_step)
        linear, angular = velocity_before_step(
            engine, body, placement, self.contact_forces, clock.time_step, clock.gravity
        )
        if kept is None:
            return linear, angular
        limit = clock.impact_speed_threshold
        if _differ(linear, kept[0], SETTINGS.speed_tolerance * limit, SETTINGS.speed_share, linear):
            return linear, angular
        # Contacts tell less exactly of spin, the more so the more they change it.
        record = state.records.get(body)
        reach = SETTINGS.unknown_reach if record is None else record.reach
        tolerance = SETTINGS.spin_tolerance * limit / reach
        if not _differ(angular, kept[1], tolerance, SETTINGS.spin_share, angular, kept[1], engine.motion(body)[1]):
            angular = kept[1]
        return kept[0], angular

    def _is_constrained(self, body: int) -> bool:
        return bool(self._state.engine.constraints.of(body))


def velocity_before_step(
    engine: Engine, body: int, placement: Placement, contacts: ContactForces, time_step: float, gravity: Triple
) -> Motion:
    """Work out how a free body moved before the last step, from how it moves now and what contacts did to it.

    Parameters
    ----------
    engine : Engine
        Engine that took the step.
    body : int
        PyBullet id.
    placement : Placement
        Where the body was before the step: centre of mass (m) and quaternion of the principal axes.
    contacts : ContactForces
        All contacts that carried force in the step.
    time_step : float
        Duration of the step, s.
    gravity : tuple of float
        Acceleration, shape (3,), m/s².

    Returns
    -------
    Motion
        Linear and angular velocity, world frame (m/s, rad/s).

    Notes
    -----
    Newton's and Euler's equations over one step, backwards: the impulses of contacts and gravity are taken from the
    momentum, and their moments about the centre of mass from the angular momentum. Damping and other forces of that
    one step are not undone.
    """
    linear, angular = (np.array(part) for part in engine.motion(body))
    rigid = engine.rigid_body(body, -1)
    impulse, moment = np.zeros(3), np.zeros(3)
    for side, places in enumerate((contacts.on_first, contacts.on_second)):
        mine = contacts.bodies[:, side] == body
        impulses = (time_step, -time_step)[side] * contacts.forces[mine]
        impulse += impulses.sum(axis=0)
        moment += cross(places[mine] - placement[0], impulses).sum(axis=0)
    rotation = rotation_of(placement[1])
    linear = linear - impulse / rigid.mass - time_step * np.array(gravity)
    # A moment of inertia of zero is the engine's way to say that a body does not turn about that axis.
    turns = np.divide(rotation.T @ moment, rigid.moments, out=np.zeros(3), where=rigid.moments > 0)
    angular = angular - rotation @ turns
    if np.linalg.norm(angular) * time_step > SETTINGS.largest_turn:
        angular = np.zeros(3)
    return tuple(linear.tolist()), tuple(angular.tolist())


def _differ(a: Triple, b: Triple, tolerance: float, share: float, *scales: Triple) -> bool:
    """Whether two vectors differ by more than a tolerance and a share of the largest component of the scales."""
    size = max(abs(x) for scale in scales for x in scale)
    return max(abs(x - y) for x, y in zip(a, b, strict=True)) > tolerance + share * size
