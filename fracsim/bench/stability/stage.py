"""The scene that a cell is played in: a client, a world, what is put into them, and the checks after each step.

``scenes`` fills it and ``run`` plays it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pybullet as p

from ...common.arrays import FloatArray
from ...common.impulse import Impulse
from ...physics.events import FractureEvent
from ...physics.impacts import ContactImpulse
from ...physics.world import World
from .cells import AFTERMATH, APPROACH, GRAVITY, UNBREAKABLE, Cell, asset_named
from .mechanics import mechanics_of

TURN = 0.02  # rad a step, the most that a breakable spins: it must not turn away before it is hit
SPIN_AXIS = np.array([0.48, -0.6, 0.64])  # a unit vector along no symmetry of the meshes
BALL_VOLUME = 4.19  # over the radius cubed
BALL_INERTIA = 0.4  # over mass times the radius squared
BOX_SIDES = (1.0, 0.8, 0.6)  # over the longest
MARGIN = 1e-3  # of the size, the engine's contact margin
TINY = 1e-300  # keeps a quotient finite where nothing turns


@dataclass
class Stage:
    """A world, what is in it, and what mechanics says about it.

    Attributes
    ----------
    cell : Cell
        The scene's axes.
    strengths : sequence of float or None
        Tensile strengths of the breakables in Pa, in the order in which they are added; None for the twin.
    free : bool
        Whether nothing outside acts on the system, so that momentum stays.
    closed : bool
        Whether nothing outside does work but gravity.
    allowed : float
        Speed that no body may exceed, m/s, where energy cannot be accounted for.
    still : float
        The unit of momentum and energy where nothing moves, as a speed in m/s.
    steps : int
        How many steps are played.
    turn : float
        The largest angle that a body turned in one step, rad.
    overlap : float
        How deep new pieces were in each other or in what had hit their parent, over the size.
    spinning : float
        Share of rotation in the energy when most of it was gained.
    bodies : list of int
        Ids of the breakables, as they were added.
    others : list of int
        Ids of free bodies that count with the system.
    fixtures : list of int
        Ids of bodies that do not.
    before, after : list of callable
        What the family does before and after each step.
    notes : list of str
        What the scene reports.
    client : int
        A PyBullet client of its own.
    world : World
        The world in it.
    gravity : float
        m/s², 0 until there is a floor.
    step : int
        Steps taken.
    impacts : dict of int to dict of int to list of Impulse
        For each body, the hits of each step, which act together.
    events : list of FractureEvent
        What broke.
    worst : dict of str to float
        The largest residuals so far.
    broken : dict of str to str
        Claims without a residual that did not hold, and what was found.
    """

    cell: Cell
    strengths: Sequence[float] | None
    free: bool = True
    closed: bool = True
    allowed: float = np.inf
    still: float = 0.0
    steps: int = APPROACH + AFTERMATH
    turn: float = 0.0
    overlap: float = 0.0
    spinning: float = 0.0
    bodies: list[int] = field(default_factory=list)
    others: list[int] = field(default_factory=list)
    fixtures: list[int] = field(default_factory=list)
    before: list[Callable[[int], object]] = field(default_factory=list)
    after: list[Callable[[int, list[FractureEvent]], object]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.client: int = p.connect(p.DIRECT)
        self.gravity = 0.0
        p.setPhysicsEngineParameter(
            fixedTimeStep=self.cell.time_step,
            enableFileCaching=0,
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        self.world = World(self.client)
        self.world.on_contact(self._feel)
        self.step = 0
        self.impacts: dict[int, dict[int, list[Impulse]]] = {}
        self.events: list[FractureEvent] = []
        self.worst = {"mass": 0.0, "momentum": 0.0, "energy": 0.0, "speed": 0.0, "angular": 0.0}
        self.broken: dict[str, str] = {}
        self._fresh: set[int] = set()  # the pieces that the last step made
        self._taken = 0.0  # kg, that the family took away

    def close(self) -> None:
        """Disconnect the client, if the scene did not."""
        if p.getConnectionInfo(self.client)["isConnected"]:
            p.disconnect(self.client)

    # Putting things in

    def breakable(
        self, position: FloatArray, orientation: FloatArray, linear: FloatArray | None = None, spin: float = 0.0
    ) -> int:
        """Add a breakable.

        Parameters
        ----------
        position : ndarray of float64, shape (3,)
            Of its centre of mass, m.
        orientation : ndarray of float64, shape (4,)
            Quaternion x, y, z, w.
        linear : ndarray of float64, shape (3,), optional
            Its velocity, m/s; zero by default.
        spin : float
            The speed at its rim, over the cell's.

        Returns
        -------
        int
            Its id.
        """
        cell = self.cell
        asset = asset_named(cell.mesh)
        strength = UNBREAKABLE if self.strengths is None else self.strengths[len(self.bodies)]
        asset = asset.with_material(replace(asset.material, tensile_strength=strength))
        rate = min(spin * cell.speed / cell.size, TURN / cell.time_step)
        rotation = np.reshape(p.getMatrixFromQuaternion(orientation.tolist()), (3, 3))
        scale = cell.size / asset.size
        body = self.world.add(
            asset,
            position - rotation @ asset.center_of_mass * scale,
            orientation,
            np.zeros(3) if linear is None else linear,
            rate * SPIN_AXIS,
            scale,
            linear_damping=0.0,
            angular_damping=0.0,
        )
        self.bodies.append(body)
        return body

    def missile(self, radius: float, kind: str, ratio: float | None = None) -> int:
        """Add a ball or a box.

        Parameters
        ----------
        radius : float
            Of the ball, or half the longest side of the box, m.
        kind : str
            "ball"; anything else is a box.
        ratio : float, optional
            Its density over the breakable's; by default the cell's.

        Returns
        -------
        int
            Its id.
        """
        if kind == "ball":
            shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=self.client)
            volume = BALL_VOLUME * radius**3
        else:
            sides = np.array(BOX_SIDES) * radius
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=sides.tolist(), physicsClientId=self.client)
            volume = 8.0 * float(sides.prod())
        ratio = self.cell.density_ratio if ratio is None else ratio
        mass = ratio * asset_named(self.cell.mesh).material.density * volume
        body: int = p.createMultiBody(mass, shape, physicsClientId=self.client)
        p.changeDynamics(
            body, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e5, physicsClientId=self.client
        )
        # The engine gets a free spin about an unstable axis wrong, which says nothing of breaking: it has none.
        p.changeDynamics(
            body, -1, localInertiaDiagonal=[BALL_INERTIA * mass * radius**2] * 3, physicsClientId=self.client
        )
        self.others.append(body)
        return body

    def fixture(self, half: Sequence[float], position: FloatArray) -> int:
        """Add a static box.

        Parameters
        ----------
        half : sequence of float, length 3
            Half its sides, m.
        position : ndarray of float64, shape (3,)
            Of its centre, m.

        Returns
        -------
        int
            Its id.
        """
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=list(half), physicsClientId=self.client)
        body: int = p.createMultiBody(0.0, shape, -1, position.tolist(), physicsClientId=self.client)
        self.fixtures.append(body)
        return body

    def floor(self) -> int:
        """Add a plane at z = 0, and gravity.

        Returns
        -------
        int
            The plane's id.
        """
        self.gravity = GRAVITY
        p.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client)
        body: int = p.createMultiBody(0.0, shape, physicsClientId=self.client)
        self.fixtures.append(body)
        self.free = False
        return body

    def boost(self, velocity: FloatArray) -> None:
        """Add a velocity to everything that moves.

        Parameters
        ----------
        velocity : ndarray of float64, shape (3,)
            m/s.
        """
        for body in (*self.bodies, *self.others):
            linear, angular = p.getBaseVelocity(body, physicsClientId=self.client)
            p.resetBaseVelocity(body, (np.array(linear) + velocity).tolist(), angular, physicsClientId=self.client)

    def take(self, body: int, through_world: bool = False) -> None:
        """Remove a body, as a user might.

        Parameters
        ----------
        body : int
            Its id.
        through_world : bool
            Whether the world removes it, or the engine directly.
        """
        self._taken += p.getDynamicsInfo(body, -1, physicsClientId=self.client)[0]
        if through_world:
            self.world.remove(body)
        else:
            p.removeBody(body, physicsClientId=self.client)
        if body in self.others:
            self.others.remove(body)

    def _feel(self, hit: ContactImpulse) -> None:
        """Remember a hit."""
        self.impacts.setdefault(hit.body, {}).setdefault(self.step, []).append(hit.impulse)

    # Playing it

    @property
    def system(self) -> list[int]:
        """Ids of everything that is free to move: breakables, their pieces, and what was thrown."""
        return [*dict.fromkeys((*self.others, *self.world.bodies, *self.world.pieces))]

    def begin(self) -> None:
        """Note what must stay as it is."""
        now = mechanics_of(self.client, self.system)
        mass, momentum = now.mass, now.momentum
        drift = momentum.sum(axis=0) / mass.sum() if self.free else np.zeros(3)
        self._mass, self._momentum, self._drift = float(mass.sum()), momentum.sum(axis=0), drift
        self._carried = max(float(np.linalg.norm(momentum, axis=1).sum()), self._mass * self.still)
        self._height = float(mass @ now.position[:, 2])
        self._kinetic = now.kinetic_energy(drift)
        self._center = mass @ now.position / mass.sum()
        self._spin = now.angular_momentum(self._center, drift)
        swing = float(np.linalg.norm(momentum - mass[:, None] * drift, axis=1).sum()) * self.cell.size
        self._turning = max(swing + float(np.linalg.norm(now.spin, axis=1).sum()), TINY)

    def advance(self) -> None:
        """Take one step, and check what it did."""
        before = len(self.events)
        for act in self.before:
            act(self.step)
        events = self.world.step()
        if self._fresh:  # the engine's contacts are those of where things were before the step
            contacts = p.getContactPoints(physicsClientId=self.client) or ()
            depth = max((-q[8] for q in contacts if self._fresh & {q[1], q[2]}), default=0.0)
            self.overlap = max(self.overlap, depth / self.cell.size)
        self.events += events
        for event in events:
            parts = sum(piece.mass for piece in event.fracture.pieces)
            alive = sum(p.getDynamicsInfo(child, -1, physicsClientId=self.client)[0] for child in event.children)
            self._raise("mass", abs(alive - parts) / parts)
        for follow in self.after:
            follow(self.step, events)
        self._fresh = {child for event in self.events[before:] for child in event.children}
        self.step += 1
        self.check()

    def check(self) -> None:
        """Compare with the beginning.

        The residuals are: mass, of all that is left, relative. Momentum, what was lost or gained, over Σ|p|. Energy,
        what was gained, over what there was (in a free system, as its centre of mass sees it) and gravity's work.
        Speed, of the fastest body, over what is allowed. Angular, as momentum, over Σ|p| times the size and what spun;
        it is reported, not judged, since the engine itself does not keep it.
        """
        client = self.client
        now = mechanics_of(client, self.system)
        fixed = [p.getBasePositionAndOrientation(body, physicsClientId=client)[0] for body in self.fixtures]
        if not (now.finite and np.isfinite(np.array(fixed)).all()):
            self.broken.setdefault("nan", f"a pose or velocity is not finite after step {self.step}")
            return
        count = p.getNumBodies(physicsClientId=client)
        known = {p.getBodyUniqueId(i, physicsClientId=client) for i in range(count)}
        expected = {*self.system, *self.fixtures}
        if known != expected:
            self.broken.setdefault(
                "lost", f"step {self.step}: bodies {known - expected} unaccounted for, {expected - known} missing"
            )
        mass, momentum = now.mass, now.momentum
        self._raise("mass", abs(float(mass.sum()) + self._taken - self._mass) / self._mass)
        if not len(mass):
            return
        self._raise("speed", float((np.linalg.norm(momentum, axis=1) / mass).max()) / self.allowed)
        self.turn = max(self.turn, float(np.linalg.norm(now.angular_velocity, axis=1).max()) * self.cell.time_step)
        if self.free:
            self._raise("momentum", float(np.linalg.norm(momentum.sum(axis=0) - self._momentum)) / self._carried)
            center = self._center + self._drift * self.step * self.cell.time_step
            turned = now.angular_momentum(center, self._drift)
            self._raise("angular", float(np.linalg.norm(turned - self._spin)) / self._turning)
        if self.closed:
            work = self.gravity * (self._height - float(mass @ now.position[:, 2])) if not self._taken else 0.0
            # The engine cannot tell heights apart by less than a contact margin.
            slack = self._mass * (self.gravity * MARGIN * self.cell.size + 0.5 * self.still**2)
            kinetic = now.kinetic_energy(self._drift)
            gained = (kinetic - self._kinetic - work) / (self._kinetic + max(work, 0.0) + slack)
            if gained > self.worst["energy"]:
                self.worst["energy"], self.spinning = gained, now.rotation_energy / kinetic

    def _raise(self, name: str, residual: float) -> None:
        """Keep a residual if it is the largest of its name."""
        self.worst[name] = max(self.worst[name], residual)

    def figures(self) -> dict[str, Any]:
        """Collect what was found.

        Returns
        -------
        dict
            Plain data, with None for the residuals that this scene does not check.
        """
        judged = {"momentum": self.free, "angular": self.free, "energy": self.closed, "speed": self.allowed < np.inf}
        energies = [event.energy for event in self.events]
        return {
            "residuals": {name: value if judged.get(name, True) else None for name, value in self.worst.items()},
            "broken": self.broken,
            "notes": self.notes,
            "turn": self.turn,
            "overlap": self.overlap,
            "spinning": self.spinning,
            "events": len(self.events),
            "pieces": sum(len(event.children) for event in self.events),
            "demand": float(sum(energy.demand for energy in energies)),
            "taken": float(sum(energy.taken for energy in energies)),
        }
