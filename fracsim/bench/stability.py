"""The stress matrix: what a break must keep, checked wherever somebody might break something.

A cell is one small scene: bodies, and what meets them how. It is played twice, first as a twin whose bodies cannot
break, then with bodies whose strength is set so that the blow the twin took is `severity` times what just breaks them.
What the twin violates too is the engine's doing; a cell fails only by what breaking adds.
"""

from __future__ import annotations

import faulthandler
import io
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pybullet as p
from scipy.stats import qmc

from ..asset import BreakableAsset, load, write_beside
from ..errors import MissingExtraError
from ..impulse import Impulse
from ..physics.contacts import ContactImpulse
from ..physics.world import FractureEvent, World

FloatArray = npt.NDArray[np.float64]
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
PATIENCE = 60.0  # s, after which a cell counts as hung; the table says what the slowest takes
BUDGET = 540.0  # s, after which no further cell is begun
GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class Cell:
    """One scene, to the last random draw: ``run(Cell(**row["cell"]))`` plays it again.

    family: a key of FAMILIES. time_step: s. speed: m/s, at which things meet. density_ratio: of what is thrown, over
    the breakable's. size: m. breakables: how many. other: "ball", "box" or "floor". severity: of the blow, over what
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
        self.blows: dict[int, dict[int, list[Impulse]]] = {}  # body -> step -> the hits, which act together
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
        asset = _asset(cell.mesh)
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
        mass = ratio * _asset(self.cell.mesh).material.density * volume
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
        self.blows.setdefault(hit.body, {}).setdefault(self.step, []).append(hit.impulse)

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
def _asset(mesh: str) -> BreakableAsset:
    return load(mesh)


def _direction(rng: np.random.Generator) -> FloatArray:
    way: FloatArray = rng.normal(size=3)
    return way / np.linalg.norm(way)


def _turn(rng: np.random.Generator) -> FloatArray:
    quaternion: FloatArray = rng.normal(size=4)
    return quaternion / np.linalg.norm(quaternion)


UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


# The families


def _matrix(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Bodies side by side, each thrown at from somewhere, or all dropped on the floor."""
    n = cell.breakables
    side = int(np.ceil(n ** (1 / 3)))
    asset = _asset(cell.mesh)
    extent = np.ptp(asset.vertices, axis=0) / asset.size * cell.size
    lattice = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:n]
    # Neighbours that all but touch: what breaks one soon reaches the next.
    places = lattice * (extent + 0.01 * cell.size)
    turn = _turn(rng) if n == 1 else UPRIGHT
    if cell.other == "floor":
        stage.floor()
        bodies = [stage.breakable(place, turn) for place in places]
        low = min(p.getAABB(body, -1, physicsClientId=stage.client)[0][2] for body in bodies)
        step = cell.speed * cell.time_step
        rise = step * (APPROACH - min(1.0, 0.1 * cell.size / step) * rng.random())
        rise += GRAVITY * cell.time_step**2 * APPROACH * (APPROACH + 1) / 2 - low
        for body in bodies:
            position, axes = p.getBasePositionAndOrientation(body, physicsClientId=stage.client)
            lifted = (position[0], position[1], position[2] + rise)
            p.resetBasePositionAndOrientation(body, lifted, axes, physicsClientId=stage.client)
            p.resetBaseVelocity(body, (0.0, 0.0, -cell.speed), physicsClientId=stage.client)
        return
    spin = 0.3 * float(rng.random() < 0.5) * float(n == 1)
    bodies = [stage.breakable(place, turn, spin=spin) for place in places]
    reach = 2.0 * float(np.linalg.norm(np.ptp(places, axis=0))) + 3.0 * cell.size
    for target in rng.choice(n, min(n, 4), replace=False):
        missile = stage.missile(cell.size * rng.uniform(0.08, 0.3), cell.other)
        center = np.array(p.getBasePositionAndOrientation(bodies[target], physicsClientId=stage.client)[0])
        stage.aim(missile, bodies, center, _direction(rng), reach, rng.random())
    if rng.random() < 0.5:
        stage.boost(cell.speed * rng.random() * _direction(rng))


def _thrown_at(stage: Stage, cell: Cell, rng: np.random.Generator, delay: int = APPROACH, spin: float = 0.0) -> int:
    """A body at the origin and a missile that comes for it -> the body."""
    body = stage.breakable(ORIGIN, _turn(rng), spin=spin)
    missile = stage.missile(cell.size * rng.uniform(0.1, 0.3), cell.other)
    stage.aim(missile, [body], ORIGIN, _direction(rng), 3.0 * cell.size, rng.random(), delay)
    return body


