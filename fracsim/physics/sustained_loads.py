"""Forces that last: how long more than a bearable force has pressed on a body, and when that is to be judged.

`Activity` hands the contacts over; a load moves nothing, so nothing else would notice one.
"""

from __future__ import annotations

from collections.abc import Iterable

from .impacts import is_slow
from .records import SETTINGS, BodyRecord
from .states import BodyContacts


def is_pressed(record: BodyRecord, contacts: BodyContacts | None) -> bool:
    """Tell whether more than a bearable force presses on a body that is held still.

    Parameters
    ----------
    record : BodyRecord
        The body.
    contacts : BodyContacts, optional
        Its contacts in the last step.

    Returns
    -------
    bool
        False too where it moves: then its contacts are those of an impact.
    """
    if contacts is None or contacts.force <= record.bearable_force:
        return False
    return is_slow(record.motion, SETTINGS.load_speed, record.reach)


def count_pressed_step(record: BodyRecord, contacts: BodyContacts) -> None:
    """Count a step in which a body was pressed.

    Parameters
    ----------
    record : BodyRecord
        The body.
    contacts : BodyContacts
        Its contacts in this step. Of every few steps the lightest are kept, since a load acts in all of them.
    """
    record.pressed_steps += 1
    if record.pressed_steps % SETTINGS.steps_between_inspections == 1:
        record.lightest_contacts = None
    if record.lightest_contacts is None or contacts.force < record.lightest_contacts.force:
        record.lightest_contacts = contacts


def release(record: BodyRecord) -> None:
    """Take note that nothing presses on a body.

    Parameters
    ----------
    record : BodyRecord
        The body.
    """
    record.pressed_steps, record.lightest_contacts = 0, None


def due_loads(observed: Iterable[BodyRecord]) -> list[BodyRecord]:
    """Find the bodies whose load has lasted long enough and is to be judged now.

    Parameters
    ----------
    observed : iterable of BodyRecord
        The bodies that are observed; a pressed one always is.

    Returns
    -------
    list of BodyRecord
        Each once every few steps.
    """
    due, period = SETTINGS.load_steps, SETTINGS.steps_between_inspections
    return [record for record in observed if record.pressed_steps and record.pressed_steps % period == due]
