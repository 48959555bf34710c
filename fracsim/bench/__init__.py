"""Measurements of the running simulation: ``fracsim bench``.

A module a benchmark, each with ``measure(quick, seed, progress) -> figures``, ``table(figures)`` in Markdown and
``draw(figures, path)``.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

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
            "pybullet": version("pybullet"),
            "fracsim": version("fracsim"),
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