def _held(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """A body that a constraint holds to the world (variants 0, 1) or to a free block (2, 3), rigidly or by a point."""
    body = _thrown_at(stage, cell, rng)
    joint = p.JOINT_FIXED if cell.variant % 2 == 0 else p.JOINT_POINT2POINT
    _, turn = p.getBasePositionAndOrientation(body, physicsClientId=stage.client)
    if cell.variant < 2:
        stage.free = False
        p.createConstraint(
            body, -1, -1, -1, joint, [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0, 1], turn, physicsClientId=stage.client
        )
        return
    _, high = p.getAABB(body, -1, physicsClientId=stage.client)
    half = 0.3 * cell.size
    block = stage.missile(half, "box", 1.0)
    top = [0.0, 0.0, high[2] + half]
    p.resetBasePositionAndOrientation(block, top, (0, 0, 0, 1), physicsClientId=stage.client)
    _, inverse = p.invertTransform([0, 0, 0], turn)
    arm = p.rotateVector(inverse, top)
    p.createConstraint(
        body, -1, block, -1, joint, [0, 0, 0], arm, [0, 0, 0], inverse, [0, 0, 0, 1], physicsClientId=stage.client
    )


def _post(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Thrown at a static post, thick or thin, or at its edge."""
    stage.free = False
    thickness = cell.size * (0.5, 0.1, 0.02)[cell.variant % 3]
    post = stage.fixture((thickness, thickness, 2.0 * cell.size), ORIGIN)
    body = stage.breakable(np.array([-3.0 * cell.size, 0.0, 0.0]), _turn(rng), spin=0.2)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    stage.aim(body, [post], ORIGIN, way, 4.0 * cell.size, rng.random())


def _mover(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """A body of mass 0 set from place to place (variant 0), with its speed told (1), or a slide on a motor (2)."""
    stage.free = stage.closed = False
    stage.allowed = 3.0 * cell.speed
    body = stage.breakable(ORIGIN, _turn(rng))
    half, way = 0.3 * cell.size, np.array([1.0, 0.0, 0.0])
    client, step = stage.client, cell.speed * cell.time_step
    if cell.variant < 2:
        ram = stage.fixture((half, half, half), ORIGIN)
        stage.aim(ram, [body], ORIGIN, way, 3.0 * cell.size, rng.random(), 0)
        start = np.array(p.getBasePositionAndOrientation(ram, physicsClientId=client)[0])

        def carry(index: int) -> None:
            place = start + (index - APPROACH) * step * way
            p.resetBasePositionAndOrientation(ram, place.tolist(), (0, 0, 0, 1), physicsClientId=client)
            velocity = cell.speed * way if cell.variant == 1 else ORIGIN
            p.resetBaseVelocity(ram, velocity.tolist(), physicsClientId=client)

        carry(0)
        stage.before.append(carry)
        return
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[half] * 3, physicsClientId=client)
    mass = cell.density_ratio * _asset(cell.mesh).material.density * 8.0 * half**3
    slide = p.createMultiBody(
        0,
        basePosition=(-4.0 * cell.size, 0.0, 0.0),
        linkMasses=[mass],
        linkCollisionShapeIndices=[shape],
        linkVisualShapeIndices=[-1],
        linkPositions=[(0, 0, 0)],
        linkOrientations=[(0, 0, 0, 1)],
        linkInertialFramePositions=[(0, 0, 0)],
        linkInertialFrameOrientations=[(0, 0, 0, 1)],
        linkParentIndices=[0],
        linkJointTypes=[p.JOINT_PRISMATIC],
        linkJointAxis=[(1, 0, 0)],
        physicsClientId=client,
    )
    stage.fixtures.append(slide)
    # The object is slid on to the ram, rather than the ram to the object.
    stage.aim(body, [slide], np.array([-4.0 * cell.size, 0.0, 0.0]), -way, 4.0 * cell.size, 0.0, 0, 0.0)
    p.resetJointState(slide, 0, -(APPROACH - rng.random()) * step, cell.speed, physicsClientId=client)
    p.changeDynamics(slide, 0, maxJointVelocity=1e5, physicsClientId=client)
    force = 1e3 * (mass + _asset(cell.mesh).mass * cell.size**3) * cell.speed / cell.time_step
    p.setJointMotorControl2(
        slide, 0, p.VELOCITY_CONTROL, targetVelocity=cell.speed, force=force, physicsClientId=client
    )


def _salvo(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Balls or boxes from six sides, all in the same step."""
    body = stage.breakable(ORIGIN, _turn(rng))
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        missile = stage.missile(cell.size * rng.uniform(0.05, 0.15), cell.other)
        stage.aim(missile, [body], ORIGIN, axis, 3.0 * cell.size, rng.random())


def _tips(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """At what sticks out farthest: head on (variant 0), across (1), or grazing (2)."""
    turn = _turn(rng)
    body = stage.breakable(ORIGIN, turn)
    asset = _asset(cell.mesh)
    rotation = np.reshape(p.getMatrixFromQuaternion(turn.tolist()), (3, 3))
    points = (asset.vertices - asset.center_of_mass) @ rotation.T / asset.size * cell.size
    out = _direction(rng)
    tip = points[np.argmax(points @ out)]
    across = np.cross(out, _direction(rng))
    across /= np.linalg.norm(across)
    radius = cell.size * rng.uniform(0.03, 0.15)
    way = (-out, across, across)[cell.variant % 3]
    target = tip - out * (0.0, 0.02, -0.7)[cell.variant % 3] * (cell.size, cell.size, radius)[cell.variant % 3]
    stage.aim(stage.missile(radius, cell.other), [body], target, way, 3.0 * cell.size, rng.random())


def _inside(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """A ball inside the vase, on its way out through the wall."""
    asset = _asset(cell.mesh)
    turn = _turn(rng)
    body = stage.breakable(ORIGIN, turn)
    rotation = np.reshape(p.getMatrixFromQuaternion(turn.tolist()), (3, 3))
    hollow = rotation @ (np.array([0.0, 0.0, -0.05]) - asset.center_of_mass) * cell.size
    angle = rng.uniform(0.0, 2.0 * np.pi)
    way = rotation @ np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.3, 0.3)])
    way /= np.linalg.norm(way)
    ball = stage.missile(0.07 * cell.size, "ball")
    stage.aim(ball, [body], hollow, way, 0.0, rng.random(), delay=0)
    # Where the wall is too far to be met in two steps, or so near that two steps back lie outside, it starts later.
    place = np.array(p.getBasePositionAndOrientation(ball, physicsClientId=stage.client)[0])
    back = min(APPROACH * cell.speed * cell.time_step, float((place - hollow) @ way))
    p.resetBasePositionAndOrientation(ball, (place - back * way).tolist(), (0, 0, 0, 1), physicsClientId=stage.client)
    p.resetBaseVelocity(ball, (cell.speed * way).tolist(), physicsClientId=stage.client)


def _nested(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Breaking while breaking: again a step (variant 0) or two (1) later, or on command from a callback (2, 3)."""
    body = _thrown_at(stage, cell, rng)
    if cell.variant < 2:
        missile = stage.missile(cell.size * rng.uniform(0.1, 0.2), cell.other)
        stage.aim(missile, [body], ORIGIN, _direction(rng), 3.0 * cell.size, rng.random(), APPROACH + 1 + cell.variant)
        return
    # The bystander is far away, or close enough to be in the same heap of contacts.
    apart = 1.5 if cell.variant == 2 else 4.0
    bystander = stage.breakable(np.array([apart * cell.size, 0.0, 0.0]), UPRIGHT)
    blow = _firm(cell, bystander, stage)

    def command(hit: ContactImpulse) -> None:
        if hit.body == body and bystander in stage.world.bodies:
            event = stage.world.fracture(bystander, blow)
            stage.events += [event] if event.children else []

    stage.world.on_contact(command)


def _removal(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """A user takes away in a callback what was hit (variant 0), what hit it (1) or a bystander (2), or takes pieces
    between steps, through the engine (3) or through the world (4)."""
    stage.free = False
    body = _thrown_at(stage, cell, rng)
    bystander = stage.breakable(np.array([4.0 * cell.size, 0.0, 0.0]), UPRIGHT)
    missile = stage.others[0]

    def answer(hit: ContactImpulse) -> None:
        victim = (body, missile, bystander)[cell.variant]
        if victim in stage.system:
            stage.take(victim)

    def clear(_: int, events: list[FractureEvent]) -> None:
        for child in list(stage.world.pieces)[::2] if events else []:
            stage.take(child, through_world=cell.variant == 4)

    if cell.variant < 3:
        stage.world.on_contact(answer)
    else:
        stage.after.append(clear)


def _worlds(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Two worlds in one process; they are told apart by nothing but their client."""
    _thrown_at(stage, cell, rng, spin=0.2)


def _states(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """A saved state brought back: across the break, where a refusal is an answer too (variants 0, 1), or between two
    breaks, where everything must be where it was (2, 3)."""
    client = stage.client
    body = _thrown_at(stage, cell, rng)
    marks: dict[str, int] = {}
    if cell.variant < 2:
        stage.free = stage.closed = False

        def across(index: int, events: list[FractureEvent]) -> None:
            if index == 0:
                marks["state"] = p.saveState(physicsClientId=client)
            if index == APPROACH + 2 + 4 * cell.variant:
                try:
                    p.restoreState(marks["state"], physicsClientId=client)
                    stage.notes.append("restored")
                except p.error as error:
                    stage.notes.append(f"refused: {error}")

        stage.after.append(across)
        return
    bystander = stage.breakable(np.array([4.0 * cell.size, 0.0, 0.0]), _turn(rng))
    missile = stage.missile(cell.size * rng.uniform(0.1, 0.2), cell.other)
    center = np.array([4.0 * cell.size, 0.0, 0.0])
    stage.aim(missile, [body, bystander], center, _direction(rng), 3.0 * cell.size, rng.random(), APPROACH + 10)
    kept: dict[int, Any] = {}

    def poses() -> dict[int, Any]:
        return {body: p.getBasePositionAndOrientation(body, physicsClientId=client) for body in stage.system}

    def between(index: int, events: list[FractureEvent]) -> None:
        if index == APPROACH + 3:
            marks["state"] = p.saveState(physicsClientId=client)
            kept.update(poses())
        if index == APPROACH + 6 + cell.variant:
            if set(kept) != set(stage.system):  # a piece broke again: the bodies differ
                stage.notes.append("broke in between")
                return
            p.restoreState(marks["state"], physicsClientId=client)
            now = poses()
            moved = [b for b in kept if b not in now or not np.allclose(now[b][0], kept[b][0], rtol=1e-9, atol=0)]
            if moved:
                stage.broken["state"] = f"bodies {moved} are not where the saved state has them"

    stage.after.append(between)
    stage.steps += 10


def _robot(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """An arm that swings into the object: a KUKA iiwa (even variants) or a Franka Panda."""
    import pybullet_data

    stage.free = stage.closed = False
    client = stage.client
    name = ("kuka_iiwa/model.urdf", "franka_panda/panda.urdf")[cell.variant % 2]
    arm = p.loadURDF(
        os.path.join(pybullet_data.getDataPath(), name), [0, 0, 0], useFixedBase=True, physicsClientId=client
    )
    stage.fixtures.append(arm)
    rates = cell.speed / 0.7  # rad/s of the first joint, for the speed at 0.7 m
    stage.allowed = 6.0 * cell.speed
    stretched = {1: 1.3} if cell.variant % 2 == 0 else {1: 1.0, 3: -0.8, 5: 1.6}
    for joint in range(p.getNumJoints(arm, physicsClientId=client)):
        p.resetJointState(arm, joint, stretched.get(joint, 0.0), physicsClientId=client)
        p.setJointMotorControl2(
            arm, joint, p.VELOCITY_CONTROL, targetVelocity=rates if joint == 0 else 0.0, force=1e4,
            physicsClientId=client,
        )  # fmt: skip
        p.changeDynamics(arm, joint, maxJointVelocity=1e4, physicsClientId=client)
    hand = np.array(p.getLinkState(arm, 6, physicsClientId=client)[0])
    way = np.cross([0.0, 0.0, 1.0], hand)
    way /= np.linalg.norm(way)
    body = stage.breakable(hand, _turn(rng))
    stage.aim(body, [arm], hand, -way, 2.0 * cell.size + 1.0, 0.0, 0, 0.0)
    turn = -(APPROACH - rng.random()) * rates * cell.time_step
    p.resetJointState(arm, 0, turn, rates, physicsClientId=client)


def _rest(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Broken on command: at rest in free space (variant 0), in full flight (1), standing on a floor (2)."""
    body = stage.breakable(ORIGIN, UPRIGHT if cell.variant == 2 else _turn(rng), spin=0.5 if cell.variant == 1 else 0.0)
    if cell.variant == 0:
        stage.still = 1e-3 * cell.size
        stage.allowed = stage.still
    elif cell.variant == 1:
        stage.boost(cell.speed * _direction(rng))
    else:
        stage.floor()
        low = p.getAABB(body, -1, physicsClientId=stage.client)[0][2]
        place = np.array([0.0, 0.0, 1e-3 * cell.size - low])
        _, axes = p.getBasePositionAndOrientation(body, physicsClientId=stage.client)
        p.resetBasePositionAndOrientation(body, place.tolist(), axes, physicsClientId=stage.client)
    blow = _firm(cell, body, stage)

    def command(index: int) -> None:
        if index == APPROACH and body in stage.world.bodies:
            event = stage.world.fracture(body, blow)
            stage.events += [event] if event.children else []

    stage.before.append(command)
    stage.steps = 60


def _firm(cell: Cell, body: int, stage: Stage) -> Impulse:
    """A blow on command, in the twin as in the scene, that breaks the object as it is made."""
    asset = _asset(cell.mesh).scaled(cell.size / _asset(cell.mesh).size)
    [blow] = asset.sample_impulses(1, cell.seed)
    return Impulse(blow.point, blow.direction, 10.0 * asset.mass * asset.material.breaking_velocity)


FAMILIES: dict[str, tuple[Callable[[Stage, Cell, np.random.Generator], None], int]] = {  # with the number of variants
    "matrix": (_matrix, 1),
    "held": (_held, 4),
    "post": (_post, 3),
    "mover": (_mover, 3),
    "salvo": (_salvo, 1),
    "tips": (_tips, 3),
    "inside": (_inside, 1),
    "nested": (_nested, 4),
    "removal": (_removal, 5),
    "worlds": (_worlds, 1),
    "states": (_states, 4),
    "robot": (_robot, 2),
    "rest": (_rest, 3),
}


# A cell


def run(cell: Cell, tell: Callable[[str], object] = lambda phase: None) -> Row:
    """Play a cell and its twin -> what held and what did not; tell: called with what begins."""
    start = time.perf_counter()
    tell("twin")
    twin, strengths = _play(cell, None)
    tell("breaking")
    live, _ = _play(cell, strengths)
    row: Row = {"cell": asdict(cell), "live": live, "twin": twin, "broke": live["events"] > 0, "failures": []}
    row["failures"], row["engine"] = _judge(live, twin)
    row["seconds"] = time.perf_counter() - start
    return row


def _judge(live: dict[str, Any], twin: dict[str, Any]) -> tuple[list[str], list[str]]:
    """The checks that only the breaking scene violates, and those that its twin violates as well."""
    failures: list[str] = []
    engine: list[str] = []
    for name in live["broken"]:
        (engine if name in twin["broken"] else failures).append(name)
    for name, limit in LIMITS.items():
        found, other = (figures["residuals"].get(name) for figures in (live, twin))
        if found is not None and not found <= limit:
            (engine if other is not None and not other <= limit else failures).append(name)
    return failures, engine


def _play(cell: Cell, strengths: Sequence[float] | None) -> tuple[dict[str, Any], list[float]]:
    """Play a cell once -> the figures, and what strengths would make its bodies break."""
    stages: list[Stage] = []
    build = FAMILIES[cell.family][0]
    try:
        for _ in range(2 if cell.family == "worlds" else 1):
            stages.append(Stage(cell, strengths))
            build(stages[-1], cell, np.random.default_rng(cell.seed))
        for stage in stages:
            stage.begin()
        for _ in range(stages[0].steps):
            for stage in stages:
                stage.advance()
                if "nan" in stage.broken:
                    break
    except Exception as error:
        stages[-1].broken["exception"] = f"{type(error).__name__}: {error}"
    finally:
        for stage in stages:
            stage.close()
    found = [stage.figures() for stage in stages]
    figures = found[0]
    for further in found[1:]:
        for name, value in further["residuals"].items():
            if value is not None:
                figures["residuals"][name] = max(figures["residuals"][name], value)
        figures["broken"] |= further["broken"]
        if further["pieces"] != figures["pieces"]:
            figures["broken"]["worlds"] = "one scene in two worlds came to different ends"
    return figures, [] if strengths is not None else _strengths(stages[0])


def _strengths(stage: Stage) -> list[float]:
    """Pa, for each body: the blow that it took is `severity` times what just breaks it."""
    nominal = _asset(stage.cell.mesh).material.tensile_strength
    asset = _asset(stage.cell.mesh).scaled(stage.cell.size / _asset(stage.cell.mesh).size)
    found: list[float | None] = []
    for body in stage.bodies:
        blows = stage.blows.get(body)
        if blows:
            hardest = max(blows.values(), key=lambda hits: sum(hit.magnitude for hit in hits))
            found.append(nominal * _overload(asset, hardest) / stage.cell.severity)
        else:
            found.append(None)
    # What was not hit is as strong as the weakest that was: debris may break it.
    hit = [strength for strength in found if strength]
    default = min(hit) if hit and stage.cell.family == "matrix" else nominal
    return [strength or default for strength in found]


def _overload(asset: BreakableAsset, hits: Sequence[Impulse]) -> float:
    """How many times what just breaks the asset these hits are, to a fifth."""
    unit = sum(hit.magnitude for hit in hits) / (asset.mass * asset.material.breaking_velocity)
    low, high = 0.2, 90.0  # total severity
    if not unit > 0.0:
        return 1.0

    def breaks(severity: float) -> bool:
        blows = [Impulse(hit.point, hit.direction, hit.magnitude * severity / unit) for hit in hits]
        return asset.may_break(blows) and asset.fracture(blows).broken

    for _ in range(5):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if breaks(middle) else (middle, high)
    return unit / high


# The matrix


def cells(quick: bool, seed: int) -> list[Cell]:
    """The whole stress matrix: each family, the corners and ends of the axes, and what lies between."""
    rng = np.random.default_rng(seed)
    names = tuple(RANGES)[:4]
    middle = dict(zip(names, (1 / 240, 5.0, 1.0, 0.3), strict=True))
    chosen: list[dict[str, Any]] = [
        {name: RANGES[name][corner >> k & 1] for k, name in enumerate(names)}
        for corner in range(0, 16, 3 if quick else 1)
    ]
    if not quick:
        chosen += [middle | {name: end} for name in names for end in RANGES[name]]
        chosen += [middle | {"breakables": count} for count in COUNTS]
    listed = [
        cell
        for name, (_, variants) in FAMILIES.items()
        if name != "matrix"
        for cell in _family(name, variants, max(1, variants // 2) if quick else max(8, 3 * variants), rng)
    ]
    for i, axes in enumerate(chosen + _spread(24 if quick else 400, rng)):
        drawn = int(rng.integers(2**31))
        if quick:  # crowds take their time
            axes |= {"breakables": min(axes.get("breakables", 1), COUNTS[1])}
        scene = {"breakables": 1, "other": ("ball", "box")[i // 3 % 2], "severity": 4.0, **axes}
        listed.append(Cell(family="matrix", mesh=MESHES[i % 3], variant=0, seed=drawn, **scene))
    return listed


def _spread(count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Latin hypercube over the axes."""
    unit = qmc.LatinHypercube(len(RANGES) + 2, seed=rng).random(count)
    result = []
    for row in unit:
        axes: dict[str, Any] = {
            name: float(low * (high / low) ** share)
            for share, (name, (low, high)) in zip(row, RANGES.items(), strict=False)
        }
        index = min(int(np.searchsorted(np.cumsum(SHARES), row[-1])), len(COUNTS) - 1)
        axes["breakables"] = COUNTS[index]
        if index >= 3:
            axes["severity"] = min(axes["severity"], 3.0)  # a thousand pieces are enough
        if row[-2] > 0.8:
            axes["other"] = "floor"
        result.append(axes)
    return result


def _family(name: str, variants: int, count: int, rng: np.random.Generator) -> list[Cell]:
    """Scenes of one family, over the axes and its variants."""
    result = []
    for i, axes in enumerate(_spread(count, rng)):
        axes |= {
            "breakables": {"worlds": 2, "removal": 2}.get(name, 1),
            "other": "floor" if name == "rest" else ("ball", "box")[i // variants % 2],
            "mesh": "vase" if name == "inside" else MESHES[(i + i // variants) % 3],
            "variant": i % variants if count >= variants else int(rng.integers(variants)),
            "seed": int(rng.integers(2**31)),
        }
        if name == "robot":  # an arm has a size of its own, and joints have a speed
            axes["size"] = float(np.clip(axes["size"], 0.1, 0.6))
            axes["speed"] = float(np.clip(axes["speed"], 0.5, 10.0))
        result.append(Cell(family=name, **axes))
    return result


class _Player:
    """A process that plays cells, so that a crash of the engine is a cell's failure and not the end of the run."""

    def __init__(self) -> None:
        handle, self._trace = tempfile.mkstemp(prefix="fracsim-stability-", suffix=".txt")
        os.close(handle)
        self._start()

    def _start(self) -> None:
        context = get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._trace), daemon=True)
        self._process.start()
        theirs.close()

    def play(self, cell: Cell) -> Row:
        """Play a cell; when the process dies or does not come back, that is what is found."""
        start, phase = time.perf_counter(), "twin"
        try:
            self._ours.send(cell)
            while self._ours.poll(PATIENCE):
                answer = self._ours.recv()
                if not isinstance(answer, str):
                    found: Row = answer
                    return found
                phase = answer
            kind, what = "hang", f"no answer within {PATIENCE:g} s"
        except (EOFError, OSError):
            self._process.join(5.0)
            code = self._process.exitcode or 0
            kind, what = "crash", f"{signal.Signals(-code).name if code < 0 else f'exit {code}'}{self._place()}"
        self.stop()
        self._start()
        nothing: dict[str, Any] = {"residuals": {}, "broken": {kind: what}, "notes": [], "events": 0, "pieces": 0}
        whole = {**nothing, "broken": {} if phase == "breaking" else {kind: what}}
        failures, engine = _judge(nothing, whole)
        return {
            "cell": asdict(cell),
            "live": nothing,
            "twin": whole,
            "broke": False,
            "failures": failures,
            "engine": engine,
            "seconds": time.perf_counter() - start,
        }

    def _place(self) -> str:
        """Where Python was when it crashed."""
        lines = Path(self._trace).read_text().splitlines()
        Path(self._trace).write_text("")
        return "".join(f", {line.strip()}" for line in lines if line.startswith("  File"))[:500]

    def stop(self) -> None:
        self._process.kill()
        self._process.join()
        self._ours.close()

    def close(self) -> None:
        self.stop()
        os.unlink(self._trace)


def _serve(connection: Connection, trace: str) -> None:
    """The process's side: answer each cell with its row."""
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)  # the engine prints what it thinks
    with open(trace, "a") as file:
        faulthandler.enable(file)
        while True:
            try:
                cell = connection.recv()
            except EOFError:
                return
            connection.send(run(cell, connection.send))


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Play the stress matrix -> its rows. quick: a tenth of it. progress: called with the share done."""
    start = time.perf_counter()
    listed = cells(quick, seed)
    rows = []
    player = _Player()
    try:
        for index, cell in enumerate(listed):
            if time.perf_counter() - start > BUDGET:
                break
            rows.append(player.play(cell))
            progress((index + 1) / len(listed))
    finally:
        player.close()
    return {
        "quick": quick,
        "seed": seed,
        "limits": LIMITS,
        "cells": len(rows),
        "left": len(listed) - len(rows),
        "broke": sum(row["broke"] for row in rows),
        "failed": sum(bool(row["failures"]) for row in rows),
        "seconds": time.perf_counter() - start,
        "rows": rows,
    }


# Reading it


def table(figures: dict[str, Any]) -> str:
    """What held and what did not, as Markdown: by family, by kind of failure, and cell by cell what failed."""
    rows: list[Row] = figures["rows"]
    names = [name for name in FAMILIES if any(row["cell"]["family"] == name for row in rows)]
    kinds = sorted({kind for row in rows for kind in (*row["failures"], *row["engine"])})
    left = f" {figures['left']} cells were not played for want of time." if figures["left"] else ""
    lines = [
        f"{figures['cells']} cells (seed {figures['seed']}) in {figures['seconds']:.0f} s; {figures['broke']} broke "
        f"({figures['broke'] / max(figures['cells'], 1):.0%}), {figures['failed']} failed; "
        f"the slowest took {max(row['seconds'] for row in rows):.0f} s.{left}",
        "",
        "A cell fails by what its twin, the same scene with bodies that cannot break, does not do as well; what the",
        "twin does too is the engine's. Momentum: worst change of the total over Σ|p|. Energy: worst gain, over what",
        "there was and gravity's work. Both are the worst of any step, over the cells that check them.",
        "",
        "| family | cells | broke | pieces, median | failed | engine's | worst momentum | worst energy | s a cell |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in [*names, "all"]:
        own = [row for row in rows if name in ("all", row["cell"]["family"])]
        pieces = [row["live"]["pieces"] for row in own if row["broke"]]
        lines.append(
            f"| {name} | {len(own)} | {sum(row['broke'] for row in own)} | {np.median(pieces) if pieces else 0:.0f} "
            f"| {sum(bool(row['failures']) for row in own)} | {sum(bool(row['engine']) for row in own)} "
            f"| {_worst(own, 'momentum')} | {_worst(own, 'energy')} "
            f"| {np.mean([row['seconds'] for row in own]):.2f} |"
        )
    if kinds:
        lines += ["", "| violated: ours / the engine's | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
        for name in [*names, "all"]:
            own = [row for row in rows if name in ("all", row["cell"]["family"])]
            counts = [(sum(k in row["failures"] for row in own), sum(k in row["engine"] for row in own)) for k in kinds]
            if any(map(any, counts)):
                lines.append(f"| {name} | " + " | ".join(f"{a} / {b}" if a or b else "" for a, b in counts) + " |")
    failed = [row for row in rows if row["failures"]]
    if failed:
        lines += [
            "",
            "What failed. With a gain of energy: how much of all energy was rotation then. Turn: rad, the farthest",
            "that a piece turned in one step; beyond 0.2 the engine's own integration of a free spin gains energy.",
            "Overlap: of the size, how deep new pieces stood in each other or in what had hit their parent, which the",
            "engine turns into speed; it is small against what is fast and much against what is slow.",
            "",
            "| family | what | time step | m/s | density ratio | m | n | mesh | other | severity "
            "| found | turn | overlap | seed |",
            "|---" * 14 + "|",
        ]
    lines += [_line(row) for row in failed]
    notes: dict[str, int] = {}
    for row in rows:
        for note in row["live"]["notes"]:
            notes[note] = notes.get(note, 0) + 1
    if notes:
        lines += ["", "Told by the scenes: " + ", ".join(f"{note} ({count})" for note, count in notes.items()) + "."]
    return "\n".join(lines)


def _worst(rows: Iterable[Row], name: str) -> str:
    values = [row["live"]["residuals"].get(name) for row in rows]
    found = [value for value in values if value is not None]
    return f"{max(found):.1e}" if found else "–"


def _line(row: Row) -> str:
    cell, live = row["cell"], row["live"]
    found = []
    for kind in row["failures"]:
        residual = live["residuals"].get(kind)
        text = live["broken"].get(kind, "") if residual is None else f"{residual:.2g}"
        if kind == "energy" and residual is not None:
            text += f" ({live['spinning']:.0%} rotation)"
        found.append(text.replace("|", "/"))
    return (
        f"| {cell['family']} {cell['variant']} | {', '.join(row['failures'])} | 1/{1 / cell['time_step']:.0f} "
        f"| {cell['speed']:.3g} | {cell['density_ratio']:.2g} | {cell['size']:.2g} | {cell['breakables']} "
        f"| {cell['mesh']} | {cell['other']} | {cell['severity']:.2g} | {'; '.join(found)} "
        f"| {live.get('turn', 0.0):.2g} | {live.get('overlap', 0.0):.2g} | {cell['seed']} |"
    )


def draw(figures: dict[str, Any], path: Path) -> None:
    """A picture of the matrix: what momentum and energy did over time step and speed, what failed over density ratio
    and size, and each family.

    Raises MissingExtraError without matplotlib.
    """
    try:
        from matplotlib.colors import LogNorm
        from matplotlib.figure import Figure
        from matplotlib.ticker import FuncFormatter
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot") from error
    rows: list[Row] = figures["rows"]
    matrix = [row for row in rows if row["cell"]["family"] == "matrix"]
    figure = Figure(figsize=(13, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    figure.suptitle(f"{figures['cells']} scenes, {figures['broke']} broke, {figures['failed']} failed")
    labels = {"time_step": "time step, s", "speed": "speed, m/s", "density_ratio": "density ratio", "size": "size, m"}

    def bins(name: str, count: int) -> FloatArray:
        low, high = RANGES[name]
        return np.geomspace(low * (1 - 1e-9), high * (1 + 1e-9), count + 1)

    def grid(axis: Any, x: str, y: str, of: Callable[[list[Row]], float], **style: Any) -> None:
        across, up = bins(x, 6), bins(y, 5)
        values = np.full((5, 6), np.nan)
        for (j, i), _ in np.ndenumerate(values):
            own = [
                row
                for row in matrix
                if across[i] <= row["cell"][x] < across[i + 1] and up[j] <= row["cell"][y] < up[j + 1]
            ]
            if own:
                values[j, i] = of(own)
                failed = sum(bool(row["failures"]) for row in own)
                place = np.sqrt(across[i] * across[i + 1]), np.sqrt(up[j] * up[j + 1])
                axis.text(*place, f"{failed}/{len(own)}", ha="center", va="center", fontsize=9)
        mesh = axis.pcolormesh(across, up, values, edgecolor="white", **style)
        axis.set(xscale="log", yscale="log", xlabel=labels[x], ylabel=labels[y])
        if y == "time_step":
            steps = [1 / 2000, 1 / 1000, 1 / 500, 1 / 240, 1 / 120, 1 / 60]
            axis.set_yticks(steps, minor=False)
            axis.set_yticks([], minor=True)
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"1/{1 / value:.0f}"))
        figure.colorbar(mesh, ax=axis)

    def worst(name: str, floor: float) -> Callable[[list[Row]], float]:
        def of(own: list[Row]) -> float:
            values = [row["live"]["residuals"].get(name) for row in own if name not in row["engine"]]
            return max([floor, *(value for value in values if value is not None)])

        return of

    def share(own: list[Row]) -> float:
        return sum(bool(row["failures"]) for row in own) / len(own)

    color = {"cmap": "RdYlGn_r"}
    grid(axes[0, 0], "speed", "time_step", worst("momentum", 1e-16), norm=LogNorm(1e-16, 1e-3), **color)
    axes[0, 0].set_title("worst change of momentum, of Σ|p| (failed / cells)")
    grid(axes[0, 1], "speed", "time_step", worst("energy", 1e-4), norm=LogNorm(1e-4, 1e2), **color)
    axes[0, 1].set_title("worst gain of energy, relative, where the twin has none (failed / cells)")
    grid(axes[1, 0], "density_ratio", "size", share, vmin=0.0, vmax=1.0, **color)
    axes[1, 0].set_title("share that failed (failed / cells)")
    names = [name for name in FAMILIES if any(row["cell"]["family"] == name for row in rows)][::-1]
    left = np.zeros(len(names))
    verdicts: tuple[tuple[str, str, Callable[[Row], bool]], ...] = (
        ("held, broke", "#4c9f70", lambda row: not row["failures"] and not row["engine"] and row["broke"]),
        ("held, did not break", "#b8d8c0", lambda row: not row["failures"] and not row["engine"] and not row["broke"]),
        ("the engine's", "#b0b0b0", lambda row: not row["failures"] and bool(row["engine"])),
        ("failed", "#c8452f", lambda row: bool(row["failures"])),
    )
    totals = [sum(row["cell"]["family"] == name for row in rows) for name in names]
    for label, shade, belongs in verdicts:
        counts = np.array([sum(row["cell"]["family"] == name and belongs(row) for row in rows) for name in names])
        width = counts / np.array(totals)
        axes[1, 1].barh(names, width, left=left, color=shade, label=label)
        left += width
    axes[1, 1].set_yticks(range(len(names)), [f"{name} ({total})" for name, total in zip(names, totals, strict=True)])
    axes[1, 1].set(xlim=(0, 1), title="families (cells)")
    axes[1, 1].legend(loc="lower center", bbox_to_anchor=(0.5, -0.2), ncols=4, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_beside(path, buffer.getvalue())
