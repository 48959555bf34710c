"""Which breakable bodies need a look after a step, and what moved how before it; everything else is left alone.

A body awake costs one call of the engine a step, its velocity, and one more while something that moves is near.
One that is still, or flies where nothing is, costs none: a single call for all of them says whether anything
came near.
"""

from __future__ import annotations

from typing import Any

from .bullet import Engine
from .impacts import is_slow
from .records import BodyRecord
from .states import BodyContacts, BodyNotFound, BodyState, Motion, Triple

CALM = 12  # steps that a body has to be slow for before it counts as asleep
AHEAD = 12  # steps that a body in free flight is left alone for, at most
EVERY = 16  # steps between looks at something that nothing else would notice
SPEED = 10.0  # m/s: what comes faster may first be seen in the very step that it hits
LASTING = 4  # steps that a force has to last for to be a load
NEVER = 1 << 62


class Activity:
    """The breakable bodies of a world. ``look`` is called after every step."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.records: dict[int, BodyRecord] = {}
        self.tokens: dict[int, str] = {}  # every body that the world made, breakable or not, and its mark
        self.unwatched_movers: set[int] = set()  # those of them that move and are not watched
        self.contact_cache: dict[int, BodyContacts | None] = {}  # asked for since the last step
        self.any_pressed = False  # whether anything is pressed
        self._awake: list[BodyRecord] = []
        self._left: list[BodyRecord] = []
        self._flying: list[BodyRecord] = []  # of these
        self._box: tuple[Triple, Triple] | None = None
        self._loose: set[int] = set()  # those at the last look
        self._seen: tuple[tuple[int, int], ...] = ()
        self._moving = False  # whether something foreign that may move is in the box
        self._boxes: dict[tuple[int, int], tuple[Triple, Triple]] = {}  # of what moves in it
        self._planes: dict[int, Any] = {}
        self._before: dict[tuple[int, int], Motion] = {}  # of what is foreign and near, before the last step
        self._now: dict[tuple[int, int], Motion] = {}
        self._rates: dict[int, tuple[tuple[float, ...], ...]] = {}
        self._rates_now: dict[int, tuple[tuple[float, ...], ...]] = {}
        self._tied: list[int] = []  # foreign bodies that constraints join to some of these
        self._census = (0, -1)
        self._last = (-1, "")  # the last body of it, and its mark
        self._foreign: frozenset[int] = frozenset()  # whatever else may move
        self._steps = 0
        self._turn = 0
        self._called: list[BodyRecord] = []  # to be looked at after the next step, come what may
        self._due = NEVER  # the first step at which one left alone is to be seen again

    # Who is watched

    def add(self, record: BodyRecord) -> None:
        self.records[record.body.id] = record
        self._awake.append(record)
        self.tokens[record.body.id] = record.body.token
        self._refresh(record)

    def forget(self, body: int) -> None:
        """Watch it no more; it may be gone."""
        record = self.records.pop(body, None)
        if record is not None:
            for some in (self._awake, self._left, self._flying):
                if record in some:
                    some.remove(record)
            self._box = None
        self.contact_cache.pop(body, None)
        self.unwatched_movers.discard(body)

    def wake(self, record: BodyRecord, look: bool = False) -> None:
        """Look at a body every step, from what the engine says of it now; in the next one whatever it does."""
        if record in self._left:
            self._left.remove(record)
            self._awake.append(record)
        if record in self._flying:
            self._flying.remove(record)
        record.slow_steps = record.pressed_steps = 0
        try:
            self._refresh(record)
        except BodyNotFound:
            self.forget(record.body.id)
            return
        if look:
            self._called.append(record)

    def wake_all(self) -> None:
        """As ``wake``, of every body: somebody changed the clock, or put back a saved state."""
        for record in tuple(self._left):
            self.wake(record)

    def _refresh(self, record: BodyRecord) -> None:
        record.motion = self.engine.motion(record.body.id)
        record.motion_before = None
        record.center = list(self.engine.placement(record.body.id)[0])
        record.unobserved_until, record.asleep = 0, False
        record.box_slack = -1.0

    # After a step

    def observe_step(self, dt: float, gravity: Triple, least: float) -> list[BodyRecord]:
        """The bodies that something may have struck in the last step. least: the ``gate``."""
        engine = self.engine
        self._steps += 1
        if self.contact_cache:
            self.contact_cache.clear()
        suspects: list[BodyRecord] = []
        if self._awake:
            self._poll(suspects, dt, gravity, least)
        if self._called:
            for record in self._called:
                record.motion_before = None
                if record not in suspects and self.records.get(record.body.id) is record:
                    suspects.append(record)
            self._called.clear()
        steps = self._steps
        # Another body in the last one's place leaves the census as it is, and one in another's place the last.
        if steps & 1:
            changed = engine.body_count() != self._census[0] or not engine.is_marked(*self._last)
        else:
            changed = engine.body_count_and_last() != self._census
        if changed:
            self._census = engine.body_count_and_last()
            for record in tuple(self._left):  # what they lay on may be gone
                if record.asleep:
                    self.wake(record)
            self._recount()
        elif steps % EVERY == 0:
            self._recount()
        if steps & 3 == 0 and self._flying:
            self._track(suspects, dt, gravity)
        if steps % EVERY == 0:  # all at once, so that most steps have none of it
            self._inspect()
            self._check(least)
        if self._due <= steps:
            self._due = NEVER
            for record in tuple(self._left):
                if record.unobserved_until <= steps and not (record.asleep and self._lies(record)):
                    self.wake(record)
                else:
                    self._due = min(self._due, record.unobserved_until)
        if self._foreign or self.unwatched_movers:
            box = self._box or self._enclose(dt)
            seen = engine.overlapping(*box)
            if seen != self._seen or self.unwatched_movers != self._loose:
                self._seen, self._loose = seen, self.unwatched_movers
                self._moving = any(self._moves(body) for body, _ in seen)
        else:
            self._moving = False
        if self._moving or self._tied:
            self._meet(suspects, dt, least)
        elif self._now or self._before:
            self._before, self._now, self._rates, self._rates_now = self._now, {}, self._rates_now, {}
        return suspects

    def _recount(self) -> None:
        """Find out anew what there is besides; ids of removed bodies are handed out again."""
        engine = self.engine
        self._planes.clear()
        engine.joints.forget()
        self.tokens = {body: mark for body, mark in self.tokens.items() if engine.is_marked(body, mark)}
        self._seen = ()
        self._foreign = frozenset(
            body for body in engine.body_ids() if body not in self.tokens and not engine.is_static(body)
        )
        self._moving = False
        self._tied = engine.constraints.joined_to(self.records)
        last = self._census[1]
        if last in self.tokens:
            self._last = last, self.tokens[last]
        elif last >= 0 and not (self._last[0] == last and engine.is_marked(*self._last)):
            self._last = last, engine.mark(last)

    def _moves(self, body: int) -> bool:
        """Whether a body is one that moves and is not watched."""
        return body in self._foreign or body in self.unwatched_movers

    def _poll(self, suspects: list[BodyRecord], dt: float, gravity: Triple, least: float) -> None:
        motion_of = self.engine.motion
        fall_x, fall_y, fall_z = gravity[0] * dt, gravity[1] * dt, gravity[2] * dt
        limit, steps = 0.75 * least, self._steps
        for record in tuple(self._awake):
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
            held = abs(a - a0) + abs(b - b0) + abs(c - c0)
            turn = abs(d - d0) + abs(e - e0) + abs(f - f0)
            moved = (abs(a) + abs(b) + abs(c)) * dt
            center = record.center
            center[0] += a * dt
            center[1] += b * dt
            center[2] += c * dt
            if (jump if jump < held else held) + reach * turn > limit:
                suspects.append(record)
                record.slow_steps = 0
            elif moved < 0.25 * least * dt and is_slow(motion, least, reach):
                record.slow_steps += 1
                if record.slow_steps >= CALM and not record.mover_near and not record.pressed_steps:
                    self._leave(record, NEVER, dt)
                    continue
            else:
                record.slow_steps = 0
            if record.pressed_steps:
                self._press(record)
            record.box_slack -= moved
            if steps - record.flight_checked >= AHEAD and not record.mover_near and self._is_free(record, dt, gravity):
                self._leave(record, steps + AHEAD, dt)
            elif record.box_slack < 0.0:
                self._box_of(record, dt)

    def _box_of(self, record: BodyRecord, dt: float) -> None:
        """A box that the body keeps a margin to on all sides until it has moved."""
        margin = SPEED * dt + 0.01 * record.reach
        record.box_slack = 0.5 * margin
        reach = record.reach + 2 * margin
        x, y, z = record.center = list(self.engine.placement(record.body.id)[0])
        record.box_low, record.box_high = (x - reach, y - reach, z - reach), (x + reach, y + reach, z + reach)
        self._box = None

    def _leave(self, record: BodyRecord, until: int, dt: float) -> None:
        self._awake.remove(record)
        self._left.append(record)
        record.unobserved_since = self._steps
        if until == NEVER:
            record.asleep = True
            self._box_of(record, dt)
            record.contact_box = _core(record, dt)
            speed = max(map(abs, record.motion[0]))
            if speed > 1e-9:  # it creeps
                until = self._steps + 1 + int(record.box_slack / (3 * speed * dt))
        else:
            self._flying.append(record)
        record.unobserved_until = until
        self._due = min(self._due, until)

    def _is_free(self, record: BodyRecord, dt: float, gravity: Triple) -> bool:
        """Whether nothing can be met in the next AHEAD steps unless it comes near; then its box covers the way."""
        record.flight_checked = self._steps
        time = (AHEAD + 2) * dt
        margin = SPEED * dt + record.reach
        record.center = list(self.engine.placement(record.body.id)[0])
        low, high = [], []
        for x, v, g in zip(record.center, record.motion[0], gravity, strict=True):
            # The way there and back is at most what speed and fall add up to.
            end = v * time + 0.5 * g * time * time
            turn = -0.5 * v * v / g if g * v < 0.0 and abs(v) < abs(g) * time else 0.0
            low.append(x + min(0.0, end, turn) - margin)
            high.append(x + max(0.0, end, turn) + margin)
        corners = (low[0], low[1], low[2]), (high[0], high[1], high[2])
        for other in self._left:  # what flies may be anywhere on its way
            if all(a <= d and c <= b for a, b, c, d in zip(low, high, other.box_low, other.box_high, strict=True)):
                return False
        for body, _ in self.engine.overlapping(*corners):
            if body != record.body.id and not self._is_clear(body, low, high):
                return False
        record.box_low, record.box_high = corners
        self._box = None
        return True

    def _is_clear(self, body: int, low: list[float], high: list[float]) -> bool:
        """Whether a body that meets a box by its bounding box is an infinite plane that does not."""
        if body in self.tokens or body in self._foreign:
            return False
        if body not in self._planes:
            self._planes[body] = self.engine.plane_of(body)
        if self._planes[body] is None:
            return False
        normal, height = self._planes[body]
        nearest = sum(n * (a if n > 0.0 else b) for n, a, b in zip(normal.tolist(), low, high, strict=True))
        return bool(nearest > height)

    def _lies(self, record: BodyRecord) -> bool:
        """Whether a sleeper whose velocity made it seem to creep is where it was; it has as long again, then."""
        try:
            place = self.engine.placement(record.body.id)[0]
        except BodyNotFound:
            return False
        moved = max(abs(a - b) for a, b in zip(place, record.center, strict=True))
        record.unobserved_until = self._steps + max(CALM, 2 * (self._steps - record.unobserved_since))
        return moved < 0.25 * record.box_slack

    def _check(self, least: float) -> None:
        """Whether those that lie still do."""
        for record in tuple(self._left):
            try:
                if record.asleep and not is_slow(self.engine.motion(record.body.id), least, record.reach):
                    self.wake(record)
            except BodyNotFound:
                self.forget(record.body.id)

    def _track(self, suspects: list[BodyRecord], dt: float, gravity: Triple) -> None:
        """Whether those in flight are where that takes them: somebody may have put them elsewhere."""
        for record in tuple(self._flying):
            time = (self._steps - record.unobserved_since) * dt
            rest = 0.5 * time * (time + dt)
            motion = record.motion[0]
            try:
                place = self.engine.placement(record.body.id)[0]
            except BodyNotFound:
                self.forget(record.body.id)
                continue
            off = max(
                abs(x - c - v * time - g * rest)
                for x, c, v, g in zip(place, record.center, motion, gravity, strict=True)
            )
            if off > 0.05 * record.reach + record.damping[0] * time * time * max(map(abs, motion)):
                self.wake(record)
                suspects.append(record)

    def _inspect(self) -> None:
        """The forces on one of the bodies, each in its turn: a load moves nothing."""
        records = [*self._awake, *self._left]
        self._turn += 1
        record = records[self._turn % len(records)]
        if not record.pressed_steps:
            self._press(record)

    def _enclose(self, dt: float) -> tuple[Triple, Triple]:
        for record in self._awake:
            if record.box_slack < 0.0:
                self._box_of(record, dt)
        low, high = [1e30] * 3, [-1e30] * 3
        for record in self.records.values():
            for k in range(3):
                low[k] = min(low[k], record.box_low[k])
                high[k] = max(high[k], record.box_high[k])
        self._box = (low[0], low[1], low[2]), (high[0], high[1], high[2])
        return self._box

    def _meet(self, suspects: list[BodyRecord], dt: float, least: float) -> None:
        """What moves near whom: its motion is kept for the step to come, and those it pushes on are looked at."""
        engine = self.engine
        near: set[tuple[int, int]] = {(body, -1) for body in self._tied}
        beside = self._beside(dt) if self._moving else {}
        for record in (*self._awake, *self._left):
            foreign = beside.get(record.body.id)
            record.mover_near = foreign is not None
            if foreign is None:
                continue
            slow = False
            if record.unobserved_until:
                asleep, was = record.asleep, record.motion
                self.wake(record)
                slow = asleep and is_slow(was, least, record.reach)
            near.update(foreign)
            if record in suspects:
                continue
            contacts = self.contacts_of(record.body.id) if self._is_touched(record, foreign) else None
            if contacts is None:
                record.mover_touches = False
                continue
            if not record.pressed_steps and contacts.force > record.bearable_force:
                self._press(record)
            pushing = [key for key in contacts.pushing if self._moves(key[0])]
            record.mover_touches = bool(pushing)
            if record.motion_before is not None:
                slow = is_slow(record.motion_before, least, record.reach)
            for key in pushing:
                motion = self._now.get(key)
                if motion is None or not slow or not is_slow(motion, least, 1.0):
                    suspects.append(record)
                    break
        self._before, self._rates = self._now, self._rates_now
        self._now = engine.motions(near)
        self._rates_now = {body: engine.joints.rates(body) for body, link in self._now if link < 0}

    def _beside(self, dt: float) -> dict[int, list[tuple[int, int]]]:
        """(body, link) of what moves so near to each body that it may have touched it in the last step, or will in the
        next."""
        movers = [key for key in self._seen if self._moves(key[0])]
        records = self.records.values()
        if len(movers) <= len(records):
            old = self._boxes
            boxes = self._boxes = {key: self.engine.bounding_box(*key) for key in movers}
            steps = [_step(old[key], box) if key in old else SPEED for key, box in boxes.items()]
            if max(steps) < SPEED * dt:
                return self._by_boxes(boxes, steps, dt)
        found: dict[int, list[tuple[int, int]]] = {}
        for record in records:
            foreign = [key for key in self.engine.overlapping(record.box_low, record.box_high) if self._moves(key[0])]
            if foreign:
                found[record.body.id] = foreign
        return found

    def _by_boxes(
        self, boxes: dict[tuple[int, int], tuple[Triple, Triple]], steps: list[float], dt: float
    ) -> dict[int, list[tuple[int, int]]]:
        """The same, where all that moves was seen before and is slow; then where it is now tells more than the broad
        phase, which is a step behind and knows no distances. boxes: where it is; steps: m, how far it went."""
        movers = []
        for (key, (low, high)), step in zip(boxes.items(), steps, strict=True):
            s = 1.5 * step
            movers.append((key, low[0] - s, low[1] - s, low[2] - s, high[0] + s, high[1] + s, high[2] + s))
        _, *lows_and_highs = zip(*movers, strict=True)
        west, south, down = map(min, lows_and_highs[:3])
        east, north, up = map(max, lows_and_highs[3:])
        found: dict[int, list[tuple[int, int]]] = {}
        for record in self.records.values():
            a, b, c, d, e, f = record.contact_box if record.asleep else _core(record, dt)
            if d < west or a > east or e < south or b > north or f < down or c > up:
                continue
            near = [
                key for key, u, v, w, x, y, z in movers if a <= x and d >= u and b <= y and e >= v and c <= z and f >= w
            ]
            if near:
                found[record.body.id] = near
        return found

    def _is_touched(self, record: BodyRecord, foreign: list[tuple[int, int]]) -> bool:
        """Whether all contacts of a body are worth asking for: one thing alone near it mostly does not touch it. What
        presses on it through others is seen every few steps."""
        others = {body for body, _ in foreign}
        if record.mover_touches or len(others) > 1 or not (self._steps + record.body.id) & 3:
            return True
        return self.engine.are_touching(record.body.id, others.pop())

    def contacts_of(self, body: int) -> BodyContacts | None:
        """The contacts of a body in the last step."""
        if body not in self.contact_cache:
            self.contact_cache[body] = self.engine.contacts(body)
        return self.contact_cache[body]

    def _press(self, record: BodyRecord) -> None:
        """Count the steps for which more than a bearable force has pressed on a body."""
        contacts = self.contacts_of(record.body.id)
        slow = is_slow(record.motion, 0.4, record.reach)
        if contacts is None or not slow or contacts.force <= record.bearable_force:
            record.pressed_steps, record.lightest_contacts = 0, None
            return
        if record.unobserved_until:
            self.wake(record)
        record.pressed_steps += 1
        self.any_pressed = True
        if record.pressed_steps % EVERY == 1:
            record.lightest_contacts = None
        if record.lightest_contacts is None or contacts.force < record.lightest_contacts.force:
            record.lightest_contacts = contacts

    def due_loads(self) -> list[BodyRecord]:
        """The bodies that more than a bearable force has pressed on for long enough to count, now and then."""
        found = []
        for record in self._awake:
            record.load_due = record.pressed_steps > 0 and record.pressed_steps % EVERY == LASTING
            if record.load_due:
                found.append(record)
        self.any_pressed = any(record.pressed_steps for record in self._awake)
        return found

    # What was before

    def motion_before(self, body: int, link: int) -> Motion | None:
        """How a body moved before the last step, if that was kept."""
        record = self.records.get(body)
        if record is None:
            return self._before.get((body, link))
        return None if record.unobserved_until else record.motion_before

    def joint_rates_before(self, body: int) -> tuple[tuple[float, ...], ...] | None:
        """The velocities of its joints then, if they were kept."""
        return self._rates.get(body)

    def body_restored(self, state: BodyState) -> None:
        """A body has been put back to where it was."""
        record = self.records.get(state.body)
        if record is not None:
            self.wake(record)
        elif (state.body, -1) in self._now:
            for key in [key for key in self._now if key[0] == state.body]:
                self._now[key] = self._before.get(key, state.motion)
            self._rates_now[state.body] = state.rates

    def velocity_set(self, body: int, motion: Motion) -> None:
        """A body was given another velocity after the last step."""
        if body in self.records:
            self.records[body].motion = motion
        elif (body, -1) in self._now:
            self._now[body, -1] = motion


def _core(record: BodyRecord, dt: float) -> tuple[float, ...]:
    """Lows and highs of the box that something has to meet to touch a body in the step to come."""
    if record.unobserved_until and not record.asleep:
        return (*record.box_low, *record.box_high)
    x, y, z = record.center
    reach = 1.01 * record.reach + 0.2 * SPEED * dt + max(map(abs, record.motion[0])) * dt
    return x - reach, y - reach, z - reach, x + reach, y + reach, z + reach


def _step(old: tuple[Triple, Triple], new: tuple[Triple, Triple]) -> float:
    """How far a box has moved."""
    (a, b, c), (d, e, f) = old
    (u, v, w), (x, y, z) = new
    return max(u - a, a - u, v - b, b - v, w - c, c - w, x - d, d - x, y - e, e - y, z - f, f - z)
