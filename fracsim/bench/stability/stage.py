"""TODO bench.stability.stage."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pybullet as p

from ...common.arrays import FloatArray
from ...common.impulse import Impulse
from ...fracture.asset import BreakableAsset, load
from ...physics.events import FractureEvent
from ...physics.impacts import ContactImpulse
from ...physics.world import World

Row = dict[str, Any]

MESHES = ("bunny", "chair", "vase")
COUNTS = (1, 2, 5, 15, 50)  # breakables
SHARES = (0.62, 0.20, 0.13, 0.04, 0.01)  # of the cells; a scene of fifty takes as long as a hundred others
RANGES = {  # of the axes that are sampled evenly in their logarithms
    "time_step": (1 / 2000, 1 / 60),
    "speed": (0.1, 300.0),
    "density_ratio": (1e-4, 1e4),
    "size": (0.01, 100.0),
    "severity": (1.5, 20.0),
}
LIMITS = {  # of the residuals, see `Stage.check`
    "mass": 1e-9,
    "momentum": 1e-6,
    "energy": 0.01,
    "speed": 1.0,
}
APPROACH = 2  # steps before things meet
AFTERMATH = 28  # steps after
UNBREAKABLE = 1e30  # Pa
GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class Cell:
    """One scene, to the last random draw: ``run(Cell(**row["cell"]))`` plays it again.

    family: a key of FAMILIES. time_step: s. speed: m/s, at which things meet. density_ratio: of what is thrown, over
    the breakable's. size: m. breakables: how many. other: "ball", "box" or "floor". severity: of the impact, over what
    just breaks the body. variant: which of the family's scenes.
    """

    family: str
    time_step: float
    speed: float
    density_ratio: float
    size: float
    breakables: int
    mesh: str
    other: str
    severity: float
    variant: int
    seed: int


# The scene


@dataclass
class Stage:
    """A world of one's own, what is in it, and what mechanics says about it.

    strengths: Pa, of the breakables in the order in which they are added; None for the twin.
    free: nothing outside acts on the system, so that momentum stays. closed: nothing outside does work but gravity.
    allowed: m/s, what no body may exceed, where energy cannot be accounted for.
    before, after: the family's own doings around each step.
    """

    cell: Cell
    strengths: Sequence[float] | None
    free: bool = True
    closed: bool = True
    allowed: float = np.inf
    still: float = 0.0  # m/s, the unit of momentum and energy where nothing moves
    steps: int = APPROACH + AFTERMATH
    turn: float = 0.0  # rad, the farthest that a body turned in one step
    overlap: float = 0.0  # of the size, how deep new pieces were in each other or in what had hit their parent
    spinning: float = 0.0  # share of rotation in the energy when most of it was gained
    bodies: list[int] = field(default_factory=list)  # the breakables, as they were added
    others: list[int] = field(default_factory=list)  # free bodies that count with the system
    fixtures: list[int] = field(default_factory=list)  # bodies that do not
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
        self.impacts: dict[int, dict[int, list[Impulse]]] = {}  # body -> step -> the hits, which act together
        self.events: list[FractureEvent] = []
        self.worst = {"mass": 0.0, "momentum": 0.0, "energy": 0.0, "speed": 0.0, "angular": 0.0}
        self.broken: dict[str, str] = {}  # claims that have no residual, and what was found
        self._fresh: set[int] = set()  # the pieces that the last step made
        self._taken = 0.0  # kg, that the family took away

    def close(self) -> None:
        if p.getConnectionInfo(self.client)["isConnected"]:
            p.disconnect(self.client)

    # Putting things in

    def breakable(
        self, position: FloatArray, orientation: FloatArray, linear: FloatArray | None = None, spin: float = 0.0
    ) -> int:
        """A breakable with its centre of mass at `position`; spin: of the speed at its rim over the cell's."""
        cell = self.cell
        asset = asset_named(cell.mesh)
        strength = UNBREAKABLE if self.strengths is None else self.strengths[len(self.bodies)]
        asset = asset.with_material(replace(asset.material, tensile_strength=strength))
        rate = min(spin * cell.speed / cell.size, 0.02 / cell.time_step)  # it must not turn away before it is hit
        rotation = np.reshape(p.getMatrixFromQuaternion(orientation.tolist()), (3, 3))
        scale = cell.size / asset.size
        body = self.world.add(
            asset,
            position - rotation @ asset.center_of_mass * scale,
            orientation,
            np.zeros(3) if linear is None else linear,
            rate * np.array([0.48, -0.6, 0.64]),
            scale,
            linear_damping=0.0,
            angular_damping=0.0,
        )
        self.bodies.append(body)
        return body

    def missile(self, radius: float, kind: str, ratio: float | None = None) -> int:
        """A ball or box of the cell's density ratio."""
        if kind == "ball":
            shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=self.client)
            volume = 4.19 * radius**3
        else:
            sides = np.array([1.0, 0.8, 0.6]) * radius
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=sides.tolist(), physicsClientId=self.client)
            volume = 8.0 * float(sides.prod())
        ratio = self.cell.density_ratio if ratio is None else ratio
        mass = ratio * asset_named(self.cell.mesh).material.density * volume
        body: int = p.createMultiBody(mass, shape, physicsClientId=self.client)
        p.changeDynamics(
            body, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e5, physicsClientId=self.client
        )
        # The engine gets a free spin about an unstable axis wrong, which says nothing of breaking: it has none.
        p.changeDynamics(body, -1, localInertiaDiagonal=[0.4 * mass * radius**2] * 3, physicsClientId=self.client)
        self.others.append(body)
        return body

    def fixture(self, half: Sequence[float], position: FloatArray) -> int:
        """A static box."""
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=list(half), physicsClientId=self.client)
        body: int = p.createMultiBody(0.0, shape, -1, position.tolist(), physicsClientId=self.client)
        self.fixtures.append(body)
        return body

    def floor(self) -> int:
        """A plane at z = 0, and gravity."""
        self.gravity = GRAVITY
        p.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client)
        body: int = p.createMultiBody(0.0, shape, physicsClientId=self.client)
        self.fixtures.append(body)
        self.free = False
        return body

    def aim(
        self,
        mover: int,
        obstacles: Iterable[int],
        target: FloatArray,
        way: FloatArray,
        reach: float,
        phase: float,
        delay: int = APPROACH,
        speed: float | None = None,
    ) -> None:
        """Throw a body at `target` along `way` so that it has touched after `delay` steps.

        It is slid along its path until it touches, and put back by the way it will have gone. phase: how much of its
        last step then lies beneath the surface, as it may be anything in a simulation; no more than half its radius,
        so that what is fast does not simply pass.
        """
        speed = self.cell.speed if speed is None else speed
        _, turn = p.getBasePositionAndOrientation(mover, physicsClientId=self.client)
        travelled, gap, obstacles = 0.0, np.inf, list(obstacles)
        for _ in range(60):
            p.resetBasePositionAndOrientation(
                mover, (target + (travelled - reach) * way).tolist(), turn, physicsClientId=self.client
            )
            gap = min(self._gap(mover, obstacle, 4.0 * reach + self.cell.size) for obstacle in obstacles)
            if gap < 1e-4 * self.cell.size or travelled > 2.0 * reach + self.cell.size:
                break
            travelled += gap
        step = speed * self.cell.time_step
        low, high = p.getAABB(mover, -1, physicsClientId=self.client)
        depth = phase * min(step, 0.25 * float(min(np.subtract(high, low))))
        place = target + (travelled - reach + depth - delay * step) * way
        p.resetBasePositionAndOrientation(mover, place.tolist(), turn, physicsClientId=self.client)
        p.resetBaseVelocity(mover, (speed * way).tolist(), physicsClientId=self.client)

    def boost(self, velocity: FloatArray) -> None:
        """Let everything move with `velocity` besides."""
        for body in (*self.bodies, *self.others):
            linear, angular = p.getBaseVelocity(body, physicsClientId=self.client)
            p.resetBaseVelocity(body, (np.array(linear) + velocity).tolist(), angular, physicsClientId=self.client)

    def take(self, body: int, through_world: bool = False) -> None:
        """Remove a body, as a user might."""
        self._taken += p.getDynamicsInfo(body, -1, physicsClientId=self.client)[0]
        if through_world:
            self.world.remove(body)
        else:
            p.removeBody(body, physicsClientId=self.client)
        if body in self.others:
            self.others.remove(body)

    def _gap(self, one: int, other: int, reach: float) -> float:
        points = p.getClosestPoints(one, other, reach, physicsClientId=self.client)
        return min((point[8] for point in points), default=reach)

    def _feel(self, hit: ContactImpulse) -> None:
        self.impacts.setdefault(hit.body, {}).setdefault(self.step, []).append(hit.impulse)

    # Playing it

    @property
    def system(self) -> list[int]:
        """Everything that is free to move: breakables, their pieces, and what was thrown."""
        return [*dict.fromkeys((*self.others, *self.world.bodies, *self.world.pieces))]

    def begin(self) -> None:
        """Take down what must stay as it is."""
        mass, position, momentum, energy, spin = self._mechanics(self.system)
        drift = momentum.sum(axis=0) / mass.sum() if self.free else np.zeros(3)
        self._mass, self._momentum, self._drift = float(mass.sum()), momentum.sum(axis=0), drift
        self._carried = max(float(np.linalg.norm(momentum, axis=1).sum()), self._mass * self.still)
        self._height = float(mass @ position[:, 2])
        self._kinetic = self._relative(mass, momentum, energy)
        self._center = mass @ position / mass.sum()
        arm = position - self._center
        self._spin = (np.cross(arm, momentum - mass[:, None] * drift) + spin).sum(axis=0)
        swing = float(np.linalg.norm(momentum - mass[:, None] * drift, axis=1).sum()) * self.cell.size
        self._turning = max(swing + float(np.linalg.norm(spin, axis=1).sum()), 1e-300)

    def advance(self) -> None:
        before = len(self.events)
        for act in self.before:
            act(self.step)
        events = self.world.step()
        if self._fresh:  # contacts are told for where things were before the step
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

        mass: of all that is left, relative. momentum: what was lost or gained of Σ|p|. energy: what was gained,
        over what there was (in a free system, as its centre of mass sees it) and gravity's work. speed: the fastest
        body, over what is allowed. angular: as momentum, over Σ|p| times the size and what spun; told, not judged,
        since the engine itself does not keep it.
        """
        mass, position, momentum, energy, spin = self._mechanics(self.system)
        rest = [p.getBasePositionAndOrientation(body, physicsClientId=self.client)[0] for body in self.fixtures]
        if not all(np.isfinite(a).all() for a in (mass, position, momentum, energy, spin, np.array(rest))):
            self.broken.setdefault("nan", f"a pose or velocity is not finite after step {self.step}")
            return
        count = p.getNumBodies(physicsClientId=self.client)
        known = {p.getBodyUniqueId(i, physicsClientId=self.client) for i in range(count)}
        expected = {*self.system, *self.fixtures}
        if known != expected:
            self.broken.setdefault(
                "lost", f"step {self.step}: bodies {known - expected} unaccounted for, {expected - known} missing"
            )
        self._raise("mass", abs(float(mass.sum()) + self._taken - self._mass) / self._mass)
        if not len(mass):
            return
        speeds = np.linalg.norm(momentum, axis=1) / mass
        self._raise("speed", float(speeds.max()) / self.allowed)
        rates = np.array([p.getBaseVelocity(body, physicsClientId=self.client)[1] for body in self.system])
        self.turn = max(self.turn, float(np.linalg.norm(rates, axis=1).max()) * self.cell.time_step)
        if self.free:
            self._raise("momentum", float(np.linalg.norm(momentum.sum(axis=0) - self._momentum)) / self._carried)
            relative = momentum - mass[:, None] * self._drift
            arm = position - self._center - self._drift * self.step * self.cell.time_step
            turned = (np.cross(arm, relative) + spin).sum(axis=0)
            self._raise("angular", float(np.linalg.norm(turned - self._spin)) / self._turning)
        if self.closed:
            work = self.gravity * (self._height - float(mass @ position[:, 2])) if not self._taken else 0.0
            # A contact margin's worth of height is the least that the engine can tell apart.
            slack = self._mass * (self.gravity * 1e-3 * self.cell.size + 0.5 * self.still**2)
            kinetic = self._relative(mass, momentum, energy)
            gained = (kinetic - self._kinetic - work) / (self._kinetic + max(work, 0.0) + slack)
            if gained > self.worst["energy"]:
                rotation = float((energy - 0.5 * (momentum**2).sum(axis=1) / mass).sum())
                self.worst["energy"], self.spinning = gained, rotation / kinetic

    def _relative(self, mass: FloatArray, momentum: FloatArray, energy: FloatArray) -> float:
        """J, kinetic energy; of a free system the part that the motion of its centre of mass leaves."""
        own = energy - 0.5 * (momentum**2).sum(axis=1) / mass  # of rotation
        relative = momentum - mass[:, None] * self._drift
        return float((own + 0.5 * (relative**2).sum(axis=1) / mass).sum())

    def _mechanics(self, bodies: list[int]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """mass (n,), position, momentum (n, 3), kinetic energy (n,), spin (n, 3) as the engine has them."""
        client = self.client
        states = [
            (
                p.getDynamicsInfo(body, -1, physicsClientId=client),
                *p.getBasePositionAndOrientation(body, physicsClientId=client),
                *p.getBaseVelocity(body, physicsClientId=client),
            )
            for body in bodies
        ]
        mass = np.array([state[0][0] for state in states])
        moments = np.array([state[0][2] for state in states]).reshape(-1, 3)
        position = np.array([state[1] for state in states]).reshape(-1, 3)
        turns = [p.getMatrixFromQuaternion(state[2]) for state in states]
        rotation = np.array(turns).reshape(-1, 3, 3)  # columns: principal axes
        linear = np.array([state[3] for state in states]).reshape(-1, 3)
        angular = np.array([state[4] for state in states]).reshape(-1, 3)
        local = np.einsum("nji,nj->ni", rotation, angular)
        spin = np.einsum("nij,nj->ni", rotation, moments * local)
        energy = 0.5 * mass * (linear**2).sum(axis=1) + 0.5 * (moments * local**2).sum(axis=1)
        return mass, position, mass[:, None] * linear, energy, spin

    def _raise(self, name: str, residual: float) -> None:
        self.worst[name] = max(self.worst[name], residual)

    def figures(self) -> dict[str, Any]:
        """What was found, with None for what this scene does not check."""
        judged = {"momentum": self.free, "angular": self.free, "energy": self.closed, "speed": self.allowed < np.inf}
        energies = [getattr(event, "energy", None) for event in self.events]
        return {
            "residuals": {name: value if judged.get(name, True) else None for name, value in self.worst.items()},
            "broken": self.broken,
            "notes": self.notes,
            "turn": self.turn,
            "overlap": self.overlap,
            "spinning": self.spinning,
            "events": len(self.events),
            "pieces": sum(len(event.children) for event in self.events),
            "demand": float(sum(getattr(energy, "demand", 0.0) for energy in energies)),
            "taken": float(sum(getattr(energy, "taken", 0.0) for energy in energies)),
        }


@lru_cache(maxsize=len(MESHES))
def asset_named(mesh: str) -> BreakableAsset:
    return load(mesh)


def random_direction(rng: np.random.Generator) -> FloatArray:
    way: FloatArray = rng.normal(size=3)
    return way / np.linalg.norm(way)


def random_orientation(rng: np.random.Generator) -> FloatArray:
    quaternion: FloatArray = rng.normal(size=4)
    return quaternion / np.linalg.norm(quaternion)
