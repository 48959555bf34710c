"""``--import MODULE``: load a user's modules, so that the simulators and models they register have a name.

Used by the command line's main function only.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from ..common.errors import FracsimError


def split_imports(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Take ``--import MODULE`` out of the arguments, wherever it stands.

    Parameters
    ----------
    arguments : sequence of str
        The command line without the program's name.

    Returns
    -------
    modules : list of str
        The names of the modules, in order.
    rest : list of str
        The other arguments.
    """
    parser = argparse.ArgumentParser(prog="fracsim", add_help=False, allow_abbrev=False)
    parser.add_argument("--import", dest="modules", action="append", default=[], metavar="MODULE")
    known, rest = parser.parse_known_args(list(arguments))
    return known.modules, rest


def import_modules(names: Sequence[str]) -> None:
    """Import a user's modules. They are found where Python finds modules, and in the working directory.

    The working directory stays on ``sys.path``, at its end, since workers find the module there as well.

    Parameters
    ----------
    names : sequence of str
        As in an import statement: ``mine`` or ``package.mine``.

    Raises
    ------
    FracsimError
        If a module is not there, or raises an error while it is imported. The message names the module and the fault.
    """
    if names and not {"", str(Path.cwd())} & set(sys.path):
        sys.path.append(str(Path.cwd()))
    for name in names:
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            hint = f", such as {Path(name).stem}" if name.endswith(".py") else ""
            raise FracsimError(f"--import {name}: not the name of a module; give it as in an import statement{hint}")
        try:
            importlib.import_module(name)
        except Exception as error:  # somebody else's code, which may raise anything
            if isinstance(error, ModuleNotFoundError) and error.name and f"{name}.".startswith(f"{error.name}."):
                raise FracsimError(
                    f"--import {name}: there is no module {error.name}, neither installed nor in {Path.cwd()}"
                ) from error
            raise FracsimError(f"--import {name}: {_described(error)}") from error


def _described(error: Exception) -> str:
    """Name an error of a user's module and the line that raised it."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "importlib" not in f.filename]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames[1:] else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{place}"
