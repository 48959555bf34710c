"""From the bodies that something may have struck to those that break.

`World.step` calls it twice: to predict the impacts on them, and to decide which of these bodies break.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ..common.errors import FracsimError
from .contact_durations import ContactDurations
from .fatigue import damage_of, felt_impulses
from .impact_solver import IMPACT_WINDOW
from .impacts import ContactImpulse, predict_impacts, sustained_impulses
from .last_step import LastStep
from .records import BodyRecord
from .world_state import WorldState

if TYPE_CHECKING:
    from ..common.impulse import Impulse
    from ..fracture.result import Fracture
    from .breakable import Breakable, BreakableObject


@dataclass(frozen=True)
class VerdictSettings:
    """What makes an impact the rest of one that has been counted already.

    The engine spreads an impact over several steps, and each of them predicts it anew from what is left of it.

    Attributes
    ----------
    same_place : float
        Distance as a share of the object's largest extent; a contact moves by less within the 10 ms of an impact.
    same_direction : float
        Cosine of the angle between the two, about 37°: a body that slides along another keeps its normal to that.
    """

    same_place: float = 0.05
    same_direction: float = 0.8


SETTINGS = VerdictSettings()


@dataclass(frozen=True, eq=False)
class StruckBody:
    """A breakable body and what struck it in the last step.

    Attributes
    ----------
    record : BodyRecord
        The body.
    impacts : list of ContactImpulse
        What struck it, in the order in which it came.
    elapsed : float
        Time that the prediction took, ms.
    """

    record: BodyRecord
    impacts: list[ContactImpulse]
    elapsed: float


@dataclass(frozen=True, eq=False)
class Break:
    """A body that is to be broken.

    Attributes
    ----------
    record : BodyRecord
        The body.
    impulses : tuple of Impulse
        What breaks it, in its asset's frame (m, N·s), strongest first.
    fracture : Fracture
        The model's answer, of two pieces or more.
    others : frozenset of int
        Ids of the bodies that struck it.
    timings : dict of str to float
        Time of each stage so far, ms: "impulse", "fracture", "bodies".
    """

    record: BodyRecord
    impulses: tuple[Impulse, ...]
    fracture: Fracture
    others: frozenset[int]
    timings: dict[str, float]


class Verdicts:
    """Judges the bodies of a world.

    Parameters
    ----------
    state : WorldState
        The world.
    last_step : LastStep
        How things moved before the step.
    fatigue : float or None
        Exponent of Miner's rule; None for no fatigue.
    """

    def __init__(self, state: WorldState, last_step: LastStep, fatigue: float | None) -> None:
        self._state = state
        self._last_step = last_step
        self._durations = ContactDurations(state.engine, state.clock, state.records, state.materials)
        self.fatigue = fatigue
        self._warned: set[tuple[str, str]] = set()

    # What struck whom

    def predict(self, suspects: list[BodyRecord], pressed: list[BodyRecord]) -> list[StruckBody]:
        """Predict the impacts on bodies, and on the breakable bodies that these struck.

        Parameters
        ----------
        suspects : list of BodyRecord
            Bodies that something may have struck in the last step.
        pressed : list of BodyRecord
            Bodies on which a load is to be judged, where nothing struck them.

        Returns
        -------
        list of StruckBody
            Those that something did strike.
        """
        state, time = self._state, self._state.clock.time
        struck: list[StruckBody] = []
        suspected, loaded = set(suspects), set(pressed)
        queue, judged = [*suspects, *pressed], set()
        for record in queue:  # grows while it runs
            body = record.body.id
            if body in judged:
                continue
            judged.add(body)
            if not state.engine.is_marked(body, record.body.token):
                state.forget(body)
                continue
            if self._is_spared(record):
                continue
            start = perf_counter()
            impacts = [] if record in loaded - suspected else self._impacts_on(record)
            if not impacts and record in loaded:
                impacts = self._loads_on(record)
            queue += [state.records[impact.other] for impact in impacts if impact.other in state.records]
            if time < record.immune_until:
                impacts = [impact for impact in impacts if impact.other not in record.immune_to]
            if impacts:
                struck.append(StruckBody(record, impacts, 1e3 * (perf_counter() - start)))
        return struck

    def _is_spared(self, record: BodyRecord) -> bool:
        """Whether all that touches a body was in the break that it came of, and neither may break the other yet."""
        time, records = self._state.clock.time, self._state.records
        if time >= record.immune_until:
            return False
        contacts = self._state.activity.contacts_of(record.body.id)
        for other, _ in contacts.others if contacts is not None else ():
            known = records.get(other)
            if other not in record.immune_to or (
                known is not None and (time >= known.immune_until or record.body.id not in known.immune_to)
            ):
                return False
        return True

    def _loads_on(self, record: BodyRecord) -> list[ContactImpulse]:
        state, body, clock = self._state, record.body, self._state.clock
        if record.lightest_contacts is None:
            return []
        placement = state.engine.placement_before(body.id, clock.time_step)
        return sustained_impulses(state.engine, body, record.lightest_contacts, placement, clock.gravity)

    def _impacts_on(self, record: BodyRecord) -> list[ContactImpulse]:
        state, body, clock = self._state, record.body, self._state.clock
        contacts = state.activity.contacts_of(body.id)
        if contacts is None:
            return []
        placement = state.engine.placement_before(body.id, clock.time_step)
        motion_before, durations_of = self._last_step.motion_before, self._durations.of(record.breakable)
        return predict_impacts(
            state.engine, body, contacts, placement, motion_before, durations_of, clock.time_step, clock.gravity
        )

    # Who breaks

    def decide(self, struck: list[StruckBody]) -> list[Break]:
        """Decide which of the bodies break that something struck.

        Parameters
        ----------
        struck : list of StruckBody
            Bodies and what struck them, as `predict` returned them.

        Returns
        -------
        list of Break
            Those that break, and into what.
        """
        records = self._state.records
        verdicts = [
            self.judge(body)
            for body in struck
            if records.get(body.record.body.id) is body.record  # a callback may have removed it
        ]
        return [verdict for verdict in verdicts if verdict is not None]

    def judge(self, struck: StruckBody) -> Break | None:
        """Decide whether impacts, one after the other and with those just before, break a body.

        Parameters
        ----------
        struck : StruckBody
            The body and the impacts.

        Returns
        -------
        Break or None
            None where it holds; the impacts then act together with those of the next 10 ms, and weaken it where
            fatigue is on.
        """
        record, impacts, now = struck.record, struck.impacts, self._state.clock.time
        earlier = [(when, impact) for when, impact in record.recent_impacts if when > now - IMPACT_WINDOW]
        record.recent_impacts = earlier
        start = perf_counter()
        has_new = False  # whether one of those that come together is no repetition
        for k, impact in enumerate(impacts):
            repeated = [old for _, old in earlier if _is_repetition(old, impact, record.breakable.size)]
            if not any(old.impulse.magnitude >= impact.impulse.magnitude for old in repeated):
                kept = [entry for entry in record.recent_impacts if entry[1] not in repeated]
                record.recent_impacts = [*kept, (now + impact.delay, impact)]
                has_new = has_new or impact.impulse.magnitude > 0.0
            comes_with_next = k + 1 < len(impacts) and impacts[k + 1].delay == impact.delay
            if comes_with_next or not has_new:
                continue
            has_new = False
            acting = sorted(
                (recent.impulse for _, recent in record.recent_impacts), key=lambda impulse: -impulse.magnitude
            )
            impulses = felt_impulses(acting, record.damage)
            if not record.breakable.may_break(impulses):
                continue
            fracture = self.ask(record.breakable, impulses)
            if fracture is not None and len(fracture.pieces) > 1:
                timings = {"impulse": struck.elapsed, "fracture": 1e3 * (perf_counter() - start), "bodies": 0.0}
                return Break(record, impulses, fracture, frozenset(impact.other for impact in impacts), timings)
        if self.fatigue is not None and record.recent_impacts:
            self._weaken(record, self.fatigue)
        return None

    def _weaken(self, record: BodyRecord, exponent: float) -> None:
        """Add what the impacts of this step, which broke nothing, did to the body's damage."""
        now = self._state.clock.time
        impulses = [impact.impulse for when, impact in record.recent_impacts if when >= now and not impact.sustained]
        if not impulses:
            return

        def breaks(stronger: tuple[Impulse, ...]) -> bool:
            if not record.breakable.may_break(stronger):
                return False
            fracture = self.ask(record.breakable, stronger)
            return fracture is not None and len(fracture.pieces) > 1

        record.damage_before = now, record.damage
        record.damage = min(1.0, record.damage + damage_of(impulses, exponent, breaks))

    # The model

    def ask(self, breakable: Breakable, impulses: Sequence[Impulse]) -> Fracture | None:
        """Ask a model what impulses do.

        Parameters
        ----------
        breakable : Breakable
            The object or piece.
        impulses : sequence of Impulse
            What acts on it, in its own frame (m, N·s).

        Returns
        -------
        Fracture or None
            None, and one warning for each fault of a model, where it raised a FracsimError: it has no answer that
            makes sense. Anything else that it raises is a fault in the code and passes through.
        """
        try:
            return breakable.fracture(impulses)
        except FracsimError as error:
            self._warn(breakable, error)
            return None

    def prepare(self, asset: BreakableObject) -> None:
        """Let an object work out what its first break would otherwise wait for; its errors count as in `ask`.

        Parameters
        ----------
        asset : BreakableObject
            The object.
        """
        try:
            asset.prepare()
        except FracsimError as error:
            self._warn(asset, error)

    def _warn(self, breakable: Breakable, error: FracsimError) -> None:
        """Warn once of each fault of a model, where the user's code called."""
        fault = breakable.name, f"{type(error).__name__}: {error}"
        if fault not in self._warned:
            self._warned.add(fault)
            message = f"{fault[0]} does not break: its model failed ({fault[1]})"
            warnings.warn(message, RuntimeWarning, stacklevel=_depth_outside_package())


def _is_repetition(old: ContactImpulse, new: ContactImpulse, size: float) -> bool:
    """Whether an impact is the rest of an earlier one. size: m, the object's largest extent."""
    return bool(
        old.other == new.other
        and np.linalg.norm(old.impulse.point - new.impulse.point) < SETTINGS.same_place * size
        and old.impulse.direction @ new.impulse.direction > SETTINGS.same_direction
    )


def _depth_outside_package() -> int:
    """Count the frames from the caller's to the first that is not of this package."""
    package = __name__.partition(".")[0]
    frame, depth = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, depth = frame.f_back, depth + 1
    return depth
