"""Options given as text, such as NAME=VALUE on a command line: the values that a dataclass of options has for them."""

from __future__ import annotations

import typing
from dataclasses import fields
from typing import Any

from .errors import FracsimError


def option_types(options_type: type[Any]) -> dict[str, Any]:
    """Return the type of every option.

    Parameters
    ----------
    options_type : type
        A dataclass.

    Returns
    -------
    dict of str to type
        By name, in the order of the fields.
    """
    hints = typing.get_type_hints(options_type)
    return {field.name: hints[field.name] for field in fields(options_type)}


def option_from_text(name: str, text: str, kind: Any, error_type: type[FracsimError]) -> Any:
    """Read the value of an option.

    Parameters
    ----------
    name : str
        The option's, for messages.
    text : str
        What somebody wrote; "none" where the option may be None.
    kind : type
        What it must be: bool, int, float, str, or a union of these and None.
    error_type : type
        The error to raise.

    Returns
    -------
    bool, int, float, str or None
        The value.

    Raises
    ------
    FracsimError
        Of the given type, if the text is no such value.
    """
    kinds = typing.get_args(kind) or (kind,)
    if type(None) in kinds and text.lower() == "none":
        return None
    if bool in kinds:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        raise error_type(f"{name} must be true or false, got {text!r}")
    for convert in (int, float, str):
        if convert in kinds:
            try:
                return convert(text)
            except ValueError:
                continue
    expected = " or ".join("none" if k is type(None) else k.__name__ for k in kinds)
    raise error_type(f"{name} must be of type {expected}, got {text!r}")
