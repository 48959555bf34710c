"""Arguments that several commands have in common, and the names that the registries hold.

Used by the commands' parsers only. It imports nothing that an extra brings, so that ``fracsim --help`` always works.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

from ..common.errors import FracsimError
from ..common.material import PRESETS
from ..learning import MODELS
from ..simulators import SIMULATORS

MATERIAL = "ceramic"  # of what a simulator breaks, unless the command line says otherwise


class Commands(Protocol):
    """What ``ArgumentParser.add_subparsers`` returns, for which argparse has no public name."""

    def add_parser(self, name: str, *, help: str) -> argparse.ArgumentParser:
        """Add a command.

        Parameters
        ----------
        name : str
            What it is called on the command line.
        help : str
            One line.

        Returns
        -------
        ArgumentParser
            For the command's own arguments.
        """
        ...


def listed(names: Iterable[str], default: str | None = None) -> str:
    """Write names as a list for a help text.

    Parameters
    ----------
    names : iterable of str
        Such as the names of a registry.
    default : str, optional
        The one to mark as the default.

    Returns
    -------
    str
        The names, separated by commas.
    """
    return ", ".join(f"{name} (default)" if name == default else name for name in names)


class _Simulator(argparse.Action):
    """Keep a simulator's name; say once that ``--truth`` is the old name of the argument."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        if option_string == "--truth" and not getattr(namespace, "warned_of_truth", False):
            print("fracsim: --truth is now called --simulator; the next version drops the old name", file=sys.stderr)
            namespace.warned_of_truth = True
        setattr(namespace, self.dest, values)


def add_simulator(parser: argparse.ArgumentParser, default: str | None) -> None:
    """Add ``--simulator``, its old name ``--truth``, and ``--set`` for its options.

    Parameters
    ----------
    parser : ArgumentParser
        A command's.
    default : str or None
        The simulator without the argument; None where the command tells given from not given.
    """
    parser.add_argument(
        "--simulator",
        "--truth",
        dest="simulator",
        action=_Simulator,
        default=default,
        metavar="NAME",
        help=f"the fracture simulator to learn from: {listed(SIMULATORS, 'modal')}",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="another option of the simulator"
    )


def add_sizes(parser: argparse.ArgumentParser) -> None:
    """Add ``--cells`` and ``--modes``, whose defaults are the simulator's own.

    Parameters
    ----------
    parser : ArgumentParser
        A command's.
    """
    parser.add_argument(
        "--cells", type=int, help="about how many cells the body is cut into (default: the simulator's, modal 5000)"
    )
    parser.add_argument("--modes", type=int, help="fracture modes, of simulators that have them (default: 20)")


def add_material(parser: argparse.ArgumentParser, default: str | None) -> None:
    """Add ``--material``.

    Parameters
    ----------
    parser : ArgumentParser
        A command's.
    default : str or None
        The material without the argument; None where the command tells given from not given.
    """
    parser.add_argument(
        "--material", default=default, metavar="NAME", help=f"what it is made of: {listed(PRESETS, MATERIAL)}"
    )


def add_model(parser: argparse.ArgumentParser, task: str) -> None:
    """Add ``--model``.

    Parameters
    ----------
    parser : ArgumentParser
        A command's.
    task : str
        What the command does with the model, a verb.
    """
    parser.add_argument("--model", default="mlp", metavar="NAME", help=f"the model to {task}: {listed(MODELS, 'mlp')}")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the model")


def settings_of(texts: list[str], flag: str = "--set") -> dict[str, str]:
    """Split arguments NAME=VALUE.

    Parameters
    ----------
    texts : list of str
        The arguments.
    flag : str
        What stands before them, for messages.

    Returns
    -------
    dict of str to str
        Values by name.

    Raises
    ------
    FracsimError
        If an argument has no equals sign.
    """
    settings: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise FracsimError(f"{flag} takes NAME=VALUE, got {text!r}")
        settings[name] = value
    return settings


def add_seed(parser: argparse.ArgumentParser, purpose: str, default: int | None = 0) -> None:
    """Add ``--seed``.

    Parameters
    ----------
    parser : ArgumentParser
        A command's.
    purpose : str
        What the seed decides.
    default : int or None
        The seed without the argument; None where the command tells given from not given.
    """
    parser.add_argument("--seed", type=_seed, default=default, metavar="N", help=f"{purpose} (default: 0)")


def _seed(text: str) -> int:
    """Read a seed; NumPy's generators take no negative one."""
    if not text.isdecimal():
        raise FracsimError(f"--seed must be a whole number of at least 0, got {text}")
    return int(text)


def add_common(parser: argparse.ArgumentParser, quiet: bool = False) -> None:
    """Add what every command has: ``--json``, and for long ones ``--quiet``.

    Parameters
    ----------
    parser : ArgumentParser
        A command's.
    quiet : bool
        Whether the command shows progress bars.
    """
    if quiet:
        parser.add_argument("--quiet", action="store_true", help="show no progress bars")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file, as JSON")
