"""The stress matrix: what a break must keep, checked wherever somebody might break something.

A cell is one small scene: bodies, and what meets them how. It is played twice, first as a twin whose bodies cannot
break, then with bodies whose strength is set so that the impact the twin took is ``severity`` times what just breaks
them. What the twin violates, too, is the engine's doing; a cell fails only by what breaking adds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ...common.impulse import Impulse
from ...fracture.asset import BreakableAsset
from .cells import LIMITS, Cell, Row, asset_of
from .matrix import all_cells
from .player import Player
from .scenes import FAMILIES
from .stage import Stage

BUDGET = 540.0  # s, after which no further cell is begun
SEVERITIES = (0.2, 90.0)  # total severity, between which what just breaks a body is sought
HALVINGS = 5  # of the logarithm of that range


def run(cell: Cell, tell: Callable[[str], object] = lambda phase: None) -> Row:
    """Play a cell and its twin.

    Parameters
    ----------
    cell : Cell
        The cell.
    tell : callable
        Called with what begins: "twin", then "breaking".

    Returns
    -------
    dict
        The cell's row: what its scene and its twin did, which checks only the scene violates (``failures``), and
        which its twin violates, too (``engine``).
    """
    start = time.perf_counter()
    tell("twin")
    twin, strengths = _play(cell, None)
    tell("breaking")
    live, _ = _play(cell, strengths)
    row: Row = {"cell": asdict(cell), "live": live, "twin": twin, "broke": live["events"] > 0, "failures": []}
    row["failures"], row["engine"] = judge(live, twin)
    row["seconds"] = time.perf_counter() - start
    return row


def judge(live: dict[str, Any], twin: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Compare a scene with its twin.

    Parameters
    ----------
    live, twin : dict
        What ``Stage.figures`` returned for both.

    Returns
    -------
    failures, engine : list of str
        The checks that only the breaking scene violates, and those that its twin violates as well.
    """
    failures: list[str] = []
    engine: list[str] = []
    for name in live["broken"]:
        (engine if name in twin["broken"] else failures).append(name)
    for name, limit in LIMITS.items():
        residual, of_twin = (figures["residuals"].get(name) for figures in (live, twin))
        if residual is not None and not residual <= limit:
            (engine if of_twin is not None and not of_twin <= limit else failures).append(name)
    return failures, engine


def _play(cell: Cell, strengths: Sequence[float] | None) -> tuple[dict[str, Any], list[float]]:
    """Play a cell once -> the figures, and the strengths at which its bodies would break."""
    stages: list[Stage] = []
    build = FAMILIES[cell.family][0]
    try:
        for _ in range(2 if cell.family == "worlds" else 1):
            stages.append(Stage(cell, strengths))
            build(stages[-1], cell, np.random.default_rng(cell.seed))
        for stage in stages:
            stage.begin()
        for _ in range(stages[0].steps):
            for stage in stages:
                stage.advance()
                if "nan" in stage.broken:
                    break
    except Exception as error:  # whatever a scene meets is a finding of this cell; the others go on
        stages[-1].broken["exception"] = f"{type(error).__name__}: {error}"
    finally:
        for stage in stages:
            stage.close()
    figures, *others = [stage.figures() for stage in stages]
    for further in others:
        for name, value in further["residuals"].items():
            if value is not None:
                figures["residuals"][name] = max(figures["residuals"][name], value)
        figures["broken"] |= further["broken"]
        if further["pieces"] != figures["pieces"]:
            figures["broken"]["worlds"] = "one scene in two worlds came to different ends"
    return figures, [] if strengths is not None else _strengths(stages[0])


def _strengths(stage: Stage) -> list[float]:
    """Find strengths in Pa, for each body: the impact that it took is ``severity`` times what just breaks it."""
    asset = asset_of(stage.cell)
    nominal = asset.material.tensile_strength
    strengths: list[float | None] = []
    for body in stage.bodies:
        impacts = stage.impacts.get(body)
        if impacts:
            hardest = max(impacts.values(), key=lambda hits: sum(hit.magnitude for hit in hits))
            strengths.append(nominal * _overload(asset, hardest) / stage.cell.severity)
        else:
            strengths.append(None)
    # What was not hit is as strong as the weakest that was: debris may break it.
    hit = [strength for strength in strengths if strength]
    default = min(hit) if hit and stage.cell.family == "matrix" else nominal
    return [strength or default for strength in strengths]


def _overload(asset: BreakableAsset, hits: Sequence[Impulse]) -> float:
    """Find how many times what just breaks the asset these hits are, to a fifth."""
    unit = asset.fracture(hits, skip_weak=False).severity
    low, high = SEVERITIES
    if not unit > 0.0:
        return 1.0

    def breaks(severity: float) -> bool:
        impacts = [hit.times(severity / unit) for hit in hits]
        return asset.may_break(impacts) and asset.fracture(impacts).broken

    for _ in range(HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if breaks(middle) else (middle, high)
    return unit / high


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Play the stress matrix.

    Parameters
    ----------
    quick : bool
        Whether to play a tenth of it.
    seed : int
        Of all random choices.
    progress : callable
        Called with the share done, from 0 to 1.

    Returns
    -------
    dict
        Plain data: the rows of all cells, and counts of them.
    """
    start = time.perf_counter()
    listed = all_cells(quick, seed)
    rows = []
    player = Player(run, judge)
    try:
        for index, cell in enumerate(listed):
            if time.perf_counter() - start > BUDGET:
                break
            rows.append(player.play(cell))
            progress((index + 1) / len(listed))
    finally:
        player.close()
    return {
        "quick": quick,
        "seed": seed,
        "limits": LIMITS,
        "cells": len(rows),
        "left": len(listed) - len(rows),
        "broke": sum(row["broke"] for row in rows),
        "failed": sum(bool(row["failures"]) for row in rows),
        "seconds": time.perf_counter() - start,
        "rows": rows,
    }
