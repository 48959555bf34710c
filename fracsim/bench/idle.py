"""What watching costs while nothing breaks: ``fracsim bench idle``.

Two clients hold the same scene and are stepped in turn, one by ``World.step``, one by ``stepSimulation``. Calls of the
engine are counted in a run of their own. Only the command line uses this module.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pybullet as p
import pybullet_data

from ..common.arrays import BoolArray
from ..fracture.asset import BreakableAsset, load
from ..physics.world import World
from .picture import new_figure, save_figure

Move = Callable[[], None]  # what a scene does before each step
Build = Callable[[int, World], Move]  # puts a scene into a client and its world

RATE = 240  # Hz, the steps of the simulation
STEPS, QUICK_STEPS = 2400, 480  # of a round
ROUNDS, QUICK_ROUNDS = 7, 1
WARM_STEPS = 60  # before the times count
SETTLING_STEPS = 480  # in which objects come to lie
COUNTED_STEPS = 2 * RATE  # in which the calls of the engine are counted
UNBREAKABLE = 1e15  # Pa, a tensile strength that nothing exceeds
RATIO = 2.0  # a limit below it is one of times as long, any other of µs more
LIMITS = {  # what the project promises: µs that a step takes more, or times as long
    "one, touched and awake": 5.0,
    "one, in flight": 5.0,
    "ten, touched and awake": 40.0,
    "ten, asleep": 5.0,
    "Franka arm and ten objects": 1.05,
}


def _unbreakable(name: str, size: float) -> BreakableAsset:
    """Load a shipped asset at a size in m, too strong to break."""
    asset = load(name)
    return asset.scaled(size / asset.size).with_material(replace(asset.material, tensile_strength=UNBREAKABLE))


class Twin:
    """A scene made twice, watched in one client and not in the other.

    Parameters
    ----------
    build : callable
        Puts the scene into a client and its world, and returns what moves in it before each step.

    Attributes
    ----------
    watched, bare : int
        The two clients; the scene in ``bare`` is stepped by the engine alone.
    world : World
        Of the client ``watched``.
    moves : list of callable
        What the scene does before each step, in ``watched`` and in ``bare``.
    """

    def __init__(self, build: Build) -> None:
        self.watched, self.bare = p.connect(p.DIRECT), p.connect(p.DIRECT)
        worlds = []
        self.moves: list[Move] = []
        for client in (self.watched, self.bare):
            p.setTimeStep(1 / RATE, physicsClientId=client)
            world = World(client)
            self.moves.append(build(client, world))
            worlds.append(world)
        self.world = worlds[0]

    def step(self, bare_first: bool) -> tuple[float, float]:
        """Step both.

        Parameters
        ----------
        bare_first : bool
            Which of the two begins.

        Returns
        -------
        watched, bare : float
            Seconds that the step took.
        """
        times = [0.0, 0.0]
        for side in (1, 0) if bare_first else (0, 1):
            self.moves[side]()
            begin = perf_counter()
            if side == 0:
                self.world.step()
            else:
                p.stepSimulation(physicsClientId=self.bare)
            times[side] = perf_counter() - begin
        return times[0], times[1]

    def close(self) -> None:
        """Disconnect both clients."""
        p.disconnect(self.watched)
        p.disconnect(self.bare)


def _floor(client: int, friction: float) -> None:
    """Add a floor and gravity."""
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    floor = p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client), physicsClientId=client)
    p.changeDynamics(floor, -1, lateralFriction=friction, physicsClientId=client)


def _lying(count: int, speed: float) -> Build:
    """Put objects on the floor, at rest or sliding at a speed in m/s without friction."""

    def build(client: int, world: World) -> Move:
        _floor(client, 0.0 if speed else 1.0)
        asset = _unbreakable("bunny", 0.3)
        low = asset.vertices[:, 2].min()
        bodies = [world.add(asset, (0.5 * k, 0, 1e-3 - low), linear_damping=0.0) for k in range(count)]
        for _ in range(SETTLING_STEPS):
            p.stepSimulation(physicsClientId=client)
        for body in bodies:
            p.resetBaseVelocity(body, (0, speed, 0), (0, 0, 0), physicsClientId=client)
        return lambda: None

    return build


def _flying(client: int, world: World) -> Move:
    """Put one object into free flight, without gravity."""
    _floor(client, 1.0)
    p.setGravity(0, 0, 0, physicsClientId=client)
    world.add(_unbreakable("bunny", 0.3), (0, 0, 3), linear_velocity=(1, 0, 0), angular_velocity=(1, 2, 3))
    return lambda: None


def _franka(client: int, world: World) -> Move:
    """Let an arm reach over a table among ten objects of 10 cm."""
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
    ticks = itertools.count(1)

    def move() -> None:
        time = next(ticks) / RATE
        target = home + 0.3 * np.sin(2 * np.pi * 0.5 * time + np.arange(7))  # rad, each joint with a phase of its own
        p.setJointMotorControlArray(arm, range(7), p.POSITION_CONTROL, target.tolist(), physicsClientId=client)

    for _ in range(SETTLING_STEPS):
        move()
        p.stepSimulation(physicsClientId=client)
    return move


SCENES: dict[str, Build] = {
    "one, touched and awake": _lying(1, 1.0),
    "one, in flight": _flying,
    "ten, touched and awake": _lying(10, 1.0),
    "ten, asleep": _lying(10, 0.0),
    "Franka arm and ten objects": _franka,
}


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Count the calls of the engine by name.

    Yields
    ------
    Counter of str
        The calls so far, by the name of PyBullet's function.
    """
    calls: Counter[str] = Counter()
    originals = {}

    def wrap(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*arguments: Any, **keywords: Any) -> Any:
            calls[name] += 1
            return call(*arguments, **keywords)

        return counting

    for name in dir(p):
        call = getattr(p, name)
        if callable(call) and not name.startswith("_") and not isinstance(call, type):
            originals[name] = call
            setattr(p, name, wrap(name, call))
    try:
        yield calls
    finally:
        for name, call in originals.items():
            setattr(p, name, call)


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Measure each scene.

    There are several rounds with twins of their own, since how long the same step takes differs between two clients,
    too. Ratios are the medians over the rounds.

    Parameters
    ----------
    quick : bool
        Whether to measure one short round.
    seed : int
        Draws which of the two clients is stepped first.
    progress : callable
        Called with the share done, from 0 to 1.

    Returns
    -------
    dict
        Plain data. For each scene: µs of a step of both, what the same step takes more and how many times as long, and
        calls of the engine in a step.
    """
    steps, rounds = (QUICK_STEPS, QUICK_ROUNDS) if quick else (STEPS, ROUNDS)
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
        judged = figures["ratio_of_pairs"] if limit < RATIO else figures["extra_us_median"]
        figures["holds"] = bool(judged <= limit)
        result["scenes"][name] = figures
        progress((done + 1) / len(SCENES))
    return result


def _round(build: Build, bare_first: BoolArray) -> list[tuple[float, float]]:
    """Time a new twin's steps -> (steps, 2) s of the watched and of the bare one."""
    twin = Twin(build)
    for number in range(WARM_STEPS):
        twin.step(bool(number % 2))
    times = [twin.step(bool(first)) for first in bare_first]
    twin.close()
    return times


