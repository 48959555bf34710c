"""Which cells the stress matrix has: the corners and ends of its axes, a sample of what lies between, and each family.

``run`` plays them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import qmc

from .cells import COUNTS, MESHES, RANGES, SHARES, Cell
from .scenes import FAMILIES

MIDDLE = {"time_step": 1 / 240, "speed": 5.0, "density_ratio": 1.0, "size": 0.3}  # what the ends of an axis go with
SEVERITY = 4.0  # where the axis is not sampled
SPREAD, QUICK_SPREAD = 400, 24  # cells of the sample


def all_cells(quick: bool, seed: int) -> list[Cell]:
    """List the whole stress matrix: each family, the corners and ends of the axes, and what lies between.

    Parameters
    ----------
    quick : bool
        Whether to list a tenth or so.
    seed : int
        Of all random choices.

    Returns
    -------
    list of Cell
        The same for the same seed.
    """
    rng = np.random.default_rng(seed)
    names = tuple(MIDDLE)
    chosen: list[dict[str, Any]] = [
        {name: RANGES[name][corner >> k & 1] for k, name in enumerate(names)}
        for corner in range(0, 16, 3 if quick else 1)
    ]
    if not quick:
        chosen += [MIDDLE | {name: end} for name in names for end in RANGES[name]]
        chosen += [MIDDLE | {"breakables": count} for count in COUNTS]
    listed = [
        cell
        for name, (_, variants) in FAMILIES.items()
        if name != "matrix"
        for cell in _family(name, variants, max(1, variants // 2) if quick else max(8, 3 * variants), rng)
    ]
    for i, axes in enumerate(chosen + _spread(QUICK_SPREAD if quick else SPREAD, rng)):
        drawn = int(rng.integers(2**31))
        if quick:  # crowds take their time
            axes |= {"breakables": min(axes.get("breakables", 1), COUNTS[1])}
        scene = {"breakables": 1, "other": ("ball", "box")[i // 3 % 2], "severity": SEVERITY, **axes}
        listed.append(Cell(family="matrix", mesh=MESHES[i % 3], variant=0, seed=drawn, **scene))
    return listed


def _spread(count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Draw values of all axes by a Latin hypercube."""
    unit = qmc.LatinHypercube(len(RANGES) + 2, seed=rng).random(count)
    result = []
    for row in unit:
        axes: dict[str, Any] = {
            name: float(low * (high / low) ** share)
            for share, (name, (low, high)) in zip(row, RANGES.items(), strict=False)
        }
        index = min(int(np.searchsorted(np.cumsum(SHARES), row[-1])), len(COUNTS) - 1)
        axes["breakables"] = COUNTS[index]
        if index >= 3:
            axes["severity"] = min(axes["severity"], 3.0)  # a thousand pieces are enough
        if row[-2] > 0.8:
            axes["other"] = "floor"
        result.append(axes)
    return result


def _family(name: str, variants: int, count: int, rng: np.random.Generator) -> list[Cell]:
    """List cells of one family, over the axes and its variants."""
    result = []
    for i, axes in enumerate(_spread(count, rng)):
        axes |= {
            "breakables": {"worlds": 2, "removal": 2}.get(name, 1),
            "other": "floor" if name == "rest" else ("ball", "box")[i // variants % 2],
            "mesh": "vase" if name == "inside" else MESHES[(i + i // variants) % 3],
            "variant": i % variants if count >= variants else int(rng.integers(variants)),
            "seed": int(rng.integers(2**31)),
        }
        if name == "robot":  # an arm has a size of its own, and joints have a speed
            axes["size"] = float(np.clip(axes["size"], 0.1, 0.6))
            axes["speed"] = float(np.clip(axes["speed"], 0.5, 10.0))
        result.append(Cell(family=name, **axes))
    return result
