"""Measurements of the running simulation: ``fracsim bench``.

A module a benchmark, each with ``measure(quick, seed, progress) -> figures``, ``table(figures)`` in Markdown and
``draw(figures, path)``.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from .. import __version__

NAMES = ("latency", "idle", "decomposition", "timestep", "stability", "soak")


def run(name: str, quick: bool, seed: int, out: Path | None, progress: Callable[[float], None]) -> dict[str, Any]:
    """Measure one, and write runtime_NAME.json, .md and .png into a folder -> the figures, with the table in them."""
    module = import_module(f".{name}", __name__)
    figures: dict[str, Any] = {
        "command": f"fracsim bench {name}" + (" --quick" if quick else "") + (f" --seed {seed}" if seed else ""),
        "machine": {
            "cores": os.cpu_count(),
            "load": os.getloadavg(),  # before: what else was running
            "python": platform.python_version(),
            "numpy": version("numpy"),
            "pybullet": _pybullet_version(),
            "fracsim": __version__,
        },
    }
    figures |= module.measure(quick, seed, progress)
    figures["table"] = module.table(figures)
    if out is not None:
        import json

        from ..common.files import write_beside

        out.mkdir(exist_ok=True)
        write_beside(out / f"runtime_{name}.json", (json.dumps(figures, indent=1) + "\n").encode())
        write_beside(out / f"runtime_{name}.md", (figures["table"] + "\n").encode())
        module.draw(figures, out / f"runtime_{name}.png")
    return figures


def _pybullet_version() -> str:
    """Return the version of PyBullet, or of the fork that stands in for it from Python 3.12 on."""
    try:
        return version("pybullet")
    except PackageNotFoundError:
        return f"{version('pybullet-arm64')} (pybullet-arm64)"
