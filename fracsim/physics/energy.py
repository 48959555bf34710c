"""TODO physics.energy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import FloatArray
from .bodies import Body
from .bullet import Engine
from .rotations import cross, rotation_of
from .states import Motion, Placement, Triple

DISSIPATION_TIME = 0.02  # s after a break within which cracks take their energy
GUARD_TIME = 0.1  # s after it within which pieces get out of each other


@dataclass
class CrackEnergy:
    """J, the energy that opening the cracks of a break takes, and what the pieces had to give.

    demand: fracture energy times projected crack area. taken: from the pieces' motion relative to that of all of them
    as one rigid body, never more than is there; it grows in the first COOLING seconds after the break.
    """

    demand: float
    taken: float = 0.0


@dataclass(eq=False)
class Dissipation:
    """A break whose cracks have not had all their energy yet."""

    energy: CrackEnergy
    pieces: list[Body]
    until: float  # s, of the world's time


@dataclass(frozen=True, eq=False)
class RigidStates:
    """Mass points that turn: n free rigid bodies at one moment."""

    mass: FloatArray  # (n,) kg
    place: FloatArray  # (n, 3) m, world
    inertia: FloatArray  # (n, 3, 3) kg m², world
    linear: FloatArray  # (n, 3) m/s
    angular: FloatArray  # (n, 3) rad/s

    @classmethod
    def now(cls, engine: Engine, bodies: Sequence[Body]) -> RigidStates:
        places, motions = [engine.placement(body.id) for body in bodies], [engine.motion(body.id) for body in bodies]
        return cls.of(bodies, places, motions)

    @classmethod
    def of(cls, bodies: Sequence[Body], placements: Sequence[Placement], motions: Sequence[Motion]) -> RigidStates:
        moving = np.array(motions)  # (n, 2, 3)
        axes = np.array([rotation_of(quaternion) for _, quaternion in placements])
        inertia = np.einsum("nij,nj,nkj->nik", axes, np.array([body.moments for body in bodies]), axes)
        mass = np.array([body.mass for body in bodies])
        return cls(mass, np.array([place for place, _ in placements]), inertia, moving[:, 0], moving[:, 1])

    def energy(self, gravity: Triple) -> float:
        """J, kinetic and of height."""
        moving = (self.mass * (self.linear**2).sum(axis=1)).sum()
        turning = np.einsum("ni,nij,nj->", self.angular, self.inertia, self.angular)
        return float(0.5 * (moving + turning) - self.mass @ self.place @ np.array(gravity))


@dataclass(eq=False)
class PenetrationGuard:
    """New pieces and what their parent touched, until they are apart.

    They may stand in each other by what the gap between convex parts does not cover. The engine turns such depth into
    speed, and what it makes of energy that way is taken from them again.

    energy: J, that they began the step with. until: s, of the world's time.
    """

    bodies: list[Body]
    energy: float
    until: float

    def stills(self, engine: Engine, gravity: Triple) -> list[Motion] | None:
        """After a step: the new motions of the bodies, where they had gained energy; None if they had not.

        Ends the parting where they gained none from one another: none at all, or by being driven by what moves besides.
        """
        now = RigidStates.now(engine, self.bodies)
        gained = now.energy(gravity) - self.energy
        self.energy = min(self.energy, self.energy + gained)
        if gained <= 1e-9 * abs(self.energy) or not self._stuck(engine, 1e-4 * float(np.ptp(now.place, axis=0).max())):
            self.until = 0.0
            return None
        return dissipate(engine, self.bodies, gained)[1]

    def _stuck(self, engine: Engine, least: float) -> bool:
        """Whether two of them stand deeper in each other than that, and nothing besides them moves any."""
        if not all(engine.is_marked(body.id, body.token) for body in self.bodies if body.token):
            return False  # ids come again
        bodies, stuck = {body.id for body in self.bodies}, False
        touches = engine.contact_forces()
        for (a, b), depth in zip(touches.bodies.tolist(), touches.depths.tolist(), strict=True):
            if a in bodies and b in bodies:
                stuck |= depth > least
            elif a in bodies or b in bodies:
                other = b if a in bodies else a
                if not engine.is_static(other) or any(map(any, engine.motion(other))):
                    return False
        return stuck


def dissipate(engine: Engine, pieces: Sequence[Body], demand: float) -> tuple[float, list[Motion]]:
    """Take up to ``demand`` J from the pieces' motion relative to their common rigid motion -> J taken, new motions.

    Common motion is that of one rigid body with the pieces' momentum and angular momentum. What is left over has
    neither, so that scaling it down changes no momentum, and its energy is all that the motion has besides.
    """
    now = RigidStates.now(engine, pieces)
    mass, place, inertia, linear, angular = now.mass, now.place, now.inertia, now.linear, now.angular
    arm = place - mass @ place / mass.sum()
    drift = mass @ linear / mass.sum()
    spin = (mass[:, None] * cross(arm, linear)).sum(axis=0) + np.einsum("nij,nj->i", inertia, angular)
    spread = (arm**2).sum(axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    whole = (mass[:, None, None] * spread + inertia).sum(axis=0)
    common = np.linalg.solve(whole, spin)
    rigid = drift + cross(common, arm)
    off, twist = linear - rigid, angular - common
    energy = 0.5 * float((mass * (off**2).sum(axis=1)).sum() + np.einsum("ni,nij,nj->", twist, inertia, twist))
    taken = min(demand, energy)
    # Less than rounding leaves of the motion as a whole is no energy to speak of.
    if taken <= 1e-12 * float((mass * (linear**2).sum(axis=1)).sum()) or taken == 0.0:
        return 0.0, [(tuple(v), tuple(w)) for v, w in zip(linear.tolist(), angular.tolist(), strict=True)]
    left = np.sqrt(max(0.0, 1.0 - taken / energy))
    linear, angular = rigid + left * off, common + left * twist
    changed: list[Motion] = []
    for piece, v, w in zip(pieces, linear, angular, strict=True):
        engine.set_velocity(piece.id, v, w)
        changed.append((tuple(v.tolist()), tuple(w.tolist())))
    return taken, changed
