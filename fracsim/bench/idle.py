"""What watching costs while nothing breaks: a world's step beside the engine's own, on twin scenes in one run.

Two clients hold the same scene and are stepped in turn, one by ``World.step``, one by ``stepSimulation``; engine calls
are counted in a run of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt
import pybullet as p
import pybullet_data

from ..fracture.asset import BreakableAsset, load
from ..physics.world import World

RATE = 240  # Hz
LIMITS = {  # µs a step, or the ratio
    "one, touched and awake": 5.0,
    "one, in flight": 5.0,
    "ten, touched and awake": 40.0,
    "ten, asleep": 5.0,
    "Franka arm and ten objects": 1.05,
}


def _unbreakable(name: str, size: float) -> BreakableAsset:
    asset = load(name)
    return asset.scaled(size / asset.size).with_material(replace(asset.material, tensile_strength=1e15))


class Twin:
    """A scene made twice, watched in one client and not in the other."""

    def __init__(self, build: Callable[[int, World], Callable[[], None]]) -> None:
        self.watched, self.bare = p.connect(p.DIRECT), p.connect(p.DIRECT)
        worlds = []
        self.moves = []
        for client in (self.watched, self.bare):
            p.setTimeStep(1 / RATE, physicsClientId=client)
            world = World(client)
            self.moves.append(build(client, world))
            worlds.append(world)
        self.world = worlds[0]

    def step(self, swapped: bool) -> tuple[float, float]:
        """Step both -> s of the watched, s of the bare."""
        times = [0.0, 0.0]
        for side in (1, 0) if swapped else (0, 1):
            self.moves[side]()
            begin = perf_counter()
            if side == 0:
                self.world.step()
            else:
                p.stepSimulation(physicsClientId=self.bare)
            times[side] = perf_counter() - begin
        return times[0], times[1]

    def close(self) -> None:
        p.disconnect(self.watched)
        p.disconnect(self.bare)


def _floor(client: int, friction: float) -> None:
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    floor = p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client), physicsClientId=client)
    p.changeDynamics(floor, -1, lateralFriction=friction, physicsClientId=client)


def _lying(count: int, speed: float) -> Callable[[int, World], Callable[[], None]]:
    """Objects that lie on the floor or, at a speed, slide on it without friction."""

    def build(client: int, world: World) -> Callable[[], None]:
        _floor(client, 0.0 if speed else 1.0)
        asset = _unbreakable("bunny", 0.3)
        low = asset.vertices[:, 2].min()
        bodies = [world.add(asset, (0.5 * k, 0, 1e-3 - low), linear_damping=0.0) for k in range(count)]
        for _ in range(480):
            p.stepSimulation(physicsClientId=client)
        for body in bodies:
            p.resetBaseVelocity(body, (0, speed, 0), (0, 0, 0), physicsClientId=client)
        return lambda: None

    return build


def _flying(client: int, world: World) -> Callable[[], None]:
    _floor(client, 1.0)
    p.setGravity(0, 0, 0, physicsClientId=client)
    world.add(_unbreakable("bunny", 0.3), (0, 0, 3), linear_velocity=(1, 0, 0), angular_velocity=(1, 2, 3))
    return lambda: None


def _franka(client: int, world: World) -> Callable[[], None]:
    """An arm that reaches over a table among ten objects of 10 cm."""
    _floor(client, 1.0)
    p.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=client)
    p.loadURDF("table/table.urdf", (0.5, 0, -0.625), physicsClientId=client)
    arm = p.loadURDF("franka_panda/panda.urdf", useFixedBase=True, physicsClientId=client)
    names = ("bunny", "chair", "vase")
    for k in range(10):
        asset = _unbreakable(names[k % 3], 0.1)
        place = (0.3 + 0.12 * (k % 5), -0.3 + 0.6 * (k // 5), 1e-3 - asset.vertices[:, 2].min())
        world.add(asset, place)
    home = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8])
    now = [0.0]

    def move() -> None:
        now[0] += 1 / RATE
        target = home + 0.3 * np.sin(2 * np.pi * 0.5 * now[0] + np.arange(7))
        p.setJointMotorControlArray(arm, range(7), p.POSITION_CONTROL, target.tolist(), physicsClientId=client)

    for _ in range(480):
        move()
        p.stepSimulation(physicsClientId=client)
    return move


SCENES: dict[str, Callable[[int, World], Callable[[], None]]] = {
    "one, touched and awake": _lying(1, 1.0),
    "one, in flight": _flying,
    "ten, touched and awake": _lying(10, 1.0),
    "ten, asleep": _lying(10, 0.0),
    "Franka arm and ten objects": _franka,
}


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Count the calls of the engine by name."""
    calls: Counter[str] = Counter()
    kept = {}

    def wrap(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*arguments: Any, **keywords: Any) -> Any:
            calls[name] += 1
            return call(*arguments, **keywords)

        return counting

    for name in dir(p):
        call = getattr(p, name)
        if callable(call) and not name.startswith("_") and not isinstance(call, type):
            kept[name] = call
            setattr(p, name, wrap(name, call))
    try:
        yield calls
    finally:
        for name, call in kept.items():
            setattr(p, name, call)


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Figures a scene: µs a step of both, what the same step takes more and times as long, and engine calls a step.

    In several rounds with twins of their own, since how long the same step takes differs between two clients as well;
    ratios are the medians of the rounds'.
    """
    steps, rounds = (480, 1) if quick else (2400, 7)
    result: dict[str, Any] = {"steps": steps, "rounds": rounds, "rate": RATE, "scenes": {}}
    random = np.random.default_rng(seed)
    for done, (name, build) in enumerate(SCENES.items()):
        times = 1e6 * np.array([_round(build, random.random(steps) < 0.5) for _ in range(rounds)])  # (rounds, steps, 2)
        calls = _calls(build)
        extra = times[..., 0] - times[..., 1]
        medians = np.median(times, axis=1)
        ratios = np.median(times[..., 0] / times[..., 1], axis=1)
        totals = times.sum(axis=1)
        limit = LIMITS[name]
        figures: dict[str, Any] = {
            "bare_us": float(np.median(medians[:, 1])),
            "watched_us": float(np.median(medians[:, 0])),
            "extra_us_median": float(np.median(extra)),
            "extra_us_p99": float(np.quantile(extra, 0.99)),
            "ratio_of_pairs": float(np.median(ratios)),
            "ratios_of_pairs": ratios.tolist(),
            "ratio_of_medians": float(np.median(medians[:, 0] / medians[:, 1])),
            "ratio_of_totals": float(np.median(totals[:, 0] / totals[:, 1])),
            "calls_a_step": calls,
            "limit": limit,
        }
        judged = figures["ratio_of_pairs"] if limit < 2.0 else figures["extra_us_median"]
        figures["holds"] = bool(judged <= limit)
        result["scenes"][name] = figures
        progress((done + 1) / len(SCENES))
    return result


def _round(build: Callable[[int, World], Callable[[], None]], swapped: npt.NDArray[np.bool_]) -> list[Any]:
    """(steps, 2) s of the watched and of the bare step."""
    twin = Twin(build)
    for k in range(60):
        twin.step(bool(k % 2))
    times = [twin.step(bool(swap)) for swap in swapped]
    twin.close()
    return times


def _calls(build: Callable[[int, World], Callable[[], None]]) -> dict[str, float]:
    """The world's calls of the engine in a step, by name, over two seconds."""
    twin = Twin(build)
    for _ in range(60):
        twin.step(False)
    total: Counter[str] = Counter()
    for _ in range(2 * RATE):
        twin.moves[0]()
        with counted() as calls:
            twin.world.step()
        total += calls
    twin.close()
    return {name: count / (2 * RATE) for name, count in sorted(total.items())}


