"""The command ``bench``: measure the running simulation on this machine.

The command line's main function adds it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..bench import BENCHMARKS, benchmark, run
from ..common.errors import FracsimError
from .arguments import Commands, add_common, add_seed, listed
from .output import require_folder


def add_commands(commands: Commands) -> None:
    """Add ``bench`` to the command line.

    Parameters
    ----------
    commands : Commands
        What ``ArgumentParser.add_subparsers`` returned.
    """
    parser = commands.add_parser("bench", help="measure the running simulation on this machine")
    parser.add_argument("name", help=f"the benchmark: {listed(BENCHMARKS)}")
    parser.add_argument("--quick", action="store_true", help="a short run, to see that it works")
    add_seed(parser, "seed of all random choices")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write runtime_NAME.json, .md and .png here")
    add_common(parser, quiet=True)
    parser.set_defaults(run=bench, check_out=require_folder)


def bench(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim bench``."""
    from ..common.progress import Stages

    if options.name not in BENCHMARKS:
        raise FracsimError(f"unknown benchmark {options.name!r}; use one of {', '.join(BENCHMARKS)}")
    benchmark(options.name)  # a missing extra is named before the progress bar appears
    with Stages(not options.quiet) as stage:
        figures = run(options.name, options.quick, options.seed, options.out, stage.ticker(options.name))
    print(figures["table"])
    return figures
