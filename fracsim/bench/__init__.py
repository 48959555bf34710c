"""Measurements of the running simulation: ``fracsim bench``.

A benchmark is one module with ``measure``, ``table`` and ``draw``, and one line in BENCHMARKS. Only the command line
uses this room.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

from .. import __version__
from ..common.errors import FracsimError
from ..common.files import write_beside

BENCHMARKS = {  # name -> module, imported when it is first used
    "latency": "fracsim.bench.latency",
    "idle": "fracsim.bench.idle",
    "decomposition": "fracsim.bench.decomposition",
    "timestep": "fracsim.bench.timestep",
    "stability": "fracsim.bench.stability",
    "soak": "fracsim.bench.soak",
}
PYBULLETS = ("pybullet", "pybullet-arm64")  # distributions that both import as pybullet


class Benchmark(Protocol):
    """What a module in BENCHMARKS has."""

    def measure(self, quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
        """Measure, and return the figures as plain data.

        Parameters
        ----------
        quick : bool
            Whether to measure a small part only, to see that it works.
        seed : int
            Of all random choices.
        progress : callable
            Called with the share done, from 0 to 1.
        """
        ...

    def table(self, figures: dict[str, Any]) -> str:
        """Write the figures as Markdown."""
        ...

    def draw(self, figures: dict[str, Any], path: Path) -> None:
        """Draw the figures to a PNG file."""
        ...


def benchmark(name: str) -> Benchmark:
    """Import a benchmark.

    Parameters
    ----------
    name : str
        A name in BENCHMARKS.

    Returns
    -------
    Benchmark
        Its module.

    Raises
    ------
    FracsimError
        If there is no benchmark of that name.
    MissingExtraError
        If the benchmark needs an extra that is not installed.
    """
    if name not in BENCHMARKS:
        raise FracsimError(f"unknown benchmark {name!r}; use one of {', '.join(BENCHMARKS)}")
    module: Any = import_module(BENCHMARKS[name])
    return module


def run(name: str, quick: bool, seed: int, out: Path | None, progress: Callable[[float], None]) -> dict[str, Any]:
    """Measure one benchmark, and write its figures, table and picture.

    Parameters
    ----------
    name : str
        A name in BENCHMARKS.
    quick : bool
        Whether to measure a small part only.
    seed : int
        Of all random choices.
    out : Path or None
        A folder for runtime_NAME.json, .md and .png; None writes nothing.
    progress : callable
        Called with the share done, from 0 to 1.

    Returns
    -------
    dict
        Plain data: the figures, the machine and the command that made them, and the table.
    """
    module = benchmark(name)
    if out is not None:
        from .picture import new_figure

        new_figure(1.0, 1.0)  # a missing matplotlib is named now, not after the measurement
        out.mkdir(exist_ok=True)
    figures: dict[str, Any] = {
        "command": f"fracsim bench {name}" + (" --quick" if quick else "") + (f" --seed {seed}" if seed else ""),
        "machine": {
            "cores": os.cpu_count(),
            "load": os.getloadavg(),  # before the measurement: what else was running
            "python": platform.python_version(),
            "numpy": version("numpy"),
            "pybullet": _pybullet_version(),
            "fracsim": __version__,
        },
    }
    figures |= module.measure(quick, seed, progress)
    figures["table"] = module.table(figures)
    if out is not None:
        write_beside(out / f"runtime_{name}.json", (json.dumps(figures, indent=1) + "\n").encode())
        write_beside(out / f"runtime_{name}.md", (figures["table"] + "\n").encode())
        module.draw(figures, out / f"runtime_{name}.png")
    return figures


def _pybullet_version() -> str:
    """Find the version of PyBullet, whichever distribution brought it."""
    for name in PYBULLETS:
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "unknown"
