"""Thousands of episodes with breaking in one process: memory, step time and handles, beside an unbreakable twin.

An episode puts an object into the world, hits it with a ball, lets what comes of it fly, and clears up: with
resetSimulation, as environments do, or by removing every body from a world that lives on. The two kinds of object take
turns block by block, so that whatever else the machine does falls on both.
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

SIZE = 0.3  # m
STEPS = 12  # an episode, after the hit
LIMITS = {"memory": 0.05, "step_time": 0.05}  # growth after the warm-up, beyond the twin's
BLOCKS = 40
PROBES = 12  # episodes after each block that are always the same, to time a step by
WARM = 0.2  # of the blocks


def _rss() -> float:
    """MB that the process holds now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _files() -> int:
    """Open files of the process, and shape files that were left behind."""
    folder = Path("/dev/shm")
    left = len(list(folder.glob(f"fracsim-{os.getpid()}-*"))) if folder.is_dir() else 0
    return len(os.listdir("/proc/self/fd")) + left


class _Episodes:
    """One kind of object in a client of its own."""

    def __init__(self, breakable: bool, reset: bool, seed: int) -> None:
        self.client = p.connect(p.DIRECT)
        self.reset = reset
        self.rng = np.random.default_rng(seed)
        self.assets: list[BreakableAsset] = []
        self.impulses = []
        for name in ("bunny", "chair", "vase"):
            asset = load(name).scaled(SIZE)
            self.impulses.append(asset.sample_impulses(64, seed))
            if not breakable:
                asset = asset.with_material(replace(asset.material, tensile_strength=1e15))
            self.assets.append(asset)
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=self.client)
        self.world = World(self.client)
        self.ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.03 * SIZE, physicsClientId=self.client)
        self.broken = self.pieces = 0

    def run(self) -> float:
        """An episode -> s of a step, the median of those after the hit."""
        client = self.client
        if self.reset:
            p.resetSimulation(physicsClientId=client)
            p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
            self.world = World(client)
            self.ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.03 * SIZE, physicsClientId=client)
        kind = int(self.rng.integers(len(self.assets)))
        asset = self.assets[kind]
        impulse = self.impulses[kind][int(self.rng.integers(64))]
        self.world.add(asset)
        start = impulse.point - (0.03 * SIZE + 1e-3 * SIZE) * impulse.direction
        ball = p.createMultiBody(asset.mass, self.ball, -1, start.tolist(), physicsClientId=client)
        speed = 2.0 * impulse.magnitude / asset.mass
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
        return float(np.median(times[-4:]))

    def probe(self, seed: int) -> float:
        """ms of a step, the mean over a few episodes that are the same each time."""
        kept, self.rng = self.rng, np.random.default_rng(seed)
        counts = self.broken, self.pieces
        times = [self.run() for _ in range(PROBES)]
        self.rng, (self.broken, self.pieces) = kept, counts
        return 1e3 * float(np.mean(times))

    def left_behind(self) -> dict[str, int]:
        """Bodies after the last episode, and the id that the next shape gets once everything is reset."""
        if self.reset:
            p.resetSimulation(physicsClientId=self.client)
        bodies = p.getNumBodies(physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=1.0, physicsClientId=self.client)
        return {"bodies": bodies, "next_shape": shape}


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Growth of memory and of step time over the blocks after the warm-up, for both kinds and both ways to clear up."""
    result: dict[str, Any] = {"limits": LIMITS, "modes": {}}
    modes = {"resetSimulation": (True, 400 if quick else 10000), "bodies removed": (False, 200 if quick else 2000)}
    whole = sum(count for _, count in modes.values())
    done = 0
    for name, (reset, count) in modes.items():
        kinds = {"breakable": _Episodes(True, reset, seed), "twin": _Episodes(False, reset, seed)}
        size = max(1, count // BLOCKS)
        memory: dict[str, list[float]] = {kind: [] for kind in kinds}
        step: dict[str, list[float]] = {kind: [] for kind in kinds}
        files = None
        for block in range(BLOCKS):
            for kind, episodes in kinds.items():
                before = _rss()
                for _ in range(size):
                    episodes.run()
                step[kind].append(episodes.probe(seed))
                gc.collect()
                memory[kind].append(_rss() - before)
            if block == int(WARM * BLOCKS):
                files, held = _files(), _rss()
            done += size
            progress(done / whole)
        warm = int(WARM * BLOCKS) + 1
        blocks = np.arange(warm, BLOCKS)
        drift = {}
        for kind, values in step.items():
            slope = float(theilslopes(values[warm:], blocks)[0]) * len(blocks)  # deaf to what else ran
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
            "files_more": _files() - (files or 0),
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
    lines = [
        "| cleared up by | episodes | breaks | pieces | memory, MB | growth (twin's) | step, ms (twin's) "
        "| drift (twin's) | files more | bodies left | next shape's id |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["modes"].items():
        left = row["left_behind"]["breakable"]
        held = row["holds"]
        lines.append(
            f"| {name} | {row['episodes']} | {row['breaks']} | {row['pieces']} | {row['memory_mb']:.0f} | "
            f"{row['memory_growth']['breakable']:.1%} ({row['memory_growth']['twin']:.1%}): "
            f"{'held' if held['memory'] else 'missed'} | "
            f"{row['step_ms']['breakable']:.3f} ({row['step_ms']['twin']:.3f}) | "
            f"{row['step_time_drift']['breakable']:.1%} ({row['step_time_drift']['twin']:.1%}): "
            f"{'held' if held['step_time'] else 'missed'} | {row['files_more']} | {left['bodies']} | "
            f"{left['next_shape']} |"
        )
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 2, figsize=(9, 5), sharex="col")
    for column, (name, row) in enumerate(figures["modes"].items()):
        episodes = np.arange(1, BLOCKS + 1) * row["episodes"] / BLOCKS
        for kind, style in (("breakable", "C1"), ("twin", "0.6")):
            axes[0, column].plot(episodes, np.cumsum(row["memory_by_block_mb"][kind]), color=style, label=kind)
            axes[1, column].plot(episodes, row["step_by_block_ms"][kind], color=style, label=kind)
        axes[0, column].set(title=name, ylabel="MB more than at the start")
        axes[1, column].set(xlabel="episodes", ylabel="ms a step", ylim=(0, None))
        axes[0, column].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
