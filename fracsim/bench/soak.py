"""Thousands of episodes with breaks in one process: ``fracsim bench soak``.

Memory, step time and handles are compared with a twin whose objects cannot break. An episode puts an object into the
world, hits it with a ball, lets the pieces fly, and clears up: with resetSimulation, as environments do, or by removing
every body from a world that lives on. The two kinds of object take turns block by block, so that whatever else the
machine does falls on both. Only the command line uses this module.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pybullet as p
from scipy.stats import theilslopes

from ..fracture.asset import BreakableAsset, load
from ..physics.world import World
from .picture import new_figure, save_figure

MESHES = ("bunny", "chair", "vase")
SIZE = 0.3  # m, the largest extent of the objects
UNBREAKABLE = 1e15  # Pa, a tensile strength that nothing exceeds
BALL_RADIUS = 0.03 * SIZE  # m
START_GAP = 1e-3 * SIZE  # m, between the ball and the object
IMPULSES = 64  # to each mesh, among which an episode draws one
STEPS = 12  # an episode
TIMED_STEPS = 4  # the last ones of an episode, when the hit is over
BLOCKS = 40  # the memory and the step time are read after each
PROBES = 12  # episodes after each block that are always the same, to time a step by
WARM_UP = 0.2  # of the blocks, which do not count: caches fill
EPISODES = {"resetSimulation": 10000, "bodies removed": 2000}  # by the way to clear up
QUICK_EPISODES = {"resetSimulation": 400, "bodies removed": 200}
LIMITS = {"memory": 0.05, "step_time": 0.05}  # growth after the warm-up, beyond the twin's, that the project promises


def _rss() -> float:
    """Read the memory that the process holds now, in MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _files() -> int:
    """Count the open files of the process, and shape files that were left behind."""
    folder = Path("/dev/shm")
    shapes = len(list(folder.glob(f"fracsim-{os.getpid()}-*"))) if folder.is_dir() else 0
    return len(os.listdir("/proc/self/fd")) + shapes


