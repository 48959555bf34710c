"""The stress matrix: what a break must keep, checked wherever somebody might break something.

A cell is one small scene: bodies, and what meets them how. It is played twice, first as a twin whose bodies cannot
break, then with bodies whose strength is set so that the impact the twin took is `severity` times what just breaks them.
What the twin violates too is the engine's doing; a cell fails only by what breaking adds.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from ...common.impulse import Impulse
from ...fracture.asset import BreakableAsset
from .scenes import FAMILIES
from .stage import COUNTS, LIMITS, MESHES, RANGES, SHARES, Cell, Row, Stage, asset_named

PATIENCE = 60.0  # s, after which a cell counts as hung; the table says what the slowest takes
BUDGET = 540.0  # s, after which no further cell is begun


# A cell


def run(cell: Cell, tell: Callable[[str], object] = lambda phase: None) -> Row:
    """Play a cell and its twin -> what held and what did not; tell: called with what begins."""
    start = time.perf_counter()
    tell("twin")
    twin, strengths = _play(cell, None)
    tell("breaking")
    live, _ = _play(cell, strengths)
    row: Row = {"cell": asdict(cell), "live": live, "twin": twin, "broke": live["events"] > 0, "failures": []}
    row["failures"], row["engine"] = _judge(live, twin)
    row["seconds"] = time.perf_counter() - start
    return row


def _judge(live: dict[str, Any], twin: dict[str, Any]) -> tuple[list[str], list[str]]:
    """The checks that only the breaking scene violates, and those that its twin violates as well."""
    failures: list[str] = []
    engine: list[str] = []
    for name in live["broken"]:
        (engine if name in twin["broken"] else failures).append(name)
    for name, limit in LIMITS.items():
        found, other = (figures["residuals"].get(name) for figures in (live, twin))
        if found is not None and not found <= limit:
            (engine if other is not None and not other <= limit else failures).append(name)
    return failures, engine


def _play(cell: Cell, strengths: Sequence[float] | None) -> tuple[dict[str, Any], list[float]]:
    """Play a cell once -> the figures, and what strengths would make its bodies break."""
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
    except Exception as error:
        stages[-1].broken["exception"] = f"{type(error).__name__}: {error}"
    finally:
        for stage in stages:
            stage.close()
    found = [stage.figures() for stage in stages]
    figures = found[0]
    for further in found[1:]:
        for name, value in further["residuals"].items():
            if value is not None:
                figures["residuals"][name] = max(figures["residuals"][name], value)
        figures["broken"] |= further["broken"]
        if further["pieces"] != figures["pieces"]:
            figures["broken"]["worlds"] = "one scene in two worlds came to different ends"
    return figures, [] if strengths is not None else _strengths(stages[0])


def _strengths(stage: Stage) -> list[float]:
    """Pa, for each body: the impact that it took is `severity` times what just breaks it."""
    nominal = asset_named(stage.cell.mesh).material.tensile_strength
    asset = asset_named(stage.cell.mesh).scaled(stage.cell.size / asset_named(stage.cell.mesh).size)
    found: list[float | None] = []
    for body in stage.bodies:
        impacts = stage.impacts.get(body)
        if impacts:
            hardest = max(impacts.values(), key=lambda hits: sum(hit.magnitude for hit in hits))
            found.append(nominal * _overload(asset, hardest) / stage.cell.severity)
        else:
            found.append(None)
    # What was not hit is as strong as the weakest that was: debris may break it.
    hit = [strength for strength in found if strength]
    default = min(hit) if hit and stage.cell.family == "matrix" else nominal
    return [strength or default for strength in found]


def _overload(asset: BreakableAsset, hits: Sequence[Impulse]) -> float:
    """How many times what just breaks the asset these hits are, to a fifth."""
    unit = sum(hit.magnitude for hit in hits) / (asset.mass * asset.material.breaking_velocity)
    low, high = 0.2, 90.0  # total severity
    if not unit > 0.0:
        return 1.0

    def breaks(severity: float) -> bool:
        impacts = [Impulse(hit.point, hit.direction, hit.magnitude * severity / unit) for hit in hits]
        return asset.may_break(impacts) and asset.fracture(impacts).broken

    for _ in range(5):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if breaks(middle) else (middle, high)
    return unit / high


# The matrix


def cells(quick: bool, seed: int) -> list[Cell]:
    """The whole stress matrix: each family, the corners and ends of the axes, and what lies between."""
    rng = np.random.default_rng(seed)
    names = tuple(RANGES)[:4]
    middle = dict(zip(names, (1 / 240, 5.0, 1.0, 0.3), strict=True))
    chosen: list[dict[str, Any]] = [
        {name: RANGES[name][corner >> k & 1] for k, name in enumerate(names)}
        for corner in range(0, 16, 3 if quick else 1)
    ]
    if not quick:
        chosen += [middle | {name: end} for name in names for end in RANGES[name]]
        chosen += [middle | {"breakables": count} for count in COUNTS]
    listed = [
        cell
        for name, (_, variants) in FAMILIES.items()
        if name != "matrix"
        for cell in _family(name, variants, max(1, variants // 2) if quick else max(8, 3 * variants), rng)
    ]
    for i, axes in enumerate(chosen + _spread(24 if quick else 400, rng)):
        drawn = int(rng.integers(2**31))
        if quick:  # crowds take their time
            axes |= {"breakables": min(axes.get("breakables", 1), COUNTS[1])}
        scene = {"breakables": 1, "other": ("ball", "box")[i // 3 % 2], "severity": 4.0, **axes}
        listed.append(Cell(family="matrix", mesh=MESHES[i % 3], variant=0, seed=drawn, **scene))
    return listed


def _spread(count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Latin hypercube over the axes."""
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
    """Scenes of one family, over the axes and its variants."""
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


