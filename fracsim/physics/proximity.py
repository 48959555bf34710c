"""Where the breakable bodies are and what moves near them, told by boxes that are seldom made.

Only `Activity` uses it. One question to the engine, for the box around all breakable bodies, tells that nothing came
near any of them.
"""

from __future__ import annotations

from collections.abc import Iterable

from ..common.arrays import FloatArray
from .bullet import Engine
from .records import SETTINGS, BodyRecord
from .states import BodyLink, Box, Triple

_NOBODY = (-1, "")


class Proximity:
    """What else is in the simulation, and whether it is near a breakable body.

    A *mover* is a body that moves and is not observed: somebody else's, or a piece that breaks no more.

    Parameters
    ----------
    engine : Engine
        The engine.
    records : dict of int to BodyRecord
        The breakable bodies, by id; shared with `Activity`.

    Attributes
    ----------
    tokens : dict of int to str
        The tag of every body that the world made, by id.
    unwatched_movers : set of int
        Ids of pieces that move and break no more.
    joined : list of int
        Ids of somebody else's bodies that constraints join to breakable ones.
    any_mover : bool
        Whether a mover is in the box around all breakable bodies.
    """

    def __init__(self, engine: Engine, records: dict[int, BodyRecord]) -> None:
        self._engine, self._records = engine, records
        self.tokens: dict[int, str] = {}
        self.unwatched_movers: set[int] = set()
        self.joined: list[int] = []
        self.any_mover = False
        self._unwatched_before: set[int] = set()  # those at the last look into the box around all
        self._others_movers: frozenset[int] = frozenset()  # somebody else's bodies that are not static
        self._planes: dict[int, tuple[FloatArray, float] | None] = {}
        self._census = (0, -1)  # number of bodies and id of the last
        self._last: tuple[int, str] = _NOBODY  # the last body and its tag
        self._box: Box | None = None  # around the boxes of all breakable bodies
        self._in_box: tuple[BodyLink, ...] = ()
        self._mover_boxes: dict[BodyLink, Box] = {}  # where movers in it were

    # Which bodies there are

    def bodies_changed(self, step: int) -> bool:
        """Tell whether bodies came or went.

        Parameters
        ----------
        step : int
            Number of the step. Two questions take turns: another body in the last one's place leaves the number of
            bodies as it is, and another in one's place before it the last.

        Returns
        -------
        bool
            Whether they did since the last time that this was True.
        """
        engine = self._engine
        if step & 1:
            changed = engine.body_count() != self._census[0] or not engine.is_marked(*self._last)
        else:
            changed = engine.body_count_and_last() != self._census
        if changed:
            self._census = engine.body_count_and_last()
        return changed

    def recount(self) -> None:
        """Find out anew which bodies there are; ids of removed bodies are handed out again."""
        engine, tokens = self._engine, self.tokens
        self._planes.clear()
        engine.joints.forget()
        for body in [body for body, token in tokens.items() if not engine.is_marked(body, token)]:
            del tokens[body]
        self._others_movers = frozenset(
            body for body in engine.body_ids() if body not in tokens and not engine.is_static(body)
        )
        self._in_box, self.any_mover = (), False
        self.joined = engine.constraints.joined_to(self._records)
        last = self._census[1]
        if last in tokens:
            self._last = last, tokens[last]
        elif last >= 0 and not (self._last[0] == last and engine.is_marked(*self._last)):
            self._last = last, engine.mark(last)

    def is_mover(self, body: int) -> bool:
        """Tell whether a body is a mover.

        Parameters
        ----------
        body : int
            Its id.

        Returns
        -------
        bool
            Whether it moves and is not observed.
        """
        return body in self._others_movers or body in self.unwatched_movers

    # Boxes of breakable bodies

    def place_box(self, record: BodyRecord, dt: float) -> None:
        """Make the box of a body, with a margin on all sides that lets it move for some steps.

        Parameters
        ----------
        record : BodyRecord
            The body; its centre is read anew.
        dt : float
            Time step, s.
        """
        margin = SETTINGS.seen_speed * dt + SETTINGS.box_margin * record.reach
        record.box_slack = SETTINGS.box_use * margin
        reach = record.reach + 2 * margin
        x, y, z = record.center = list(self._engine.placement(record.body.id)[0])
        record.box_low, record.box_high = (x - reach, y - reach, z - reach), (x + reach, y + reach, z + reach)
        self._box = None

    def forget_common_box(self) -> None:
        """Make the box around all breakable bodies anew, since one of them is gone."""
        self._box = None

    def claim_free_way(self, record: BodyRecord, unobserved: Iterable[BodyRecord], dt: float, gravity: Triple) -> bool:
        """Tell whether a body can meet nothing in the next steps unless something comes near; its box covers the way.

        Parameters
        ----------
        record : BodyRecord
            The body. Its centre is read anew, and where the way is free its box is the way's.
        unobserved : iterable of BodyRecord
            Bodies that are left alone; one in flight may be anywhere in its box.
        dt : float
            Time step, s.
        gravity : tuple of float
            m/s².

        Returns
        -------
        bool
            Whether its way is free.
        """
        time = (SETTINGS.steps_of_flight + 2) * dt
        margin = SETTINGS.seen_speed * dt + record.reach
        record.center = list(self._engine.placement(record.body.id)[0])
        low, high = [], []
        for x, v, g in zip(record.center, record.motion[0], gravity, strict=True):
            # The way there and back is at most what speed and fall add up to.
            end = v * time + 0.5 * g * time * time
            turn = -0.5 * v * v / g if g * v < 0.0 and abs(v) < abs(g) * time else 0.0
            low.append(x + min(0.0, end, turn) - margin)
            high.append(x + max(0.0, end, turn) + margin)
        corners = (low[0], low[1], low[2]), (high[0], high[1], high[2])
        for other in unobserved:
            if all(a <= d and c <= b for a, b, c, d in zip(low, high, other.box_low, other.box_high, strict=True)):
                return False
        for body, _ in self._engine.overlapping(*corners):
            if body != record.body.id and not self._is_distant_plane(body, *corners):
                return False
        record.box_low, record.box_high = corners
        self._box = None
        return True

    def _is_distant_plane(self, body: int, low: Triple, high: Triple) -> bool:
        """Tell whether a body is an infinite plane, whose bounding box is everywhere, that does not meet a box."""
        if body in self.tokens or body in self._others_movers:
            return False
        if body not in self._planes:
            self._planes[body] = self._engine.plane_of(body)
        plane = self._planes[body]
        if plane is None:
            return False
        normal, height = plane
        nearest = sum(n * (a if n > 0.0 else b) for n, a, b in zip(normal.tolist(), low, high, strict=True))
        return bool(nearest > height)

    # What moves near them

    def find_movers(self, observed: Iterable[BodyRecord], dt: float) -> bool:
        """Find out whether a mover is in the box around all breakable bodies.

        Parameters
        ----------
        observed : iterable of BodyRecord
            The bodies that are observed; those that have left their boxes get new ones.
        dt : float
            Time step, s.

        Returns
        -------
        bool
            Whether one is; also ``any_mover``.
        """
        if not (self._others_movers or self.unwatched_movers) or not self._records:
            self.any_mover = False
            return False
        in_box = self._engine.overlapping(*(self._box or self._enclose(observed, dt)))
        if in_box != self._in_box or self.unwatched_movers != self._unwatched_before:
            self._in_box, self._unwatched_before = in_box, self.unwatched_movers
            self.any_mover = any(self.is_mover(body) for body, _ in in_box)
        return self.any_mover

    def _enclose(self, observed: Iterable[BodyRecord], dt: float) -> Box:
        """Make the box around all breakable bodies."""
        for record in observed:
            if record.box_slack < 0.0:
                self.place_box(record, dt)
        lows = zip(*(record.box_low for record in self._records.values()), strict=True)
        highs = zip(*(record.box_high for record in self._records.values()), strict=True)
        (a, b, c), (d, e, f) = map(min, lows), map(max, highs)
        self._box = (a, b, c), (d, e, f)
        return self._box

    def movers_beside(self, dt: float) -> dict[int, list[BodyLink]]:
        """Find the movers so near to each body that they may have touched it in the last step, or will in the next.

        Parameters
        ----------
        dt : float
            Time step, s.

        Returns
        -------
        dict of int to list of (int, int)
            Body and link of the movers near each body, by its id; bodies with none are left out.
        """
        movers = [key for key in self._in_box if self.is_mover(key[0])]
        records = self._records.values()
        if len(movers) <= len(records):
            before = self._mover_boxes
            boxes = self._mover_boxes = {key: self._engine.bounding_box(*key) for key in movers}
            moved = [
                _distance_moved(before[key], box) if key in before else SETTINGS.seen_speed
                for key, box in boxes.items()
            ]
            if max(moved) < SETTINGS.seen_speed * dt:
                return self._beside_by_boxes(boxes, moved, dt)
        result: dict[int, list[BodyLink]] = {}
        for record in records:
            near = [key for key in self._engine.overlapping(record.box_low, record.box_high) if self.is_mover(key[0])]
            if near:
                result[record.body.id] = near
        return result

    def _beside_by_boxes(self, boxes: dict[BodyLink, Box], moved: list[float], dt: float) -> dict[int, list[BodyLink]]:
        """Do the same where all movers were seen before and are slow.

        Then where they are now tells more than the engine's search for contacts, which is a step behind and knows no
        distances. boxes: where they are; moved: how far each went, m.
        """
        grown = []
        for (key, (low, high)), distance in zip(boxes.items(), moved, strict=True):
            s = SETTINGS.mover_steps * distance
            grown.append((key, low[0] - s, low[1] - s, low[2] - s, high[0] + s, high[1] + s, high[2] + s))
        _, *lows_and_highs = zip(*grown, strict=True)
        west, south, down = map(min, lows_and_highs[:3])
        east, north, up = map(max, lows_and_highs[3:])
        result: dict[int, list[BodyLink]] = {}
        for record in self._records.values():
            a, b, c, d, e, f = record.contact_box if record.asleep else contact_box(record, dt)
            if d < west or a > east or e < south or b > north or f < down or c > up:
                continue
            near = [
                key for key, u, v, w, x, y, z in grown if a <= x and d >= u and b <= y and e >= v and c <= z and f >= w
            ]
            if near:
                result[record.body.id] = near
        return result


def contact_box(record: BodyRecord, dt: float) -> tuple[float, ...]:
    """Make the box that something has to meet to touch a body in the step to come.

    Parameters
    ----------
    record : BodyRecord
        The body.
    dt : float
        Time step, s.

    Returns
    -------
    tuple of float, length 6
        Lowest x, y, z and highest x, y, z, m.
    """
    if record.unobserved_until and not record.asleep:
        return (*record.box_low, *record.box_high)
    x, y, z = record.center
    moved = (SETTINGS.contact_steps * SETTINGS.seen_speed + max(map(abs, record.motion[0]))) * dt
    reach = SETTINGS.contact_reach * record.reach + moved
    return x - reach, y - reach, z - reach, x + reach, y + reach, z + reach


def _distance_moved(old: Box, new: Box) -> float:
    """Measure how far a box has moved or grown along any axis, m."""
    (a, b, c), (d, e, f) = old
    (u, v, w), (x, y, z) = new
    return max(u - a, a - u, v - b, b - v, w - c, c - w, x - d, d - x, y - e, e - y, z - f, f - z)