def table(figures: dict[str, Any]) -> str:
    lines = [
        "| scene | stepSimulation, µs | World.step, µs | more, median µs | p99 | ratio of a pair, median "
        "(rounds) | of medians | of totals | engine calls a step | limit |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["scenes"].items():
        calls = sum(row["calls_a_step"].values()) - 1.0
        unit = "" if row["limit"] < 2.0 else " µs"
        ratios = row["ratios_of_pairs"]
        lines.append(
            f"| {name} | {row['bare_us']:.1f} | {row['watched_us']:.1f} | {row['extra_us_median']:.1f} | "
            f"{row['extra_us_p99']:.1f} | {row['ratio_of_pairs']:.3f} ({min(ratios):.3f} to {max(ratios):.3f}) | "
            f"{row['ratio_of_medians']:.3f} | {row['ratio_of_totals']:.3f} | {calls:.2f} | "
            f"{row['limit']:g}{unit}: {'held' if row['holds'] else 'missed'} |"
        )
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = figures["scenes"]
    figure, axes = pyplot.subplots(figsize=(7, 3.2))
    place = np.arange(len(scenes))
    bare = [row["bare_us"] for row in scenes.values()]
    extra = [max(row["extra_us_median"], 0.0) for row in scenes.values()]
    axes.barh(place, bare, color="0.75", label="stepSimulation")
    axes.barh(place, extra, left=bare, color="C1", label="World.step beyond it")
    for k, row in enumerate(scenes.values()):
        axes.annotate(
            f" +{row['extra_us_median']:.1f} µs", (bare[k] + extra[k], k), va="center", fontsize=9, color="C1"
        )
    axes.set_yticks(place, list(scenes))
    axes.invert_yaxis()
    axes.set(xlabel="µs a step, median", xlim=(0, 1.25 * max(bare)))
    axes.legend(loc="upper right", frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