class _Player:
    """A process that plays cells, so that a crash of the engine is a cell's failure and not the end of the run."""

    def __init__(self) -> None:
        handle, self._trace = tempfile.mkstemp(prefix="fracsim-stability-", suffix=".txt")
        os.close(handle)
        self._start()

    def _start(self) -> None:
        context = get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._trace), daemon=True)
        self._process.start()
        theirs.close()

    def play(self, cell: Cell) -> Row:
        """Play a cell; when the process dies or does not come back, that is what is found."""
        start, phase = time.perf_counter(), "twin"
        try:
            self._ours.send(cell)
            while self._ours.poll(PATIENCE):
                answer = self._ours.recv()
                if not isinstance(answer, str):
                    found: Row = answer
                    return found
                phase = answer
            kind, what = "hang", f"no answer within {PATIENCE:g} s"
        except (EOFError, OSError):
            self._process.join(5.0)
            code = self._process.exitcode or 0
            kind, what = "crash", f"{signal.Signals(-code).name if code < 0 else f'exit {code}'}{self._place()}"
        self.stop()
        self._start()
        nothing: dict[str, Any] = {"residuals": {}, "broken": {kind: what}, "notes": [], "events": 0, "pieces": 0}
        whole = {**nothing, "broken": {} if phase == "breaking" else {kind: what}}
        failures, engine = _judge(nothing, whole)
        return {
            "cell": asdict(cell),
            "live": nothing,
            "twin": whole,
            "broke": False,
            "failures": failures,
            "engine": engine,
            "seconds": time.perf_counter() - start,
        }

    def _place(self) -> str:
        """Where Python was when it crashed."""
        lines = Path(self._trace).read_text().splitlines()
        Path(self._trace).write_text("")
        return "".join(f", {line.strip()}" for line in lines if line.startswith("  File"))[:500]

    def stop(self) -> None:
        self._process.kill()
        self._process.join()
        self._ours.close()

    def close(self) -> None:
        self.stop()
        os.unlink(self._trace)


def _serve(connection: Connection, trace: str) -> None:
    """The process's side: answer each cell with its row."""
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)  # the engine prints what it thinks
    with open(trace, "a") as file:
        faulthandler.enable(file)
        while True:
            try:
                cell = connection.recv()
            except EOFError:
                return
            connection.send(run(cell, connection.send))


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Play the stress matrix -> its rows. quick: a tenth of it. progress: called with the share done."""
    start = time.perf_counter()
    listed = cells(quick, seed)
    rows = []
    player = _Player()
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
