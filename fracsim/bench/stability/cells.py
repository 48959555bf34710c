"""What a cell of the stress matrix is: one small scene, by its axes and its seed.

The other modules of this package use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from ...fracture.asset import BreakableAsset, load

Row = dict[str, Any]  # what playing a cell found, as plain data

MESHES = ("bunny", "chair", "vase")
COUNTS = (1, 2, 5, 15, 50)  # breakables
SHARES = (0.62, 0.20, 0.13, 0.04, 0.01)  # of the cells; a scene of fifty takes as long as a hundred others
RANGES = {  # of the axes that are sampled evenly in their logarithms
    "time_step": (1 / 2000, 1 / 60),  # s
    "speed": (0.1, 300.0),  # m/s
    "density_ratio": (1e-4, 1e4),
    "size": (0.01, 100.0),  # m
    "severity": (1.5, 20.0),
}
LIMITS = {  # of the residuals, see `Stage.check`
    "mass": 1e-9,
    "momentum": 1e-6,
    "energy": 0.01,
    "speed": 1.0,
}
APPROACH = 2  # steps before things meet
AFTERMATH = 28  # steps after
UNBREAKABLE = 1e30  # Pa, a tensile strength that nothing exceeds at any speed
GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class Cell:
    """One scene, to the last random draw: ``run(Cell(**row["cell"]))`` plays it again.

    Attributes
    ----------
    family : str
        A key of ``scenes.FAMILIES``.
    time_step : float
        s.
    speed : float
        At which things meet, m/s.
    density_ratio : float
        Density of what is thrown, over the breakable's.
    size : float
        Largest extent of the breakable, m.
    breakables : int
        How many there are.
    mesh : str
        Name of a shipped asset.
    other : str
        What they meet: "ball", "box" or "floor".
    severity : float
        Of the impact, over what just breaks the body.
    variant : int
        Which of the family's scenes.
    seed : int
        Of all random choices in the scene.
    """

    family: str
    time_step: float
    speed: float
    density_ratio: float
    size: float
    breakables: int
    mesh: str
    other: str
    severity: float
    variant: int
    seed: int


@lru_cache(maxsize=len(MESHES))
def asset_named(mesh: str) -> BreakableAsset:
    """Load a shipped asset, once in a process.

    Parameters
    ----------
    mesh : str
        Its name.

    Returns
    -------
    BreakableAsset
        At its own size.
    """
    return load(mesh)


def asset_of(cell: Cell) -> BreakableAsset:
    """Load the asset of a cell.

    Parameters
    ----------
    cell : Cell
        The cell.

    Returns
    -------
    BreakableAsset
        At the cell's size, of its own material.
    """
    asset = asset_named(cell.mesh)
    return asset.scaled(cell.size / asset.size)
