"""Energy after a break: what cracks take from their pieces, and what pieces must not gain by standing in each other.

`World.step` settles it last; the replacement begins it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import FloatArray
from ..geometry.frames import cross
from .bodies import Body
from .bullet import Engine
from .rotations import rotation_of
from .states import BodyNotFound, Motion, Placement, Triple
from .world_state import WorldState


@dataclass(frozen=True)
class EnergySettings:
    """How long after a break its energy is settled, and what counts as none.

    Attributes
    ----------
    dissipation_time : float
        Within which cracks take their energy, s. The pieces need a few steps to come to move against one another.
    guard_time : float
        Within which pieces get out of each other, s.
    negligible_gain : float
        Gain of energy as a share of all of it that rounding may make.
    negligible_depth : float
        Depth of penetration as a share of how far the bodies' centres are apart; the gap between convex parts is
        1.5e-3 of the object, and what is left of it moves nothing that one sees.
    negligible_motion : float
        Energy of relative motion as a share of all kinetic energy that rounding may make.
    """

    dissipation_time: float = 0.02
    guard_time: float = 0.1
    negligible_gain: float = 1e-9
    negligible_depth: float = 1e-4
    negligible_motion: float = 1e-12


SETTINGS = EnergySettings()


@dataclass
class CrackEnergy:
    """Energy that opening the cracks of a break takes, and what the pieces had to give.

    Attributes
    ----------
    demand : float
        Fracture energy times projected crack area, J.
    taken : float
        Taken so far from the pieces' motion relative to that of all of them as one rigid body, J; never more than is
        there. It grows for 20 ms after the break.
    """

    demand: float
    taken: float = 0.0


@dataclass(eq=False)
class Dissipation:
    """A break whose cracks have not had all their energy yet.

    Attributes
    ----------
    energy : CrackEnergy
        What they demand and have taken.
    pieces : list of Body
        The pieces that they take it from.
    until : float
        When they stop, s of the world's time.
    """

    energy: CrackEnergy
    pieces: list[Body]
    until: float


@dataclass(frozen=True, eq=False)
class RigidStates:
    """States of n free rigid bodies at one moment, world frame.

    Attributes
    ----------
    mass : ndarray of float64, shape (n,)
        Masses, kg.
    place : ndarray of float64, shape (n, 3)
        Centres of mass, m.
    inertia : ndarray of float64, shape (n, 3, 3)
        Inertia about the centres of mass, kg·m².
    linear : ndarray of float64, shape (n, 3)
        Velocities, m/s.
    angular : ndarray of float64, shape (n, 3)
        Angular velocities, rad/s.
    """

    mass: FloatArray
    place: FloatArray
    inertia: FloatArray
    linear: FloatArray
    angular: FloatArray

    @classmethod
    def now(cls, engine: Engine, bodies: Sequence[Body]) -> RigidStates:
        """Read the states from the engine.

        Parameters
        ----------
        engine : Engine
            Engine that the bodies are in.
        bodies : sequence of Body
            The bodies.

        Returns
        -------
        RigidStates
            As the engine has them now.
        """
        places, motions = [engine.placement(body.id) for body in bodies], [engine.motion(body.id) for body in bodies]
        return cls.of(bodies, places, motions)

    @classmethod
    def of(cls, bodies: Sequence[Body], placements: Sequence[Placement], motions: Sequence[Motion]) -> RigidStates:
        """Put states together.

        Parameters
        ----------
        bodies : sequence of Body
            The bodies, for their masses and moments of inertia.
        placements : sequence of Placement
            Centre of mass (m) and quaternion of the principal axes of each.
        motions : sequence of Motion
            Linear and angular velocity of each (m/s, rad/s).

        Returns
        -------
        RigidStates
            The same as arrays.
        """
        moving = np.array(motions)  # (n, 2, 3)
        axes = np.array([rotation_of(quaternion) for _, quaternion in placements])
        inertia = np.einsum("nij,nj,nkj->nik", axes, np.array([body.moments for body in bodies]), axes)
        mass = np.array([body.mass for body in bodies])
        return cls(mass, np.array([place for place, _ in placements]), inertia, moving[:, 0], moving[:, 1])

    def energy(self, gravity: Triple) -> float:
        """Sum the kinetic and the potential energy.

        Parameters
        ----------
        gravity : tuple of float
            Acceleration, shape (3,), m/s².

        Returns
        -------
        float
            Energy, J; the potential one is zero at the origin.
        """
        moving = (self.mass * (self.linear**2).sum(axis=1)).sum()
        turning = np.einsum("ni,nij,nj->", self.angular, self.inertia, self.angular)
        return float(0.5 * (moving + turning) - self.mass @ self.place @ np.array(gravity))


@dataclass(eq=False)
class PenetrationGuard:
    """New pieces and what their parent touched, until they are apart.

    They may stand in each other by what the gap between convex parts does not cover. The engine turns such depth into
    speed, and the energy that it makes that way is taken from the bodies again.

    Attributes
    ----------
    bodies : list of Body
        The pieces and the other bodies.
    energy : float
        Kinetic and potential energy that they began the step with, J.
    until : float
        When the guard ends, s of the world's time.
    """

    bodies: list[Body]
    energy: float
    until: float

    def take_gain(self, engine: Engine, gravity: Triple) -> list[Motion] | None:
        """Take energy from the bodies that they gained in the last step.

        The guard ends where they gained none from one another: none at all, or by being driven by what else moves.

        Parameters
        ----------
        engine : Engine
            Engine that took the step.
        gravity : tuple of float
            Acceleration, shape (3,), m/s².

        Returns
        -------
        list of Motion or None
            The bodies' new motions (m/s, rad/s); None where nothing was taken.
        """
        now = RigidStates.now(engine, self.bodies)
        gained = now.energy(gravity) - self.energy
        self.energy = min(self.energy, self.energy + gained)
        depth = SETTINGS.negligible_depth * float(np.ptp(now.place, axis=0).max())
        if gained <= SETTINGS.negligible_gain * abs(self.energy) or not self._is_stuck(engine, depth):
            self.until = 0.0
            return None
        return dissipate(engine, self.bodies, gained)[1]

    def _is_stuck(self, engine: Engine, negligible_depth: float) -> bool:
        """Tell whether two bodies stand deeper in each other than that (m), and nothing else that moves touches any."""
        if not all(engine.is_marked(body.id, body.token) for body in self.bodies if body.token):
            return False  # the ids of removed bodies are handed out again
        bodies, is_stuck = {body.id for body in self.bodies}, False
        contacts = engine.contact_forces()
        for (a, b), depth in zip(contacts.bodies.tolist(), contacts.depths.tolist(), strict=True):
            if a in bodies and b in bodies:
                is_stuck |= depth > negligible_depth
            elif a in bodies or b in bodies:
                other = b if a in bodies else a
                if not engine.is_static(other) or any(map(any, engine.motion(other))):
                    return False
        return is_stuck


Running = tuple[tuple[PenetrationGuard, ...], tuple[Dissipation, ...]]  # before a step


class EnergyBalance:
    """Dissipations and guards of a world, over its steps.

    Parameters
    ----------
    state : WorldState
        The world.
    """

    def __init__(self, state: WorldState) -> None:
        self._state = state
        self._dissipations: list[Dissipation] = []
        self._guards: list[PenetrationGuard] = []

    def begin_dissipation(self, demand: float, pieces: list[Body]) -> CrackEnergy:
        """Begin to take the energy of a break's cracks from its pieces.

        Parameters
        ----------
        demand : float
            What the cracks take, J.
        pieces : list of Body
            The pieces.

        Returns
        -------
        CrackEnergy
            The account; it is kept up to date.
        """
        energy = CrackEnergy(demand)
        until = self._state.clock.time + SETTINGS.dissipation_time
        self._dissipations.append(Dissipation(energy, pieces, until))
        return energy

    def begin_guard(self, bodies: list[Body], before: RigidStates) -> None:
        """Begin to watch over pieces and what touches them.

        Parameters
        ----------
        bodies : list of Body
            The pieces and the other bodies.
        before : RigidStates
            States whose energy they have no more than.
        """
        clock = self._state.clock
        energy = before.energy(clock.gravity)
        self._guards.append(PenetrationGuard(bodies, energy, clock.time + SETTINGS.guard_time))

    def drop_guards(self, bodies: set[int]) -> None:
        """End the guards of bodies that a break puts back to before the step.

        Parameters
        ----------
        bodies : set of int
            Their ids.
        """
        self._guards = [guard for guard in self._guards if bodies.isdisjoint(body.id for body in guard.bodies)]

    def exchange(self, old: Body, new: Body) -> None:
        """Let a piece that was made anew take the place of the old one of the same id.

        Parameters
        ----------
        old, new : Body
            The piece as it was and as it is now.
        """
        for dissipation in self._dissipations:
            dissipation.pieces = [new if piece is old else piece for piece in dissipation.pieces]

    def running(self) -> Running:
        """List the guards and dissipations that run before a step; what breaks in it has not moved by its end."""
        return tuple(self._guards), tuple(self._dissipations)

    def settle(self, guards: Sequence[PenetrationGuard], dissipations: Sequence[Dissipation]) -> None:
        """Take energy after a step: first what pieces made by getting out of each other, then what cracks demand.

        Parameters
        ----------
        guards : sequence of PenetrationGuard
            Those of `running`, before the step.
        dissipations : sequence of Dissipation
            Those of `running`, before the step.
        """
        for guard in guards:
            if guard in self._guards:  # otherwise its bodies go through the step again
                self._settle_guard(guard)
        for dissipation in dissipations:
            self._settle_dissipation(dissipation)

    def _settle_guard(self, guard: PenetrationGuard) -> None:
        state = self._state
        try:
            motions = guard.take_gain(state.engine, state.clock.gravity)
        except BodyNotFound:
            state.forget_removed()
            motions, guard.until = None, 0.0
        if motions is not None:
            state.velocities_set(guard.bodies, motions)
        if state.clock.time >= guard.until:
            self._guards.remove(guard)

    def _settle_dissipation(self, dissipation: Dissipation) -> None:
        state, energy = self._state, dissipation.energy
        dissipation.pieces = [
            piece
            for piece in dissipation.pieces  # the ids of removed bodies are handed out again
            if state.pieces.get(piece.id) is piece and state.engine.is_marked(piece.id, piece.token)
        ]
        demand = energy.demand - energy.taken
        if state.clock.time > dissipation.until or demand <= 0.0 or len(dissipation.pieces) < 2:
            self._dissipations.remove(dissipation)
            return
        taken, motions = dissipate(state.engine, dissipation.pieces, demand)
        energy.taken += taken
        if taken > 0.0:
            state.velocities_set(dissipation.pieces, motions)


def dissipate(engine: Engine, pieces: Sequence[Body], demand: float) -> tuple[float, list[Motion]]:
    """Take energy from the motion of bodies relative to their common rigid motion.

    Parameters
    ----------
    engine : Engine
        Engine that the bodies are in; it gets their new velocities.
    pieces : sequence of Body
        The bodies.
    demand : float
        Energy to take, J.

    Returns
    -------
    taken : float
        Energy taken, J; at most `demand`, and at most what is there.
    motions : list of Motion
        The new motion of each body (m/s, rad/s).

    Notes
    -----
    The common motion is that of one rigid body with the bodies' momentum and angular momentum (König's theorem). What
    is left over has neither, so that scaling it down changes no momentum, and its energy is all that the motion has
    besides that of the common one.
    """
    now = RigidStates.now(engine, pieces)
    mass, place, inertia, linear, angular = now.mass, now.place, now.inertia, now.linear, now.angular
    arm = place - mass @ place / mass.sum()
    drift = mass @ linear / mass.sum()
    momentum = (mass[:, None] * cross(arm, linear)).sum(axis=0) + np.einsum("nij,nj->i", inertia, angular)
    spread = (arm**2).sum(axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    whole = (mass[:, None, None] * spread + inertia).sum(axis=0)
    common = np.linalg.solve(whole, momentum)
    rigid = drift + cross(common, arm)
    off, twist = linear - rigid, angular - common
    energy = 0.5 * float((mass * (off**2).sum(axis=1)).sum() + np.einsum("ni,nij,nj->", twist, inertia, twist))
    taken = min(demand, energy)
    if taken <= SETTINGS.negligible_motion * float((mass * (linear**2).sum(axis=1)).sum()) or taken == 0.0:
        return 0.0, [(tuple(v), tuple(w)) for v, w in zip(linear.tolist(), angular.tolist(), strict=True)]
    left = np.sqrt(max(0.0, 1.0 - taken / energy))
    linear, angular = rigid + left * off, common + left * twist
    changed: list[Motion] = []
    for piece, v, w in zip(pieces, linear, angular, strict=True):
        engine.set_velocity(piece.id, v, w)
        changed.append((tuple(v.tolist()), tuple(w.tolist())))
    return taken, changed
