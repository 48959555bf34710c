"""What the registries of simulators, models, segmentations and environments share: names, and classes by their place.

Each registry is a dict in its own room; the checks that are the same everywhere stand here.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection

from .errors import FracsimError


def check_new_name(name: object, taken: Collection[str], kind: str, error_type: type[FracsimError]) -> None:
    """Refuse a name that cannot be registered.

    Parameters
    ----------
    name : object
        What somebody gave.
    taken : collection of str
        Names that are not free.
    kind : str
        What is registered, for messages: ``"simulator"``.
    error_type : type
        The error to raise.

    Raises
    ------
    FracsimError
        Of the given type, if the name is no text, is empty, or is taken.
    """
    if not isinstance(name, str) or not name.strip():
        raise error_type(f"the name of a {kind} must be a text that is not empty, got {name!r}")
    if name in taken:
        raise error_type(f"the {kind} name {name!r} is taken; choose another")


def class_at(place: str, subject: str, error_type: type[FracsimError]) -> object:
    """Import what a registry names as ``"module:Class"``.

    Parameters
    ----------
    place : str
        The module and the name in it.
    subject : str
        What messages call the entry: ``"simulator 'modal'"``.
    error_type : type
        The error to raise.

    Returns
    -------
    object
        What the module holds under that name.

    Raises
    ------
    FracsimError
        Of the given type, if the module holds nothing of that name.
    MissingExtraError
        If what the module needs is not installed.
    """
    module, _, attribute = place.partition(":")
    contents = vars(importlib.import_module(module))
    if attribute not in contents:
        raise error_type(f"{subject}: {module} has no class {attribute!r}; register it as 'module:Class'")
    return contents[attribute]


def missing_members(cls: type, members: Collection[str]) -> list[str]:
    """Return those members that a class does not have, in order.

    Parameters
    ----------
    cls : type
        The class.
    members : collection of str
        What it must have.

    Returns
    -------
    list of str
        What it lacks.
    """
    present = dir(cls)
    return [member for member in members if member not in present]
