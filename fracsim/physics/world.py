"""The world of breakable bodies: it watches contacts, asks the asset, and swaps a body for its pieces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import PhysicsError
from ..impulse import Impulse, as_impulses
from .bodies import GLAZE, SHARDS, Body, Pose, quaternion_of, spawn
from .contacts import ContactImpulse, anything_moves, gate, predict
from .engine import Engine, Surface, rotation_of

if TYPE_CHECKING:
    from ..asset import BreakableAsset, Fracture

FloatArray = npt.NDArray[np.float64]
Vector = Sequence[float] | FloatArray
ContactCallback = Callable[[ContactImpulse], object]

_MARGIN = 1e-3  # of the size; the gap between the convex parts of two pieces is 3e-3


@dataclass(frozen=True, eq=False)
class FractureEvent:
    """A body that broke, or held when it was told to break.

    parent: its id, gone from the engine unless `children` is empty.
    children: the ids of the pieces, in the order of fracture.pieces; () when it did not break.
    impulses: what it was hit with, in the asset's frame, strongest first.
    fracture: the model's answer. time: s, simulated by this world.
    timings: ms of each stage: impulse (contacts to impulses), fracture (model to pieces), bodies (the swap).
    """

    parent: int
    children: tuple[int, ...]
    impulses: tuple[Impulse, ...]
    fracture: Fracture
    time: float
    timings: dict[str, float]

    @property
    def impulse(self) -> Impulse:
        """The strongest impulse."""
        return self.impulses[0]


@dataclass(frozen=True, eq=False)
class _Breakable:
    asset: BreakableAsset
    body: Body
    damping: tuple[float, float]


class World:
    """Breakable bodies in a connected PyBullet client.

    It owns nothing that it did not create and sets no engine-wide parameter; make a new World after
    resetSimulation. PyBullet reports the centre of mass of a body; `pose` gives the asset's frame.

    client: a physics client id, as pybullet.connect returns it.
    visuals: give bodies visual shapes. None: only when the client has a window.

    Example
    -------
    >>> world = fracsim.World(pybullet.connect(pybullet.DIRECT))
    >>> body = world.add(fracsim.load("vase"), position=(0, 0, 2))
    >>> while not (events := world.step()): pass
    """

    def __init__(self, client: int, visuals: bool | None = None) -> None:
        self._engine = Engine(client)
        self.client = client
        self.visuals = self._engine.has_window if visuals is None else visuals
        self.time = 0.0  # s, simulated by step()
        self._breakables: dict[int, _Breakable] = {}
        self._pieces: dict[int, Body] = {}
        self._callbacks: list[ContactCallback] = []

    @property
    def bodies(self) -> tuple[int, ...]:
        """The ids of the unbroken breakable bodies."""
        self._forget_removed(self._breakables)
        return tuple(self._breakables)

    @property
    def pieces(self) -> tuple[int, ...]:
        """The ids of the pieces of everything that broke."""
        self._forget_removed(self._pieces)
        return tuple(self._pieces)

    def add(
        self,
        asset: BreakableAsset,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        linear_velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        scale: float = 1.0,
        *,
        linear_damping: float = 0.04,
        angular_damping: float = 0.04,
    ) -> int:
        """Put an unbroken asset into the world -> its PyBullet body id.

        position, orientation (x, y, z, w): of the asset's frame. linear_velocity: of the centre of mass.
        scale: of lengths; a scale of 2 is 8 times the mass.
        linear_damping, angular_damping: share of the velocity lost per second. Pieces inherit these, since
        the engine does not tell; friction and restitution they take from the body as it is when it breaks.
        """
        self._engine.require_connection()
        if not (np.isfinite(scale) and scale > 0.0):
            raise PhysicsError(f"scale must be a positive number, got {scale}")
        if scale != 1.0:
            asset = asset.scaled(scale)
        quaternion = _vector(orientation, "orientation", 4)
        if not quaternion.any():
            raise PhysicsError("orientation is the zero quaternion; no rotation is (0, 0, 0, 1)")
        rotation = rotation_of((quaternion / np.linalg.norm(quaternion)).tolist())
        angular = _vector(angular_velocity, "angular_velocity", 3)
        linear = _vector(linear_velocity, "linear_velocity", 3)
        linear = linear - np.cross(angular, rotation @ asset.center_of_mass)
        pose = Pose(_vector(position, "position", 3), rotation, linear, angular)
        surface = Surface(
            friction=getattr(asset.material, "friction", 0.5),
            restitution=getattr(asset.material, "restitution", 0.1),
            margin=_MARGIN * asset.size,
            linear_damping=linear_damping,
            angular_damping=angular_damping,
        )
        body = spawn(self._engine, asset, pose, surface, GLAZE if self.visuals else None)
        self._breakables[body.id] = _Breakable(asset, body, (linear_damping, angular_damping))
        return body.id

    def remove(self, body: int) -> None:
        """Remove a breakable body or a piece that this world made."""
        self._engine.require_connection()
        self._find(body)
        self._engine.remove(body)
        self._breakables.pop(body, None)
        self._pieces.pop(body, None)

    def asset(self, body: int) -> BreakableAsset:
        """The asset of an unbroken body, at the body's scale."""
        return self._breakable(body).asset

    def pose(self, body: int) -> tuple[FloatArray, FloatArray]:
        """Position (3,) and orientation (x, y, z, w) of the asset's frame, of a body or of a piece."""
        pose = self._find(body).pose_now(self._engine)
        return pose.position, quaternion_of(pose.rotation)

    def on_contact(self, callback: ContactCallback) -> Callable[[], None]:
        """Call back with each hit on a breakable body, before it breaks -> a function that ends it.

        A hit is a contact that closes faster than max(0.1 m/s, 3 g dt), and whatever else the body leans
        on at that moment. The callback may add and remove bodies.
        """
        self._callbacks.append(callback)

        def unregister() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return unregister

    def step(self) -> list[FractureEvent]:
        """Advance the simulation by one time step and break what was hit hard enough -> what broke.

        All hits on a body in one step act together. If what it hit is static, its pieces take over the
        motion from before the impact and meet the obstacle themselves; if it is a moving body, they take
        over the motion after the step, in which the engine has already exchanged the momentum.
        """
        engine = self._engine
        engine.require_connection()
        self._forget_removed(self._breakables)
        dt, gravity = engine.clock()
        self.time += dt
        if not self._breakables:
            engine.step()
            return []
        motions = engine.motions()
        if not anything_moves(motions.values(), gate(dt, gravity)):
            engine.step()
            return []
        before = {body: engine.placement(body) for body in self._breakables}
        engine.step()

        struck = []
        for body, record in self._breakables.items():
            start = perf_counter()
            hits = predict(engine, record.body, before[body], motions, dt, gravity)
            if hits:
                struck.append((record, hits, 1e3 * (perf_counter() - start)))
        for callback in tuple(self._callbacks):
            for _, hits, _ in struck:
                for hit in hits:
                    callback(hit)
        if self._callbacks:
            self._forget_removed(self._breakables)

        events = []
        for record, hits, elapsed in struck:
            body = record.body.id
            impulses = tuple(hit.impulse for hit in hits)
            if self._breakables.get(body) is not record or not record.asset.may_break(impulses):
                continue
            shared = any(hit.moving and hit.impulse.magnitude > 0.1 * impulses[0].magnitude for hit in hits)
            pose = None if shared else record.body.pose(before[body], motions[body, -1])
            event = self._break(record, impulses, pose, {"impulse": elapsed})
            if event.children:
                events.append(event)
        return events

    def fracture(self, body: int, impulse: Impulse | Sequence[Impulse]) -> FractureEvent:
        """Break a body on command, with impulses in its asset's frame -> the event; children () if it held.

        The impulses decide the cracks and add no momentum: the pieces go on with the motion the body has.
        """
        self._engine.require_connection()
        impulses = sorted(as_impulses(impulse), key=lambda one: -one.magnitude)
        return self._break(self._breakable(body), tuple(impulses), None, {"impulse": 0.0})

    def _break(
        self, record: _Breakable, impulses: tuple[Impulse, ...], pose: Pose | None, timings: dict[str, float]
    ) -> FractureEvent:
        """Swap a body for its pieces at `pose`, by default where it is now, if the impulses break it."""
        engine, parent = self._engine, record.body
        start = perf_counter()
        fracture = record.asset.fracture(impulses)
        answered = perf_counter()
        children: tuple[int, ...] = ()
        if len(fracture.pieces) > 1:
            pose = pose or parent.pose_now(engine)
            surface = engine.surface(parent.id, *record.damping)
            pieces = [
                spawn(engine, piece, pose, surface, SHARDS[i % len(SHARDS)] if self.visuals else None)
                for i, piece in enumerate(fracture.pieces)
            ]
            engine.remove(parent.id)  # after the pieces, so that none of them gets its id
            del self._breakables[parent.id]
            self._pieces.update({piece.id: piece for piece in pieces})
            children = tuple(piece.id for piece in pieces)
        timings |= {"fracture": 1e3 * (answered - start), "bodies": 1e3 * (perf_counter() - answered)}
        return FractureEvent(parent.id, children, impulses, fracture, self.time, timings)

    def _breakable(self, body: int) -> _Breakable:
        self._find(body)
        if body not in self._breakables:
            raise PhysicsError(f"body {body} is a piece; only unbroken bodies, world.bodies, have an asset and break")
        return self._breakables[body]

    def _find(self, body: int) -> Body:
        self._forget_removed(self._breakables)
        self._forget_removed(self._pieces)
        if body in self._breakables:
            return self._breakables[body].body
        if body in self._pieces:
            return self._pieces[body]
        raise PhysicsError(f"body {body} is not in this world; it has {[*self._breakables, *self._pieces]}")

    def _forget_removed(self, records: dict[int, Any]) -> None:
        """Drop the records of bodies that somebody else took out of the engine."""
        for body, record in tuple(records.items()):
            token = (record.body if isinstance(record, _Breakable) else record).token
            if not self._engine.is_marked(body, token):
                del records[body]


def _vector(value: Vector, name: str, length: int) -> FloatArray:
    vector = np.array(value, dtype=np.float64)
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise PhysicsError(f"{name} must be {length} finite numbers, got {value}")
    return vector
