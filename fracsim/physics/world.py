"""The world: breakable bodies in a connected PyBullet client, and the step that lets them break.

The door to this folder: `World.step` names the stages, and each stage is a module of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import cast

from ..common.arrays import FloatArray
from ..common.checks import Vector, at_least
from ..common.errors import PhysicsError
from ..common.impulse import Impulse, as_impulses
from ..common.material import ContactMaterial, Material
from .bodies import WHOLE_COLOUR, spawn
from .breakable import BreakableObject, bearable_force_of, require_breakable
from .bullet import Engine
from .energy import EnergyBalance, Running
from .events import FractureEvent
from .impacts import ContactImpulse
from .last_step import LastStep
from .live_convex import asset_of
from .placing import contact_properties_of, pose_of, scaled
from .records import BodyRecord
from .replacement import Replacement
from .rotations import quaternion_of
from .settings import ReplacementSettings
from .states import BodyNotFound
from .verdicts import Break, StruckBody, Verdicts
from .world_state import WorldState

ContactCallback = Callable[[ContactImpulse], object]


class World:
    """Breakable bodies in a connected PyBullet client.

    It owns nothing that it did not create and sets no engine-wide parameter; make a new World after
    resetSimulation. PyBullet reports the centre of mass of a body; `pose` gives the asset's frame.

    Parameters
    ----------
    client : int
        Physics client id, as pybullet.connect returns it.
    visuals : bool, optional
        Whether bodies get visual shapes. None: only where the client has a window.
    generations : int
        How often what breaks may break again. 1: pieces stay as they are.
    smallest : float
        Share of the volume of what was added, below which a piece breaks no more.
    budget : int, optional
        Number of pieces that there may be; of more, the smallest and stillest are removed. None: any number.
    fatigue : float, optional
        Exponent n of Miner's rule: an impact that is the share r of what breaks a body uses up r**n of its strength.
        None: any number of impacts that break nothing leave no trace.
    decomposition : {"baked", "coacd", "background"}
        Where the convex parts of pieces come from. "baked": the asset, in a fraction of a frame. "coacd": CoACD on
        each piece as it breaks, in seconds. "background": the same in another process; the pieces begin as baked and
        take over the finer parts, ids kept, `refine_after` after the break. The step waits for them if it must, so
        that a run is the same each time. The latter two need the extra ``bake`` and a baked asset.
    refine_after : float
        Time after a break at which the finer parts of "background" take over, s of simulated time.

    Attributes
    ----------
    client : int
        Physics client id.
    visuals : bool
        Whether bodies get visual shapes.
    settings : ReplacementSettings
        The options above that concern pieces.
    times_engine : bool
        Whether `step` takes the time of the engine's own step; set it to measure what this world adds to that.
    engine_seconds : float
        Time that the engine's own step took in the last call of `step`, s of the wall clock; 0 unless `times_engine`.

    Raises
    ------
    PhysicsError
        Where the client is not connected, or an option is out of its range.
    MissingExtraError
        Where a decomposition other than "baked" needs what is not installed.

    Examples
    --------
    >>> import fracsim, pybullet
    >>> world = fracsim.World(pybullet.connect(pybullet.DIRECT))
    >>> body = world.add(fracsim.load("vase").scaled(0.3), position=(0, 0, 2), angular_velocity=(0, 0, 1))
    >>> event = world.fracture(body, fracsim.Impulse((0, 0.1, 0), (0, -1, 0), 20.0))
    >>> len(event.children) == len(event.fracture.pieces)
    True
    >>> world.step()
    []
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
        engine = Engine(client)
        self.client = engine.client
        self.visuals = engine.has_window if visuals is None else visuals
        self.settings = ReplacementSettings(self.visuals, generations, smallest, budget, decomposition, refine_after)
        self.times_engine = False
        self.engine_seconds = 0.0
        self._engine = engine
        self._callbacks: list[ContactCallback] = []
        self._state = WorldState(engine)
        self._clock, self._activity, self._pieces = self._state.clock, self._state.activity, self._state.pieces
        self._last_step = LastStep(self._state)
        self._energy = EnergyBalance(self._state)
        exponent = None if fatigue is None else at_least(fatigue, 1.0, "fatigue")
        self._verdicts = Verdicts(self._state, self._last_step, exponent)
        self._replacement = Replacement(self._state, self._last_step, self._energy, self.settings)

    # Its options

    @property
    def generations(self) -> int:
        """How often what breaks may break again."""
        return self.settings.generations

    @property
    def smallest(self) -> float:
        """Share of the whole object's volume below which a piece breaks no more."""
        return self.settings.smallest

    @property
    def budget(self) -> int | None:
        """Number of pieces that there may be; None for any number."""
        return self.settings.budget

    @property
    def fatigue(self) -> float | None:
        """Exponent of Miner's rule; None for no fatigue."""
        return self._verdicts.fatigue

    @property
    def decomposition(self) -> str:
        """Where the convex parts of pieces come from."""
        return self.settings.decomposition

    @property
    def refine_after(self) -> float:
        """Time after a break at which finer convex parts take over, s."""
        return self.settings.refine_after

    # A step

    def step(self) -> list[FractureEvent]:
        """Advance the simulation by one time step, and break what was struck hard enough.

        Impacts on a body within 10 ms act together, as those on the corners of a flat landing. When it breaks, all
        that contacts and constraints join to it goes back to before the step, and its pieces take its place: the next
        step brings the impact again, and they live it. A force that lasts counts too, without what the body's own
        weight takes; where the asset's simulator counts impulses, as that of 1 ms of it.

        Returns
        -------
        list of FractureEvent
            One for each body that broke.

        Raises
        ------
        PhysicsError
            Where the client is no longer connected, or takes several substeps a step.
        """
        self._advance()
        moved = self._energy.running() if self._pieces else None  # what breaks now has not moved yet
        suspects, pressed = self._observe()
        struck = self._predict_impacts(suspects, pressed) if suspects or pressed else []
        breaks = self._verdicts.decide(struck) if struck else []
        events = self._replacement.replace(breaks) if breaks else []
        if self._pieces:
            self._dissipate(moved)
        return events

    def _advance(self) -> None:
        """Let the engine take its step."""
        start = perf_counter() if self.times_engine else 0.0
        try:
            self._engine.step()
        except BodyNotFound:
            self._engine.require_connection()
            raise
        if self.times_engine:
            self.engine_seconds = perf_counter() - start
        if self._clock.tick():
            self._read_clock()

    def _read_clock(self) -> None:
        if self._clock.read():
            self._activity.wake_all()

    def _observe(self) -> tuple[list[BodyRecord], list[BodyRecord]]:
        """Find the breakable bodies that something may have struck, and those on which a load is to be judged."""
        activity, clock = self._activity, self._clock
        if not activity.records:
            return [], []
        try:
            suspects = activity.observe_step(clock.time_step, clock.gravity, clock.impact_speed_threshold)
        except BodyNotFound:
            self._state.forget_removed()
            return [], []
        return suspects, activity.due_loads() if activity.any_pressed else []

    def _predict_impacts(self, suspects: list[BodyRecord], pressed: list[BodyRecord]) -> list[StruckBody]:
        """Predict the impacts on the suspects and show them to the callbacks, but for those shown already."""
        self._read_clock()
        self._last_step.clear()
        struck = self._verdicts.predict(suspects, pressed)
        if not self._callbacks:
            return struck
        relived = self._replacement.relived
        for callback in tuple(self._callbacks):
            for body in struck:
                for impact in body.impacts:
                    if (impact.body, impact.other) not in relived:
                        callback(impact)
        self._state.forget_removed()  # callbacks may have removed bodies, and made others of the same ids
        self._last_step.clear()
        return struck

    def _dissipate(self, moved: Running | None) -> None:
        """Take from pieces what they gain by spinning and by standing in each other, and what their cracks demand.

        It comes last, as what was before the next step follows from how this one left things.
        """
        activity, gyroscopic = self._activity, self._state.gyroscopic
        for body, motion in gyroscopic.correct(self._clock.time_step):
            activity.velocity_set(body, motion)
        activity.unwatched_movers = gyroscopic.moving - activity.records.keys()
        if moved is not None:
            self._energy.settle(*moved)
        self._replacement.refine()

    # What somebody does to the world

    def add(
        self,
        asset: BreakableObject,
        position: Vector = (0.0, 0.0, 0.0),
        orientation: Vector = (0.0, 0.0, 0.0, 1.0),
        linear_velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        scale: float = 1.0,
        *,
        linear_damping: float = 0.04,
        angular_damping: float = 0.04,
    ) -> int:
        """Put an unbroken asset into the world.

        Parameters
        ----------
        asset : BreakableAsset or BreakableObject
            What `fracsim.load` returns, or an object of one's own with the members of
            `fracsim.physics.breakable.BreakableObject`.
        position : sequence of float, shape (3,)
            Of the asset's frame, m.
        orientation : sequence of float, shape (4,)
            Of the asset's frame, a quaternion (x, y, z, w); normalised here.
        linear_velocity : sequence of float, shape (3,)
            Of the centre of mass, m/s.
        angular_velocity : sequence of float, shape (3,)
            World frame, rad/s.
        scale : float
            Of lengths; a scale of 2 is 8 times the mass.
        linear_damping, angular_damping : float
            Share of the velocity lost per second. Pieces inherit these, since the engine does not tell; friction and
            restitution they take from the body as it is when it breaks.

        Returns
        -------
        int
            Its PyBullet body id.

        Raises
        ------
        PhysicsError
            Where an argument is none of the above.
        """
        self._engine.require_connection()
        require_breakable(asset)
        if self.settings.decomposition != "baked":
            asset_of(asset)
        asset = scaled(asset, scale)
        pose = pose_of(asset, position, orientation, linear_velocity, angular_velocity)
        surface = contact_properties_of(asset, linear_damping, angular_damping)
        self._verdicts.prepare(asset)
        [body] = spawn(self._engine, [asset], pose, surface, [WHOLE_COLOUR] if self.visuals else None)
        self._state.forget(body.id)  # a body of this id that somebody removed
        bearable_force = bearable_force_of(asset)
        damping = surface.linear_damping, surface.angular_damping
        self._activity.add(BodyRecord(body, asset, damping, asset.reach, bearable_force))
        return body.id

    def remove(self, body: int) -> None:
        """Remove a breakable body or a piece that this world made.

        Parameters
        ----------
        body : int
            Its id.
        """
        self._state.find(body)
        self._engine.remove_body(body)
        self._state.forget(body)

    def fracture(self, body: int, impulse: Impulse | Sequence[Impulse]) -> FractureEvent:
        """Break a body or a piece on command.

        The impulses decide the cracks and add no momentum: the pieces go on with the motion that the body has.

        Parameters
        ----------
        body : int
            Its id.
        impulse : Impulse or sequence of Impulse
            What acts on it, in its asset's frame (m, N·s).

        Returns
        -------
        FractureEvent
            What became of it; `children` is () where it held.

        Raises
        ------
        PhysicsError
            Where this world has no such body, or it is a piece that breaks no more.
        """
        self._engine.require_connection()
        impulses = tuple(sorted(as_impulses(impulse), key=lambda acting: -acting.magnitude))
        self._state.find(body)
        record = self._state.records.get(body)
        if record is None:
            raise PhysicsError(f"body {body} is a piece that breaks no more: too small, or broken too often")
        start = perf_counter()
        fracture = self._verdicts.ask(record.breakable, impulses)
        timings = {"impulse": 0.0, "fracture": 1e3 * (perf_counter() - start), "bodies": 0.0}
        if fracture is None:
            fracture = record.breakable.unbroken()
        if len(fracture.pieces) < 2:
            return FractureEvent(body, (), impulses, fracture, self.time, timings, generation=record.generation)
        return self._replacement.replace_now(Break(record, impulses, fracture, frozenset(), timings))

    def set_material(
        self, body: int, material: str | Material | ContactMaterial | None, link: int | None = None
    ) -> None:
        """Say what a body is made of that does not break; what nobody named is hard.

        Parameters
        ----------
        body : int
            Its id: a floor, a table, a robot. Breakable bodies and their pieces are of their asset's material.
        material : str, Material or ContactMaterial, optional
            "steel", "stone", "wood", "rubber", "foam", "skin" (a robot's finger pads), "carpet"; another preset's name,
            or a material of your own. None: hard again; with a link, what the rest of the body is of.
        link : int, optional
            Of a robot, which link; -1 is the base. None: all of it that is not named apart.

        Raises
        ------
        PhysicsError
            Where there is no such body, or it breaks.
        MaterialError
            Where there is no such material.
        """
        self._state.forget_removed()
        if body in self._state.records or body in self._pieces:
            raise PhysicsError(f"body {body} is of its asset's material; use asset.with_material before World.add")
        self._state.materials.set(body, link, material)

    def wake(self, body: int | None = None) -> None:
        """Look at a body, or at all of them, in the next step whatever they do.

        A world leaves bodies alone that lie still or fly where nothing is, and knows the motion of others from its own
        last step. Call this after what it cannot foresee and should notice at once: a velocity or a pose given to a
        body, a saved state put back. Without it that is noticed some steps later.

        Parameters
        ----------
        body : int, optional
            Its id; None for all of them.
        """
        self._state.forget_removed()
        activity = self._activity
        for woken in tuple(activity.records) if body is None else (self._state.find(body).id,):
            if woken in activity.records:
                activity.wake(activity.records[woken], suspect_next=True)

    def on_contact(self, callback: ContactCallback) -> Callable[[], None]:
        """Call back with each impact on a breakable body, before it breaks.

        An impact is a contact that closes faster than max(0.1 m/s, 3 g dt), and whatever else the body leans
        on at that moment.

        Parameters
        ----------
        callback : callable
            Takes a ContactImpulse. It may add and remove bodies.

        Returns
        -------
        callable
            Ends it.
        """
        self._callbacks.append(callback)

        def unregister() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return unregister

    # What somebody asks of it

    @property
    def time(self) -> float:
        """Time simulated by `step`, s."""
        return self._clock.time

    @property
    def bodies(self) -> tuple[int, ...]:
        """Ids of the unbroken breakable bodies."""
        self._state.forget_removed()
        return tuple(body for body, record in self._state.records.items() if record.generation == 0)

    @property
    def pieces(self) -> tuple[int, ...]:
        """Ids of the pieces of everything that broke."""
        self._state.forget_removed()
        return tuple(self._pieces)

    def asset(self, body: int) -> BreakableObject:
        """Give the asset of an unbroken body, at the body's scale.

        Parameters
        ----------
        body : int
            Its id.

        Returns
        -------
        BreakableAsset or BreakableObject
            What was given to `add`, scaled.
        """
        self._state.find(body)
        record = self._state.records.get(body)
        if record is None or record.generation:
            raise PhysicsError(f"body {body} is a piece; only unbroken bodies, world.bodies, have an asset")
        return cast(BreakableObject, record.breakable)  # as `add` took it

    def pose(self, body: int) -> tuple[FloatArray, FloatArray]:
        """Give the pose of the asset's frame, of a body or of a piece.

        Parameters
        ----------
        body : int
            Its id.

        Returns
        -------
        position : ndarray of float64, shape (3,)
            Of the frame's origin, m.
        orientation : ndarray of float64, shape (4,)
            Unit quaternion (x, y, z, w).
        """
        pose = self._state.find(body).pose_now(self._engine)
        return pose.position, quaternion_of(pose.rotation)

    def constraint(self, constraint: int) -> int:
        """Give the id by which a constraint goes now.

        What held a body that broke holds one of its pieces, and the engine gives that another id.

        Parameters
        ----------
        constraint : int
            An id that it had.

        Returns
        -------
        int
            Its present id; the same where it held nothing that broke.
        """
        return self._replacement.constraint(constraint)
