"""The world of breakable bodies: it watches contacts, asks the asset, and swaps a body for its pieces."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ..common.arrays import FloatArray
from ..common.checks import Vector, at_least, finite_vector, is_number
from ..common.errors import PhysicsError
from ..common.impulse import Impulse, as_impulses
from .activity import Activity
from .bodies import PIECE_COLOURS, WHOLE_COLOUR, Body, Pose, spawn
from .bullet import Engine
from .energy import DISSIPATION_TIME, GUARD_TIME, CrackEnergy, Dissipation, PenetrationGuard, RigidStates, dissipate
from .events import FractureEvent
from .impact_solver import IMPACT_WINDOW
from .impacts import LOAD_DURATION, ContactImpulse, impact_speed_threshold, predict_impacts, sustained_impulses
from .live_convex import DECOMPOSITIONS, Refinement, refined_now, require_decomposition
from .records import BodyRecord
from .replacement import contact_island, transfer_constraint, velocity_before_step
from .rotations import quaternion_of, rotation_of
from .spin import GyroscopicCorrection
from .states import BodyNotFound, BodyState, ContactForces, ContactProperties, Motion, Triple

if TYPE_CHECKING:
    from ..fracture.asset import BreakableAsset, BreakablePiece
    from ..fracture.pieces import Piece
    from ..fracture.result import Fracture

ContactCallback = Callable[[ContactImpulse], object]

_MARGIN = 5e-4  # of the size; the gap between the convex parts of two pieces is 1.5e-3
_SAME_PLACE = 0.05  # of the size: a hit so near to one just counted, from the same body, is the rest of that
_CLOCK = 8  # steps in which a change of the time step or of gravity is noticed at the latest
_AFTER = 0.02  # s for which nothing that was in a break may break its pieces: that impact is counted


@dataclass(eq=False)
class _Break:
    """A body that is to be broken."""

    record: BodyRecord
    impulses: tuple[Impulse, ...]
    fracture: Fracture
    others: frozenset[int]
    timings: dict[str, float]


class World:
    """Breakable bodies in a connected PyBullet client.

    It owns nothing that it did not create and sets no engine-wide parameter; make a new World after
    resetSimulation. PyBullet reports the centre of mass of a body; `pose` gives the asset's frame.

    client: a physics client id, as pybullet.connect returns it.
    visuals: give bodies visual shapes. None: only when the client has a window.
    generations: how often what breaks may break again; 1: pieces stay as they are.
    smallest: of the volume of what was added: a smaller piece breaks no more.
    budget: how many pieces there may be; of more, the smallest and stillest are removed. None: any number.
    fatigue: exponent n of Miner's rule: an impact that is the share r of what breaks a body uses up r**n of its strength.
    None: any number of impacts that break nothing leave no trace.
    decomposition: where the convex parts of pieces come from. "baked": the asset, in a fraction of a frame. "coacd":
    CoACD on each piece as it breaks, in seconds. "background": the same in another process, the pieces beginning as
    baked and taking over the finer parts, ids kept, ``refine_after`` s of simulated time after the break; the step
    waits for them if it must, so that a run is the same each time. The latter two need the extra ``bake``.

    Example
    -------
    >>> world = fracsim.World(pybullet.connect(pybullet.DIRECT))
    >>> body = world.add(fracsim.load("vase"), position=(0, 0, 2))
    >>> while not (events := world.step()): pass
    """

    def __init__(
        self,
        client: int,
        visuals: bool | None = None,
        *,
        generations: int = 3,
        smallest: float = 0.01,
        budget: int | None = None,
        fatigue: float | None = None,
        decomposition: str = "baked",
        refine_after: float = 0.5,
    ) -> None:
        self._engine = Engine(client)
        self.client = self._engine.client
        self.visuals = self._engine.has_window if visuals is None else visuals
        self.generations = int(at_least(generations, 1, "generations"))
        self.smallest = at_least(smallest, 0.0, "smallest")
        self.budget = None if budget is None else int(at_least(budget, 0, "budget"))
        self.fatigue = None if fatigue is None else at_least(fatigue, 1.0, "fatigue")
        if decomposition not in DECOMPOSITIONS:
            raise PhysicsError(f"unknown decomposition {decomposition!r}; use one of {', '.join(DECOMPOSITIONS)}")
        if decomposition != "baked":
            require_decomposition()
        self.decomposition = decomposition
        self.refine_after = at_least(refine_after, 0.0, "refine_after")
        self._refining: list[Refinement] = []
        self._activity = Activity(self._engine)
        self._pieces: dict[int, Body] = {}
        self._damping: dict[int, tuple[float, float]] = {}  # of the pieces; the engine does not tell
        self._spin = GyroscopicCorrection(self._engine)
        self._callbacks: list[ContactCallback] = []
        self._cooling: list[Dissipation] = []
        self._parting: list[PenetrationGuard] = []
        self._told: frozenset[tuple[int, int]] = frozenset()  # hits that are relived in the step to come
        self._warned: set[tuple[str, str]] = set()
        self._renamed: dict[int, int] = {}  # constraints handed over
        self._dt, self._gravity = self._engine.clock()
        self._least = impact_speed_threshold(self._dt, self._gravity)
        self._time, self._steps = 0.0, 0  # s, and the steps since
        self._touches: ContactForces | None = None  # of the last step, once somebody asked
        self._motions: dict[tuple[int, int], Motion] = {}  # before it

    @property
    def time(self) -> float:
        """s, simulated by step()."""
        return self._time + self._steps * self._dt

    @property
    def bodies(self) -> tuple[int, ...]:
        """The ids of the unbroken breakable bodies."""
        self._forget_removed()
        return tuple(body for body, record in self._activity.records.items() if record.generation == 0)

    @property
    def pieces(self) -> tuple[int, ...]:
        """The ids of the pieces of everything that broke."""
        self._forget_removed()
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
        if not hasattr(asset, "scaled"):
            raise PhysicsError(f"add takes an asset, as fracsim.load gives it, not {asset!r}")
        if not is_number(scale) or scale <= 0.0:
            raise PhysicsError(f"scale must be a positive number, got {scale!r}")
        if scale != 1.0:
            asset = asset.scaled(scale)
        quaternion = finite_vector(orientation, "orientation", 4)
        if not quaternion.any():
            raise PhysicsError("orientation is the zero quaternion; no rotation is (0, 0, 0, 1)")
        rotation = rotation_of((quaternion / np.linalg.norm(quaternion)).tolist())
        angular = finite_vector(angular_velocity, "angular_velocity", 3)
        linear = finite_vector(linear_velocity, "linear_velocity", 3)
        linear = linear - np.cross(angular, rotation @ asset.center_of_mass)
        pose = Pose(finite_vector(position, "position", 3), rotation, linear, angular)
        damping = (
            at_least(linear_damping, 0.0, "linear_damping"),
            at_least(angular_damping, 0.0, "angular_damping"),
        )
        surface = ContactProperties(
            friction=getattr(asset.material, "friction", 0.5),
            restitution=getattr(asset.material, "restitution", 0.1),
            margin=_MARGIN * asset.size,
            linear_damping=damping[0],
            angular_damping=damping[1],
        )
        try:
            asset.prepare()
        except Exception as error:  # the same as when it is to break
            self._warn(asset, error)
        [body] = spawn(self._engine, [asset], pose, surface, [WHOLE_COLOUR] if self.visuals else None)
        self._forget(body.id)  # what somebody removed, and whose id this is now
        self._activity.add(BodyRecord(body, asset, damping, asset.reach, asset.bearable_impulse / LOAD_DURATION))
        return body.id

    def remove(self, body: int) -> None:
        """Remove a breakable body or a piece that this world made."""
        self._find(body)
        self._engine.remove_body(body)
        self._forget(body)

    def asset(self, body: int) -> BreakableAsset:
        """The asset of an unbroken body, at the body's scale."""
        self._find(body)
        record = self._activity.records.get(body)
        if record is None or record.generation:
            raise PhysicsError(f"body {body} is a piece; only unbroken bodies, world.bodies, have an asset")
        return record.breakable

    def pose(self, body: int) -> tuple[FloatArray, FloatArray]:
        """Position (3,) and orientation (x, y, z, w) of the asset's frame, of a body or of a piece."""
        pose = self._find(body).pose_now(self._engine)
        return pose.position, quaternion_of(pose.rotation)

    def wake(self, body: int | None = None) -> None:
        """Look at a body, or at all of them, in the next step whatever they do.

        A world leaves bodies alone that lie still or fly where nothing is, and knows the motion of others from its own
        last step. Call this after what it cannot foresee and should tell at once: a velocity or a pose given to a body,
        a saved state put back. Without it that is noticed some steps later.
        """
        self._forget_removed()
        bodies = self._activity.records if body is None else [self._find(body).id]
        for one in tuple(bodies):
            if one in self._activity.records:
                self._activity.wake(self._activity.records[one], look=True)

    def constraint(self, constraint: int) -> int:
        """The id by which a constraint goes now. What held a body that broke holds one of its pieces, and the engine
        gives that another id; it is its own as long as nothing of the sort has happened."""
        while constraint in self._renamed:
            constraint = self._renamed[constraint]
        return constraint

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

        Hits on a body within 10 ms act together, as those on the corners of a flat landing. When it breaks, all
        that contacts and constraints join to it goes back to before the step, and the next one is lived by the pieces
        in its place. A force that lasts counts as the impulse of 1 ms of it, without what the body's own weight takes.
        """
        engine, activity = self._engine, self._activity
        try:
            engine.step()
        except BodyNotFound:
            engine.require_connection()
            raise
        self._steps += 1
        if self._steps == _CLOCK:
            self._read_clock()
        parting, cooling = tuple(self._parting), tuple(self._cooling)  # what breaks now has not moved yet
        events = self._look() if activity.records else []
        if self._pieces:  # last, as what was before the step follows from how it left things
            for body, motion in self._spin.hold(self._dt):
                activity.velocity_set(body, motion)
            activity.unwatched_movers = self._spin.moving - activity.records.keys()
            if parting:
                self._part(parting)
            if cooling:
                self._cool(cooling)
            if self._refining:
                self._refine()
        return events

    def _look(self) -> list[FractureEvent]:
        activity = self._activity
        try:
            suspects = activity.observe_step(self._dt, self._gravity, self._least)
        except BodyNotFound:
            self._forget_removed()
            return []
        if not suspects and activity.any_pressed:
            suspects = activity.due_loads()
        told = self._told
        if told:
            self._told = frozenset()
        if not suspects:
            return []
        self._read_clock()
        self._touches = None
        self._motions.clear()
        return self._judge(suspects, told)

    def _read_clock(self) -> None:
        """The time step and gravity, which somebody may have changed. Asking every time would cost a tenth of what
        the watching does."""
        self._time, self._steps = self.time, 0
        known = self._dt, self._gravity
        self._dt, self._gravity = self._engine.clock()
        if (self._dt, self._gravity) != known:
            self._least = impact_speed_threshold(self._dt, self._gravity)
            self._activity.wake_all()

    def fracture(self, body: int, impulse: Impulse | Sequence[Impulse]) -> FractureEvent:
        """Break a body or a piece on command, with impulses in its asset's frame -> the event; children () if it held.

        The impulses decide the cracks and add no momentum: the pieces go on with the motion the body has.
        """
        engine = self._engine
        engine.require_connection()
        impulses = tuple(sorted(as_impulses(impulse), key=lambda one: -one.magnitude))
        self._find(body)
        record = self._activity.records.get(body)
        if record is None:
            raise PhysicsError(f"body {body} is a piece that breaks no more: too small, or broken too often")
        start = perf_counter()
        fracture = self._ask(record, impulses)
        timings = {"impulse": 0.0, "fracture": 1e3 * (perf_counter() - start), "bodies": 0.0}
        if fracture is None:
            fracture = record.breakable.unbroken()
        if len(fracture.pieces) < 2:
            return FractureEvent(body, (), impulses, fracture, self.time, timings, generation=record.generation)
        state = BodyState(body, engine.placement(body), engine.motion(body))
        event = self._replace(_Break(record, impulses, fracture, frozenset(), timings), state)
        self._save()
        return event

    # From contacts to what breaks

    def _judge(self, suspects: list[BodyRecord], told: frozenset[tuple[int, int]]) -> list[FractureEvent]:
        struck = []
        queue, done = list(suspects), set()
        pressed = [record for record in suspects if record.load_due]
        for record in pressed:
            record.load_due = False
        for record in queue:  # grows while it runs
            body = record.body.id
            if body in done:
                continue
            done.add(body)
            if not self._engine.is_marked(body, record.body.token):
                self._forget(body)
                continue
            if self._is_spared(record):
                continue
            start = perf_counter()
            hits = self._hits_on(record, record in pressed)
            queue += [self._activity.records[hit.other] for hit in hits if hit.other in self._activity.records]
            if self.time < record.immune_until:
                hits = [hit for hit in hits if hit.other not in record.immune_to]
            if hits:
                struck.append((record, hits, 1e3 * (perf_counter() - start)))
        for callback in tuple(self._callbacks):
            for _, hits, _ in struck:
                for hit in hits:
                    if (hit.body, hit.other) not in told:
                        callback(hit)
        if self._callbacks:  # which may have removed bodies, and made others of the same ids
            self._forget_removed()
            self._touches = None
            self._motions.clear()
        breaks = []
        for record, hits, elapsed in struck:
            if self._activity.records.get(record.body.id) is record:
                found = self._try(record, hits, elapsed)
                if found is not None:
                    breaks.append(found)
        if not breaks:
            return []
        events = self._exchange(breaks)
        self._save()
        return events

    def _is_spared(self, record: BodyRecord) -> bool:
        """Whether all that touches a body was in the break that it came of, and neither may break the other yet."""
        if self.time >= record.immune_until:
            return False
        contacts = self._activity.contacts_of(record.body.id)
        for other, _ in contacts.others if contacts is not None else ():
            known = self._activity.records.get(other)
            if other not in record.immune_to or (
                known is not None and (self.time >= known.immune_until or record.body.id not in known.immune_to)
            ):
                return False
        return True

    def _hits_on(self, record: BodyRecord, loaded: bool) -> list[ContactImpulse]:
        engine, body = self._engine, record.body
        contacts = record.lightest_contacts if loaded else self._activity.contacts_of(body.id)
        if contacts is None:
            return []
        placement = engine.placement_before(body.id, self._dt)
        if loaded:
            return sustained_impulses(engine, body, contacts, placement, self._gravity)
        return predict_impacts(engine, body, contacts, placement, self._motion_before, self._dt, self._gravity)

    def _try(self, record: BodyRecord, hits: list[ContactImpulse], elapsed: float) -> _Break | None:
        """Whether the hits, one after the other and with those just before, break the body."""
        target = record.breakable
        record.recent_impacts = earlier = [
            (when, hit) for when, hit in record.recent_impacts if when > self.time - IMPACT_WINDOW
        ]
        strongest = 0.0  # of those that come together and are no repetitions
        start = perf_counter()
        for k, hit in enumerate(hits):
            when = self.time + hit.delay
            same = [
                old
                for _, old in earlier
                if old.other == hit.other
                and np.linalg.norm(old.impulse.point - hit.impulse.point) < _SAME_PLACE * target.size
                and old.impulse.direction @ hit.impulse.direction > 0.8
            ]
            if not any(old.impulse.magnitude >= hit.impulse.magnitude for old in same):
                record.recent_impacts = [entry for entry in record.recent_impacts if entry[1] not in same] + [
                    (when, hit)
                ]
                strongest = max(strongest, hit.impulse.magnitude)
            if (k + 1 < len(hits) and hits[k + 1].delay == hit.delay) or strongest == 0.0:
                continue
            strongest = 0.0
            acting = sorted((one.impulse for _, one in record.recent_impacts), key=lambda one: -one.magnitude)
            impulses = tuple(self._worn(record, acting))
            if not target.may_break(impulses):
                continue
            fracture = self._ask(record, impulses)
            if fracture is not None and len(fracture.pieces) > 1:
                timings = {"impulse": elapsed, "fracture": 1e3 * (perf_counter() - start), "bodies": 0.0}
                return _Break(record, impulses, fracture, frozenset(one.other for one in hits), timings)
        if self.fatigue is not None and record.recent_impacts:
            self._tire(record)
        return None

    def _worn(self, record: BodyRecord, impulses: list[Impulse]) -> list[Impulse]:
        """The impulses as they act on a body that impacts have weakened."""
        if record.damage == 0.0:
            return impulses
        left = max(1.0 - record.damage, 1e-6)
        return [Impulse(one.point, one.direction, one.magnitude / left) for one in impulses]

    def _tire(self, record: BodyRecord) -> None:
        """Add what the hits of this step that broke nothing did (Miner's rule), once each."""
        impulses = [hit.impulse for when, hit in record.recent_impacts if when >= self.time and not hit.sustained]
        if not impulses or self.fatigue is None:
            return
        low, high = 1.0, 1.0
        while high < 1e3 and not self._breaks(record, impulses, high):
            low, high = high, 2.0 * high
        for _ in range(5):
            middle = (low * high) ** 0.5
            low, high = (low, middle) if self._breaks(record, impulses, middle) else (middle, high)
        record.damage_before = self.time, record.damage
        record.damage = min(1.0, record.damage + high**-self.fatigue)

    def _breaks(self, record: BodyRecord, impulses: Sequence[Impulse], factor: float) -> bool:
        impacts = tuple(Impulse(one.point, one.direction, one.magnitude * factor) for one in impulses)
        if not record.breakable.may_break(impacts):
            return False
        fracture = self._ask(record, impacts)
        return fracture is not None and len(fracture.pieces) > 1

    def _ask(self, record: BodyRecord, impulses: tuple[Impulse, ...]) -> Fracture | None:
        """The model's answer; None, and one warning for each model, when it has none that makes sense."""
        try:
            return record.breakable.fracture(impulses)
        except Exception as error:  # whatever somebody's model raises
            self._warn(record.breakable, error)
            return None

    def _warn(self, target: BreakableAsset | BreakablePiece, error: Exception) -> None:
        """Say once of a model that it fails."""
        what = target.name, f"{type(error).__name__}: {error}"
        if what not in self._warned:
            self._warned.add(what)
            warnings.warn(f"{what[0]} does not break: its model failed ({what[1]})", RuntimeWarning, stacklevel=5)

    # How things moved before the step

    def _motion_before(self, body: int, link: int) -> Motion:
        """As kept, or where it was not, or somebody has changed it since, as the contacts tell."""
        if (body, link) not in self._motions:
            self._motions[body, link] = self._motion_found(body, link)
        return self._motions[body, link]

    def _motion_found(self, body: int, link: int) -> Motion:
        kept = self._activity.motion_before(body, link)
        if link >= 0 or self._engine.is_articulated(body):
            return self._engine.link_motion(body, link) if kept is None else kept
        if self._engine.is_static(body):
            return self._engine.motion(body)
        if kept is not None and self._tied(body):
            return kept
        told = velocity_before_step(
            self._engine,
            body,
            self._engine.placement_before(body, self._dt),
            self._all_touches(),
            self._dt,
            self._gravity,
        )
        if kept is None:
            return told
        linear, angular = kept
        if _differ(told[0], linear, 0.02 * self._least, 1e-3, told[0]):
            return told
        # Contacts tell less exactly of spin, the more so the more they change it.
        arm = self._activity.records[body].reach if body in self._activity.records else 0.1
        if _differ(told[1], angular, 0.1 * self._least / arm, 0.1, told[1], angular, self._engine.motion(body)[1]):
            angular = told[1]
        return linear, angular

    def _all_touches(self) -> ContactForces:
        if self._touches is None:
            self._touches = self._engine.contact_forces()
        return self._touches

    def _tied(self, body: int) -> bool:
        return any(body in (info[0], info[2]) for _, info in self._engine.constraints())

    # The swap

    def _exchange(self, breaks: list[_Break]) -> list[FractureEvent]:
        """Put everything that the impacts reached back to before the step, and pieces in place of what broke."""
        engine, activity, dt = self._engine, self._activity, self._dt
        start = perf_counter()
        ties = [(info[0], info[2]) for _, info in engine.constraints() if info[2] >= 0]
        broken = {one.record.body.id: one for one in breaks}
        reached = contact_island([*self._all_touches().bodies.tolist(), *ties], broken, engine.is_static)
        states = {
            body: engine.state_before(body, self._motion_before(body, -1), activity.joint_rates_before(body), dt)
            for body in reached
        }
        told = set()
        for body, state in states.items():
            if body in broken:
                continue
            engine.restore(state)
            activity.body_restored(state)
            self._spin.changed(body, state.motion[1])
            record = activity.records.get(body)
            if record is not None:
                told |= {(body, hit.other) for when, hit in record.recent_impacts if when >= self.time}
                record.recent_impacts = [entry for entry in record.recent_impacts if entry[0] < self.time]
                if record.damage_before[0] >= self.time:
                    record.damage = record.damage_before[1]
        self._told = frozenset(told)
        rewinding = 1e3 * (perf_counter() - start)
        events = []
        for one in breaks:
            one.timings["bodies"] = rewinding / len(breaks)
            one.others |= frozenset(reached)
            events.append(self._replace(one, states[one.record.body.id]))
        self._parting = [one for one in self._parting if {body.id for body in one.bodies}.isdisjoint(reached)]
        others = [body for body in reached if body not in broken]
        if not any(map(engine.is_articulated, others)):
            start = perf_counter()
            self._parting.append(self._parting_of(breaks, events, others, states))
            breaks[0].timings["bodies"] += 1e3 * (perf_counter() - start)
        return events

    def _parting_of(
        self, breaks: list[_Break], events: list[FractureEvent], others: list[int], states: dict[int, BodyState]
    ) -> PenetrationGuard:
        """Of the pieces of some breaks, and what they shall live the step with."""
        pieces: list[Body] = []
        before: list[Body] = []  # whose energy the pieces have
        for what, event in zip(breaks, events, strict=True):
            own = [self._pieces[child] for child in event.children]
            pieces += own
            body, mass = what.record.body, sum(piece.mass for piece in own)
            before.append(replace(body, mass=mass, moments=body.moments * mass / body.mass))
        rest = []
        for other in others:
            rigid = self._engine.rigid_body(other, -1)
            rest.append(Body(other, "", rigid.mass, np.zeros(3), np.eye(3), rigid.moments))
        known = [states[body.id] for body in (*before, *rest)]
        then = RigidStates.of([*before, *rest], [one.placement for one in known], [one.motion for one in known])
        return PenetrationGuard([*pieces, *rest], then.energy(self._gravity), self.time + GUARD_TIME)

    def _part(self, those: Sequence[PenetrationGuard]) -> None:
        """Take what energy pieces have made by getting out of each other."""
        for one in those:
            if one not in self._parting:  # they live the step anew
                continue
            try:
                motions = one.stills(self._engine, self._gravity)
            except BodyNotFound:
                self._forget_removed()
                motions, one.until = None, 0.0
            if motions is not None:
                for body, motion in zip(one.bodies, motions, strict=True):
                    self._activity.velocity_set(body.id, motion)
                    self._spin.changed(body.id, motion[1])
            if self.time >= one.until:
                self._parting.remove(one)

    def _replace(self, what: _Break, state: BodyState) -> FractureEvent:
        """Swap a body for its pieces at the state given."""
        engine, record, fracture = self._engine, what.record, what.fracture
        start = perf_counter()
        parent = record.body
        pose = parent.pose(state.placement, state.motion)
        surface = engine.contact_properties(parent.id, *record.damping)
        ties = [tie for tie in engine.constraints() if parent.id in (tie[1][0], tie[1][2])]
        solids, asset = fracture.pieces, getattr(record.breakable, "asset", record.breakable)
        if self.decomposition == "coacd":
            solids = refined_now(asset, solids)
        # Somebody may have given the body another mass; a static one's pieces have what its material makes them.
        heavier = (engine.mass(parent.id) or parent.mass) / parent.mass
        pieces = spawn(engine, solids, pose, surface, PIECE_COLOURS if self.visuals else None, heavier)
        parts = [piece.convex_parts for piece in solids]
        renamed = {
            tie[0]: self._rename(tie[0], transfer_constraint(engine, tie, parent, pieces, parts)) for tie in ties
        }
        engine.remove_body(parent.id)  # after the pieces, so that none of them gets its id
        self._activity.forget(parent.id)
        self._activity.tokens.pop(parent.id, None)
        children = tuple(piece.id for piece in pieces)
        immune = what.others | frozenset(children)
        generation = record.generation + 1
        for piece, solid in zip(pieces, fracture.pieces, strict=True):
            self._forget(piece.id)
            self._pieces[piece.id] = piece
            self._damping[piece.id] = record.damping
            self._activity.tokens[piece.id] = piece.token
            if generation < self.generations and len(solid.atoms) > 1:
                fragment = record.breakable.breakable_piece(solid)
                if fragment.domain.share >= self.smallest:
                    bearable = fragment.bearable_impulse / LOAD_DURATION
                    watched = BodyRecord(piece, fragment, record.damping, fragment.reach, bearable, generation)
                    watched.immune_to, watched.immune_until = immune, self.time + _AFTER
                    self._activity.add(watched)
        self._pieces.pop(parent.id, None)
        self._damping.pop(parent.id, None)
        if self.decomposition == "background":
            self._refining.append(Refinement.begun(asset, solids, pieces, self.time + self.refine_after))
        self._spin.drop(parent.id)
        self._spin.add(pieces, state.motion[1])
        energy = CrackEnergy(record.breakable.material.fracture_energy * fracture.crack_area)
        self._cooling.append(Dissipation(energy, pieces, self.time + DISSIPATION_TIME))
        timings = what.timings
        timings["bodies"] += 1e3 * (perf_counter() - start)
        return FractureEvent(
            parent.id, children, what.impulses, fracture, self.time, timings, energy, record.generation, renamed
        )

    def _rename(self, constraint: int, new: int) -> int:
        self._renamed.pop(new, None)  # of before a reset
        self._renamed[constraint] = new
        return new

    def _cool(self, those: Sequence[Dissipation]) -> None:
        """Let cracks take their energy from how their pieces have come to move."""
        for one in those:
            one.pieces = [
                piece
                for piece in one.pieces  # ids come again
                if self._pieces.get(piece.id) is piece and self._engine.is_marked(piece.id, piece.token)
            ]
            demand = one.energy.demand - one.energy.taken
            if self.time > one.until or demand <= 0.0 or len(one.pieces) < 2:
                self._cooling.remove(one)
                continue
            try:
                taken, motions = dissipate(self._engine, one.pieces, demand)
            except BodyNotFound:
                self._forget_removed()
                continue
            one.energy.taken += taken
            if taken > 0.0:
                for piece, motion in zip(one.pieces, motions, strict=True):
                    self._activity.velocity_set(piece.id, motion)
                    self._spin.changed(piece.id, motion[1])

    def _refine(self) -> None:
        """Give pieces that are due the convex parts that were made for them meanwhile."""
        for one in tuple(self._refining):
            if self.time < one.due:
                continue
            self._refining.remove(one)
            self._forget_removed()
            for k, (solid, old) in enumerate(zip(one.refined(), one.bodies, strict=True)):
                if self._pieces.get(old.id) is old:
                    self._reshape(solid, old, k)

    def _reshape(self, solid: Piece, old: Body, index: int) -> None:
        """The same piece, of the same id and motion, in another shape."""
        engine = self._engine
        pose, surface = old.pose_now(engine), engine.contact_properties(old.id, *self._damping[old.id])
        motion = engine.motion(old.id)
        ties = [tie for tie in engine.constraints() if old.id in (tie[1][0], tie[1][2])]
        for constraint, _ in ties:
            engine.remove_constraint(constraint)
        engine.remove_body(old.id)
        colors = [PIECE_COLOURS[index % len(PIECE_COLOURS)]] if self.visuals else None
        [body] = spawn(engine, [solid], pose, surface, colors)
        if body.id != old.id:  # the engine hands out the id that was freed last
            raise PhysicsError(f"piece {old.id} came back as {body.id}; use decomposition='baked'")
        for constraint, info in ties:
            self._rename(constraint, engine.create_constraint(info))
        self._pieces[body.id] = body
        for cooling in self._cooling:
            cooling.pieces = [body if piece is old else piece for piece in cooling.pieces]
        self._activity.tokens[body.id] = body.token
        self._spin.add([body], motion[1])
        record = self._activity.records.get(body.id)
        if record is not None:
            record.body = body
            self._activity.wake(record)

    def _save(self) -> None:
        """Remove the smallest and stillest pieces while there are more than the budget allows."""
        excess = 0 if self.budget is None else len(self._pieces) - self.budget
        if excess <= 0:
            return
        self._forget_removed()

        def liveliness(body: int) -> float:
            return self._pieces[body].mass * (0.1 + float(np.linalg.norm(self._engine.motion(body)[0])))

        for body in sorted(self._pieces, key=liveliness)[:excess]:
            self._engine.remove_body(body)
            self._forget(body)

    # Who is there

    def _find(self, body: int) -> Body:
        self._forget_removed()
        if body in self._activity.records:
            return self._activity.records[body].body
        if body in self._pieces:
            return self._pieces[body]
        raise PhysicsError(
            f"body {body} is not in this world; it has {sorted({*self._activity.records, *self._pieces}) or 'none'}"
        )

    def _forget(self, body: int) -> None:
        self._activity.forget(body)
        self._activity.tokens.pop(body, None)
        self._spin.drop(body)
        self._damping.pop(body, None)
        self._pieces.pop(body, None)

    def _forget_removed(self) -> None:
        """Drop the records of bodies that somebody else took out of the engine."""
        self._engine.require_connection()
        bodies = {body: record.body for body, record in self._activity.records.items()} | self._pieces
        for body, known in bodies.items():
            if not self._engine.is_marked(body, known.token):
                self._forget(body)


def _differ(a: Triple, b: Triple, least: float, share: float, *scales: Triple) -> bool:
    """Whether two vectors differ by more than ``least`` and a share of the largest that it is measured by."""
    size = max(abs(x) for scale in scales for x in scale)
    return max(abs(x - y) for x, y in zip(a, b, strict=True)) > least + share * size
