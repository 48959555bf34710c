"""The command line ``fracsim``: reads the arguments, runs a command, and writes its figures with ``--json``.

The installed program ``fracsim`` and ``python -m fracsim.cli`` call ``main``.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence

from .. import __version__
from ..common.errors import FracsimError
from . import assets, benchmarks, datasets, models
from .imports import import_modules, split_imports
from .output import require_file, write_json

DONE, REFUSED, INTERRUPTED = 0, 2, 130  # exit codes; a shell gives 128 and the signal's number, 2, for an interrupt


def build_parser() -> argparse.ArgumentParser:
    """Build the parser, with the names that the registries hold now in its help texts.

    Returns
    -------
    ArgumentParser
        What it parses has ``run``, the command's function; where there is ``out``, ``check_out``, which refuses what
        cannot be written; and for some commands ``interrupted``, which says what an interrupted run leaves behind.
    """
    parser = argparse.ArgumentParser(prog="fracsim", description="Breakable objects for PyBullet and Gymnasium.")
    parser.add_argument("--version", action="version", version=f"fracsim {__version__}")
    parser.add_argument(
        "--import",
        dest="modules",
        action="append",
        metavar="MODULE",
        help="import this module first, from the working directory too, so that what it registers is known",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for group in (assets, datasets, models, benchmarks):
        group.add_commands(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program.

    Parameters
    ----------
    arguments : sequence of str, optional
        The command line without the program's name; by default the process's own.

    Returns
    -------
    int
        The exit code: 0; 2 for bad input, with one line on standard error that names the fault; 130 when interrupted.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without µ shows ?
    options = argparse.Namespace()
    try:
        modules, rest = split_imports(sys.argv[1:] if arguments is None else arguments)
        import_modules(modules)
        build_parser().parse_args(rest, options)
        if options.json is not None:
            require_file(options.json)
        if getattr(options, "out", None) is not None:  # else the command checks the name that it makes up
            options.check_out(options.out)
        figures = options.run(options)
        if options.json is not None:
            write_json(options.json, figures)
        if sys.stdout is not None:  # None where the program was started without one
            sys.stdout.flush()
    except FracsimError as error:
        return _refuse(str(error))
    except OSError as error:  # such as a disk that is full, or a folder that was removed meanwhile
        if error.filename:
            return _refuse(f"{error.filename}: {error.strerror}")
        _drop_output()
        return _refuse(f"the output cannot be written ({error.strerror or error})")
    except MemoryError as error:
        return _refuse(f"not enough memory {error}".rstrip())
    except KeyboardInterrupt:
        kept = options.interrupted(options) if hasattr(options, "interrupted") else "nothing was written"
        print(f"fracsim: interrupted; {kept}", file=sys.stderr)
        return INTERRUPTED
    return DONE


def _drop_output() -> None:
    """Send what is still in the buffer of standard output nowhere, or it would fail once more when Python exits."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _refuse(fault: str) -> int:
    """Print a fault on one line of standard error, and return the exit code for it."""
    print(f"fracsim: {fault}", file=sys.stderr)
    return REFUSED


if __name__ == "__main__":
    sys.exit(main())
