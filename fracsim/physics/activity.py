"""Which breakable bodies may have been struck in a step, and how everything moved before it.

A body that is observed costs one call of the engine a step, its velocity, and one more while a mover is near. A body
that lies still, or flies where nothing is, costs none: one call for all of them tells that nothing came near.
`World.step` asks it after every step.
"""

from __future__ import annotations

from .bullet import Engine
from .impacts import SLOW_SHARE, is_slow
from .mover_motions import MoverMotions
from .proximity import Proximity, contact_box
from .records import NEVER, SETTINGS, BodyRecord
from .states import BodyContacts, BodyLink, BodyNotFound, BodyState, JointRates, Motion, Triple
from .sustained_loads import count_pressed_step, due_loads, is_pressed, release


class Activity:
    """The breakable bodies of a world, and which of them may have been struck.

    Parameters
    ----------
    engine : Engine
        Engine that the bodies are in.

    Attributes
    ----------
    records : dict of int to BodyRecord
        The breakable bodies, by id.
    tokens : dict of int to str
        The tag of every body that the world made, breakable or not, by id.
    any_pressed : bool
        Whether more than a bearable force presses on any body.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.records: dict[int, BodyRecord] = {}
        self._proximity = Proximity(engine, self.records)
        self._motions = MoverMotions(engine)
        self.tokens = self._proximity.tokens
        self.any_pressed = False
        self._observed: list[BodyRecord] = []
        self._unobserved: list[BodyRecord] = []  # asleep or in flight
        self._flying: list[BodyRecord] = []  # those of them that fly
        self._suspect_next: list[BodyRecord] = []  # suspects after the next step, whatever they do
        self._contacts: dict[int, BodyContacts | None] = {}  # those asked for since the last step
        self._step = 0
        self._next_due = NEVER  # first step in which an unobserved body is due to be looked at
        self._inspected = 0  # counts inspections, for whose turn it is

    @property
    def unwatched_movers(self) -> set[int]:
        """Ids of pieces that move and break no more."""
        return self._proximity.unwatched_movers

    @unwatched_movers.setter
    def unwatched_movers(self, bodies: set[int]) -> None:
        self._proximity.unwatched_movers = bodies

    # Which bodies are observed

    def add(self, record: BodyRecord) -> None:
        """Observe a body from now on.

        Parameters
        ----------
        record : BodyRecord
            The body, which is in the engine.
        """
        self.records[record.body.id] = record
        self._observed.append(record)
        self.tokens[record.body.id] = record.body.token
        self._read(record)

    def forget(self, body: int) -> None:
        """Observe a body no more; it may be gone.

        Parameters
        ----------
        body : int
            Its id. One that is not breakable is no fault.
        """
        record = self.records.pop(body, None)
        if record is not None:
            for group in (self._observed, self._unobserved, self._flying):
                if record in group:
                    group.remove(record)
            self._proximity.forget_common_box()
        self._contacts.pop(body, None)
        self.unwatched_movers.discard(body)

    def wake(self, record: BodyRecord, suspect_next: bool = False) -> None:
        """Observe a body in every step again, beginning with what the engine says of it now.

        Parameters
        ----------
        record : BodyRecord
            The body.
        suspect_next : bool
            Whether it is a suspect after the next step.
        """
        if record in self._unobserved:
            self._unobserved.remove(record)
            self._observed.append(record)
        if record in self._flying:
            self._flying.remove(record)
        record.slow_steps = record.pressed_steps = 0
        try:
            self._read(record)
        except BodyNotFound:
            self.forget(record.body.id)
            return
        if suspect_next:
            self._suspect_next.append(record)

    def wake_all(self) -> None:
        """Observe every body again: somebody changed the clock, or put back a saved state."""
        for record in tuple(self._unobserved):
            self.wake(record)

    def _read(self, record: BodyRecord) -> None:
        """Read a body's place and motion, and begin to observe it."""
        record.motion = self._engine.motion(record.body.id)
        record.motion_before = None
        record.center = list(self._engine.placement(record.body.id)[0])
        record.unobserved_until, record.asleep = 0, False
        record.box_slack = -1.0

    def _leave_asleep(self, record: BodyRecord, dt: float) -> None:
        """Leave a body alone that lies still; one that creeps until it may have left its box."""
        self._proximity.place_box(record, dt)
        record.asleep = True
        record.contact_box = contact_box(record, dt)
        until, speed = NEVER, max(map(abs, record.motion[0]))
        if speed > 1e-9:
            until = self._step + 1 + int(record.box_slack / (SETTINGS.creep_safety * speed * dt))
        self._leave(record, until)

    def _leave(self, record: BodyRecord, until: int) -> None:
        """Observe a body no more until a step."""
        self._observed.remove(record)
        self._unobserved.append(record)
        record.unobserved_since, record.unobserved_until = self._step, until
        self._next_due = min(self._next_due, until)

    # After a step

    def observe_step(self, dt: float, gravity: Triple, threshold: float) -> list[BodyRecord]:
        """Find the bodies that something may have struck in the step just taken.

        Parameters
        ----------
        dt : float
            Time step, s.
        gravity : tuple of float
            m/s².
        threshold : float
            Closing speed below which a contact is no impact, m/s.

        Returns
        -------
        list of BodyRecord
            The suspects. Whatever was struck is among them.
        """
        self._step += 1
        if self._contacts:
            self._contacts.clear()
        suspects: list[BodyRecord] = []
        if self._observed:
            self._observe(suspects, dt, gravity, threshold)
        if not self.records:
            return []
        if self._suspect_next:
            self._add_announced(suspects)
        step, proximity = self._step, self._proximity
        inspect = step % SETTINGS.steps_between_inspections == 0
        if proximity.bodies_changed(step):
            for record in tuple(self._unobserved):
                if record.asleep:  # what it lay on may be gone
                    self.wake(record)
            proximity.recount()
        elif inspect:
            proximity.recount()
        if self._flying and step % SETTINGS.steps_between_flight_checks == 0:
            self._check_flights(suspects, dt, gravity)
        if inspect:  # all in the same step, so that most steps have none of it
            self._inspect_next_load()
            self._wake_disturbed(threshold)
        if self._next_due <= step:
            self._wake_due()
        if proximity.find_movers(self._observed, dt) or proximity.joined:
            self._suspect_touched(suspects, dt, threshold)
        elif self._motions.any_read:
            self._motions.read_none()
        return suspects

    def _observe(self, suspects: list[BodyRecord], dt: float, gravity: Triple, threshold: float) -> None:
        """Read the velocity of each observed body; one whose velocity jumped is a suspect, one at rest is left alone.

        In plain numbers, since this is what a quiet step costs.
        """
        motion_of, proximity = self._engine.motion, self._proximity
        fall_x, fall_y, fall_z = gravity[0] * dt, gravity[1] * dt, gravity[2] * dt
        suspicious, slow, step = SETTINGS.suspect_share * threshold, SLOW_SHARE * threshold * dt, self._step
        steps_to_sleep, steps_of_flight = SETTINGS.steps_to_sleep, SETTINGS.steps_of_flight
        for record in tuple(self._observed):
            old = record.motion
            try:
                motion = motion_of(record.body.id)
            except BodyNotFound:
                self.forget(record.body.id)
                continue
            record.motion_before, record.motion = old, motion
            (a, b, c), (d, e, f) = motion
            (a0, b0, c0), (d0, e0, f0) = old
            reach = record.reach
            jump = abs(a - a0 - fall_x) + abs(b - b0 - fall_y) + abs(c - c0 - fall_z)
            # What lies still is held up by what it lies on, which takes the fall back.
            jump_held = abs(a - a0) + abs(b - b0) + abs(c - c0)
            spin_jump = abs(d - d0) + abs(e - e0) + abs(f - f0)
            moved = (abs(a) + abs(b) + abs(c)) * dt
            center = record.center
            center[0] += a * dt
            center[1] += b * dt
            center[2] += c * dt
            if (jump if jump < jump_held else jump_held) + reach * spin_jump > suspicious:
                suspects.append(record)
                record.slow_steps = 0
            elif moved < slow and is_slow(motion, threshold, reach):
                record.slow_steps += 1
                if record.slow_steps >= steps_to_sleep and not record.mover_near and not record.pressed_steps:
                    self._leave_asleep(record, dt)
                    continue
            else:
                record.slow_steps = 0
            if record.pressed_steps:
                self._count_pressed(record)
            record.box_slack -= moved
            if step - record.flight_checked >= steps_of_flight and not record.mover_near:
                record.flight_checked = step
                if proximity.claim_free_way(record, self._unobserved, dt, gravity):
                    self._leave(record, step + steps_of_flight)
                    self._flying.append(record)
                    continue
            if record.box_slack < 0.0:
                proximity.place_box(record, dt)

    def _add_announced(self, suspects: list[BodyRecord]) -> None:
        """Suspect the bodies that somebody said to."""
        for record in self._suspect_next:
            record.motion_before = None
            if record not in suspects and self.records.get(record.body.id) is record:
                suspects.append(record)
        self._suspect_next.clear()

    def _check_flights(self, suspects: list[BodyRecord], dt: float, gravity: Triple) -> None:
        """Suspect the bodies in flight that are not where it takes them: somebody put them elsewhere."""
        for record in tuple(self._flying):
            time = (self._step - record.unobserved_since) * dt
            half_square = 0.5 * time * (time + dt)  # s²; the engine adds gravity before it moves a body
            velocity = record.motion[0]
            try:
                place = self._engine.placement(record.body.id)[0]
            except BodyNotFound:
                self.forget(record.body.id)
                continue
            error = max(
                abs(x - c - v * time - g * half_square)
                for x, c, v, g in zip(place, record.center, velocity, gravity, strict=True)
            )
            damped = record.damping[0] * time * time * max(map(abs, velocity))
            if error > SETTINGS.flight_tolerance * record.reach + damped:
                self.wake(record)
                suspects.append(record)

    def _inspect_next_load(self) -> None:
        """Look at the forces on one body, each in its turn, since a load moves nothing."""
        records = [*self._observed, *self._unobserved]
        self._inspected += 1
        record = records[self._inspected % len(records)]
        if not record.pressed_steps:
            self._count_pressed(record)

    def _wake_disturbed(self, threshold: float) -> None:
        """Wake the bodies asleep that move."""
        for record in tuple(self._unobserved):
            try:
                if record.asleep and not is_slow(self._engine.motion(record.body.id), threshold, record.reach):
                    self.wake(record)
            except BodyNotFound:
                self.forget(record.body.id)

    def _wake_due(self) -> None:
        """Wake the bodies that were left alone until now, but for those asleep that have not moved."""
        self._next_due = NEVER
        for record in tuple(self._unobserved):
            if record.unobserved_until <= self._step and not (record.asleep and self._stays_asleep(record)):
                self.wake(record)
            else:
                self._next_due = min(self._next_due, record.unobserved_until)

    def _stays_asleep(self, record: BodyRecord) -> bool:
        """Tell whether a body asleep that seemed to creep is where it was; then it is left alone as long again."""
        try:
            place = self._engine.placement(record.body.id)[0]
        except BodyNotFound:
            return False
        moved = max(abs(a - b) for a, b in zip(place, record.center, strict=True))
        asleep_for = self._step - record.unobserved_since
        record.unobserved_until = self._step + max(SETTINGS.steps_to_sleep, 2 * asleep_for)
        return moved < SETTINGS.creep_share * record.box_slack

    def _suspect_touched(self, suspects: list[BodyRecord], dt: float, threshold: float) -> None:
        """Suspect the bodies that movers push on, and keep how these move for the step to come."""
        proximity = self._proximity
        near: set[BodyLink] = {(body, -1) for body in proximity.joined}
        beside = proximity.movers_beside(dt) if proximity.any_mover else {}
        for record in (*self._observed, *self._unobserved):
            movers = beside.get(record.body.id)
            record.mover_near = movers is not None
            if movers is None:
                continue
            slow = False
            if record.unobserved_until:
                was_asleep, motion_left = record.asleep, record.motion
                self.wake(record)
                slow = was_asleep and is_slow(motion_left, threshold, record.reach)
            near.update(movers)
            if record in suspects:
                continue
            contacts = self.contacts_of(record.body.id) if self._is_worth_asking(record, movers) else None
            if contacts is None:
                record.mover_touches = False
                continue
            if not record.pressed_steps and contacts.force > record.bearable_force:
                self._count_pressed(record)
            pushing = [key for key in contacts.pushing if proximity.is_mover(key[0])]
            record.mover_touches = bool(pushing)
            if record.motion_before is not None:
                slow = is_slow(record.motion_before, threshold, record.reach)
            for key in pushing:
                motion = self._motions.last(key)
                if motion is None or not slow or not is_slow(motion, threshold, 1.0):
                    suspects.append(record)
                    break
        self._motions.read(near)

    def _is_worth_asking(self, record: BodyRecord, movers: list[BodyLink]) -> bool:
        """Tell whether to ask for all contacts of a body: a single mover near it mostly does not touch it."""
        bodies = {body for body, _ in movers}
        turn = (self._step + record.body.id) % SETTINGS.steps_between_contact_checks == 0
        if record.mover_touches or len(bodies) > 1 or turn:
            return True
        return self._engine.are_touching(record.body.id, bodies.pop())

    # Contacts and loads

    def contacts_of(self, body: int) -> BodyContacts | None:
        """Give the contacts of a body in the last step, which the engine is asked for once.

        Parameters
        ----------
        body : int
            Its id.

        Returns
        -------
        BodyContacts or None
            As `Engine.contacts` gives them.
        """
        if body not in self._contacts:
            self._contacts[body] = self._engine.contacts(body)
        return self._contacts[body]

    def _count_pressed(self, record: BodyRecord) -> None:
        """Count the steps for which more than a bearable force has pressed on a body."""
        contacts = self.contacts_of(record.body.id)
        if contacts is None or not is_pressed(record, contacts):
            release(record)
            return
        if record.unobserved_until:
            self.wake(record)
        count_pressed_step(record, contacts)
        self.any_pressed = True

    def due_loads(self) -> list[BodyRecord]:
        """Find the bodies whose load has lasted long enough and is to be judged now.

        Returns
        -------
        list of BodyRecord
            Each once every few steps.
        """
        self.any_pressed = any(record.pressed_steps for record in self._observed)
        return due_loads(self._observed)

    # How things moved before the last step

    def motion_before(self, body: int, link: int) -> Motion | None:
        """Give how something moved before the last step.

        Parameters
        ----------
        body, link : int
            Its id, and the link; -1 is the base.

        Returns
        -------
        Motion or None
            None where that was not kept.
        """
        record = self.records.get(body)
        if record is None:
            return self._motions.before((body, link))
        return None if record.unobserved_until else record.motion_before

    def joint_rates_before(self, body: int) -> JointRates | None:
        """Give how the joints of a body moved before the last step.

        Parameters
        ----------
        body : int
            Its id.

        Returns
        -------
        tuple of tuple of float, or None
            One for each joint that can move, rad/s or m/s; None where that was not kept.
        """
        return self._motions.rates_before(body)

    def body_restored(self, state: BodyState) -> None:
        """Take note that a body was put back to where it was before the last step.

        Parameters
        ----------
        state : BodyState
            Its state now.
        """
        record = self.records.get(state.body)
        if record is not None:
            self.wake(record)
        else:
            self._motions.restore(state)

    def velocity_set(self, body: int, motion: Motion) -> None:
        """Take note that a body was given another velocity after the last step.

        Parameters
        ----------
        body : int
            Its id.
        motion : Motion
            Its motion now.
        """
        record = self.records.get(body)
        if record is not None:
            record.motion = motion
        else:
            self._motions.set(body, motion)