def _calls(build: Build) -> dict[str, float]:
    """Count the world's calls of the engine in a step, by name."""
    twin = Twin(build)
    for _ in range(WARM_STEPS):
        twin.step(False)
    total: Counter[str] = Counter()
    for _ in range(COUNTED_STEPS):
        twin.moves[0]()
        with counted() as calls:
            twin.world.step()
        total += calls
    twin.close()
    return {name: count / COUNTED_STEPS for name, count in sorted(total.items())}


def table(figures: dict[str, Any]) -> str:
    """Write the figures as Markdown.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.

    Returns
    -------
    str
        A table with a row for each scene.
    """
    lines = [
        "| scene | stepSimulation, µs | World.step, µs | more, median µs | p99 | ratio of a pair, median "
        "(rounds) | of medians | of totals | engine calls a step | limit |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["scenes"].items():
        calls = sum(row["calls_a_step"].values()) - 1.0  # beside stepSimulation itself
        unit = "" if row["limit"] < RATIO else " µs"
        ratios = row["ratios_of_pairs"]
        lines.append(
            f"| {name} | {row['bare_us']:.1f} | {row['watched_us']:.1f} | {row['extra_us_median']:.1f} | "
            f"{row['extra_us_p99']:.1f} | {row['ratio_of_pairs']:.3f} ({min(ratios):.3f} to {max(ratios):.3f}) | "
            f"{row['ratio_of_medians']:.3f} | {row['ratio_of_totals']:.3f} | {calls:.2f} | "
            f"{row['limit']:g}{unit}: {'held' if row['holds'] else 'missed'} |"
        )
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw a bar for each scene: the engine's own step, and what the world takes beyond it.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.
    path : Path
        The PNG file to write.
    """
    scenes = figures["scenes"]
    figure = new_figure(7, 3.2)
    axes = figure.subplots()
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
    save_figure(figure, path)
