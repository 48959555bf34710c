"""Fracture simulators: impacts in, pieces out; what every learned model is trained on and measured against.

This room is offline; datasets, learning and baking enter it through ``make_simulator`` and the protocols of
``simulators.base``. To add a simulator of the package, write one file and one line of ``SIMULATORS``; a user's own
class is added with ``register_simulator``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..common.errors import BakeError
from ..common.registry import check_new_name, class_at, missing_members

if TYPE_CHECKING:
    from .base import RegisteredSimulator

# Each name's class, or where to import it from when it is first used: not every class's dependencies are installed.
SIMULATORS: dict[str, str | type[RegisteredSimulator]] = {
    "modal": "fracsim.simulators.modal:ModalSimulator",
    "structural": "fracsim.simulators.structural:StructuralSimulator",
    "sequential": "fracsim.simulators.sequential:SequentialSimulator",
    "elastic": "fracsim.simulators.elastic:ElasticSimulator",
    "radial": "fracsim.simulators.radial:RadialSimulator",
}

# What a class must carry to be registered; ``simulators.base.RegisteredSimulator`` says what each means. It names
# ``severity_kind`` too, which may be left out.
REQUIRED = (
    "options_type",
    "fixed_cracks",
    "repeatable",
    "driven_by_impact_field",
    "build",
    "thresholds",
    "fracture",
    "state",
    "restore",
)

UNREGISTERED = "own"  # how a dataset's header calls a simulator that has no name here

__all__ = ["SIMULATORS", "register_simulator", "simulator_class"]


def register_simulator(name: str, cls: str | type[Any]) -> None:
    """Make a simulator known by a name, for ``BakeOptions``, ``make_dataset`` and ``--simulator``.

    Parameters
    ----------
    name : str
        How it is asked for. It must be free.
    cls : type or str
        A class with all that ``simulators.base.RegisteredSimulator`` lists, or ``"module:Class"``, which is imported
        when it is first used.

    Raises
    ------
    BakeError
        If the name is taken or no name, or the class lacks something.
    """
    check_new_name(name, {*SIMULATORS, UNREGISTERED}, "simulator", BakeError)
    SIMULATORS[name] = cls if isinstance(cls, str) else _complete(name, cls)


def simulator_class(name: str) -> type[RegisteredSimulator]:
    """Look up the class of a registered simulator.

    Parameters
    ----------
    name : str
        A key of ``SIMULATORS``.

    Returns
    -------
    type
        The class, imported now if it was not before.

    Raises
    ------
    BakeError
        If no simulator has that name, or the place it was registered with does not hold it.
    MissingExtraError
        If what its module needs is not installed.
    """
    if name not in SIMULATORS:
        raise unknown_simulator(name)
    entry = SIMULATORS[name]
    if isinstance(entry, str):
        entry = _complete(name, class_at(entry, f"simulator {name!r}", BakeError))
        SIMULATORS[name] = entry
    return entry


def unknown_simulator(name: object) -> BakeError:
    """Make the error for a name that no simulator has.

    Parameters
    ----------
    name : object
        What somebody gave.

    Returns
    -------
    BakeError
        It lists the names that there are, and how to add one.
    """
    known = " or ".join(SIMULATORS)
    return BakeError(
        f"unknown simulator {name!r}; use {known}, or register your own; "
        "on a command line, fracsim --import MODULE loads the module that does so"
    )


def _complete(name: str, cls: Any) -> type[RegisteredSimulator]:
    """Return the class if it carries all that a registered simulator must."""
    if not isinstance(cls, type):
        raise BakeError(f"simulator {name!r}: must be a class or 'module:Class', got {cls!r}")
    if missing := missing_members(cls, REQUIRED):
        raise BakeError(f"simulator {name!r}: {cls.__name__} lacks {', '.join(missing)}; see RegisteredSimulator")
    return cls