class _Episodes:
    """One kind of object in a client of its own."""

    def __init__(self, breakable: bool, reset: bool, seed: int) -> None:
        self.client = p.connect(p.DIRECT)
        self.reset = reset
        self.rng = np.random.default_rng(seed)
        self.assets: list[BreakableAsset] = []
        self.impulses = []
        for name in MESHES:
            asset = load(name).scaled(SIZE)
            self.impulses.append(asset.sample_impulses(IMPULSES, seed))
            if not breakable:
                asset = asset.with_material(replace(asset.material, tensile_strength=UNBREAKABLE))
            self.assets.append(asset)
        self._begin()
        self.broken = self.pieces = 0

    def _begin(self) -> None:
        """Set up an empty scene."""
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=self.client)
        self.world = World(self.client)
        self.ball = p.createCollisionShape(p.GEOM_SPHERE, radius=BALL_RADIUS, physicsClientId=self.client)

    def run(self) -> float:
        """Run an episode -> s of a step, the median of the last ones."""
        client = self.client
        if self.reset:
            p.resetSimulation(physicsClientId=client)
            self._begin()
        kind = int(self.rng.integers(len(self.assets)))
        asset = self.assets[kind]
        impulse = self.impulses[kind][int(self.rng.integers(IMPULSES))]
        self.world.add(asset)
        start = impulse.point - (BALL_RADIUS + START_GAP) * impulse.direction
        ball = p.createMultiBody(asset.mass, self.ball, -1, start.tolist(), physicsClientId=client)
        speed = 2.0 * impulse.magnitude / asset.mass  # of two bodies of the same mass
        p.resetBaseVelocity(ball, (speed * impulse.direction).tolist(), physicsClientId=client)
        times = []
        for _ in range(STEPS):
            begin = perf_counter()
            events = self.world.step()
            times.append(perf_counter() - begin)
            self.broken += len(events)
            self.pieces += sum(len(event.children) for event in events)
        if not self.reset:
            for body in (*self.world.bodies, *self.world.pieces):
                self.world.remove(body)
            p.removeBody(ball, physicsClientId=client)
        return float(np.median(times[-TIMED_STEPS:]))

    def probe(self, seed: int) -> float:
        """Time a few episodes that are always the same -> ms of a step, their mean."""
        rng, self.rng = self.rng, np.random.default_rng(seed)
        counts = self.broken, self.pieces
        times = [self.run() for _ in range(PROBES)]
        self.rng, (self.broken, self.pieces) = rng, counts
        return 1e3 * float(np.mean(times))

    def left_behind(self) -> dict[str, int]:
        """Count bodies after the last episode, and read the id that the next shape gets once everything is reset."""
        if self.reset:
            p.resetSimulation(physicsClientId=self.client)
        bodies = p.getNumBodies(physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=1.0, physicsClientId=self.client)
        return {"bodies": bodies, "next_shape": shape}


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Measure the growth of memory and of step time after the warm-up, for both kinds and both ways to clear up.

    Parameters
    ----------
    quick : bool
        Whether to run a twentieth of the episodes or so.
    seed : int
        Draws the objects and the hits.
    progress : callable
        Called with the share done, from 0 to 1.

    Returns
    -------
    dict
        Plain data.
    """
    result: dict[str, Any] = {"limits": LIMITS, "modes": {}}
    modes = QUICK_EPISODES if quick else EPISODES
    done = 0
    for name, count in modes.items():
        reset = name == "resetSimulation"
        kinds = {"breakable": _Episodes(True, reset, seed), "twin": _Episodes(False, reset, seed)}
        size = max(1, count // BLOCKS)
        warm = int(WARM_UP * BLOCKS) + 1
        memory: dict[str, list[float]] = {kind: [] for kind in kinds}
        step: dict[str, list[float]] = {kind: [] for kind in kinds}
        for block in range(BLOCKS):
            for kind, episodes in kinds.items():
                before = _rss()
                for _ in range(size):
                    episodes.run()
                step[kind].append(episodes.probe(seed))
                gc.collect()
                memory[kind].append(_rss() - before)
            if block == warm - 1:
                files, held = _files(), _rss()
            done += size
            progress(done / sum(modes.values()))
        blocks = np.arange(warm, BLOCKS)
        drift = {}
        for kind, values in step.items():
            # The median of the slopes of all pairs: what else ran for a while does not move it.
            slope = float(theilslopes(values[warm:], blocks)[0]) * len(blocks)
            drift[kind] = slope / float(np.median(values[warm:]))
        growth = {kind: float(sum(values[warm:])) / held for kind, values in memory.items()}
        result["modes"][name] = {
            "episodes": count,
            "breaks": kinds["breakable"].broken,
            "pieces": kinds["breakable"].pieces,
            "memory_mb": held,
            "memory_growth": growth,
            "memory_by_block_mb": memory,
            "step_ms": {kind: float(np.median(values)) for kind, values in step.items()},
            "step_by_block_ms": step,
            "step_time_drift": drift,
            "files_more": _files() - files,
            "left_behind": {kind: episodes.left_behind() for kind, episodes in kinds.items()},
            "holds": {
                "memory": growth["breakable"] - max(growth["twin"], 0.0) <= LIMITS["memory"],
                "step_time": drift["breakable"] - max(drift["twin"], 0.0) <= LIMITS["step_time"],
            },
        }
        for episodes in kinds.values():
            p.disconnect(episodes.client)
    return result


def table(figures: dict[str, Any]) -> str:
    """Write the figures as Markdown.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.

    Returns
    -------
    str
        A table with a row for each way to clear up.
    """
    lines = [
        "| cleared up by | episodes | breaks | pieces | memory, MB | growth (twin's) | step, ms (twin's) "
        "| drift (twin's) | files more | bodies left | next shape's id |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["modes"].items():
        remaining = row["left_behind"]["breakable"]
        holds = row["holds"]
        lines.append(
            f"| {name} | {row['episodes']} | {row['breaks']} | {row['pieces']} | {row['memory_mb']:.0f} | "
            f"{row['memory_growth']['breakable']:.1%} ({row['memory_growth']['twin']:.1%}): "
            f"{'held' if holds['memory'] else 'missed'} | "
            f"{row['step_ms']['breakable']:.3f} ({row['step_ms']['twin']:.3f}) | "
            f"{row['step_time_drift']['breakable']:.1%} ({row['step_time_drift']['twin']:.1%}): "
            f"{'held' if holds['step_time'] else 'missed'} | {row['files_more']} | {remaining['bodies']} | "
            f"{remaining['next_shape']} |"
        )
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw memory and step time over the episodes, a column for each way to clear up.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.
    path : Path
        The PNG file to write.
    """
    figure = new_figure(9, 5)
    axes = figure.subplots(2, 2, sharex="col")
    for column, (name, row) in enumerate(figures["modes"].items()):
        episodes = np.arange(1, BLOCKS + 1) * row["episodes"] / BLOCKS
        for kind, style in (("breakable", "C1"), ("twin", "0.6")):
            axes[0, column].plot(episodes, np.cumsum(row["memory_by_block_mb"][kind]), color=style, label=kind)
            axes[1, column].plot(episodes, row["step_by_block_ms"][kind], color=style, label=kind)
        axes[0, column].set(title=name, ylabel="MB more than at the start")
        axes[1, column].set(xlabel="episodes", ylabel="ms a step", ylim=(0, None))
        axes[0, column].legend(frameon=False, fontsize=8)
    save_figure(figure, path)
