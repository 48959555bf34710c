"""How much of a break is the time step's doing: critical drop heights, which pieces, and where they fly.

The lowest height from which a landing breaks an object is sought by bisection, in a fall over both a long and a short
time step; at twice that height the pieces are compared. The objects are as strong as makes that half a metre or so.
Trajectories after a break, at the strength that they have, are held against those of a much shorter step, beside what a
simulated second costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt
import pybullet as p

from ..common.arrays import FloatArray
from ..fracture.asset import BreakableAsset, load
from ..metrics import ari
from ..physics.events import FractureEvent
from ..physics.world import World

# How many times as strong as it is: so weak a thing as the chair would break from where a fall is hardly a hit.
STRENGTH = {"bunny": 2.5, "chair": 8.0, "vase": 1.0}
MESHES = tuple(STRENGTH)
SIZE = 0.3  # m
GRAVITY = 9.81
RATES = (120, 960)  # Hz, whose critical heights are compared
FLIGHTS = (60, 120, 240, 480, 960, 1920)
REFERENCE = 7680
LANDING = 0.03  # s after the first contact: what breaks later is another fall
RANGE = (0.01, 30.0)  # m, of heights; from lower ones the gate of a long step hides hits
AFTER = 0.1  # s after the first contact, when trajectories are compared


class Fall:
    """An asset over a floor, about to land as if from a height, at a rate."""

    def __init__(self, client: int, asset: BreakableAsset, turn: FloatArray, height: float, rate: int) -> None:
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=client)
        p.setTimeStep(1 / rate, physicsClientId=client)
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        floor = p.createMultiBody(0, plane, physicsClientId=client)
        p.changeDynamics(floor, -1, restitution=1.0, lateralFriction=1.0, physicsClientId=client)
        self.world, self.asset = World(client), asset
        rotation = np.reshape(p.getMatrixFromQuaternion(turn.tolist()), (3, 3))
        low = float((asset.vertices @ rotation[2]).min())
        gap = min(height, 0.02)
        # The engine's velocity is half a step behind its places, as in a leapfrog.
        speed = max(np.sqrt(2 * GRAVITY * (height - gap)) - 0.5 * GRAVITY / rate, 0.0)
        self.world.add(
            asset, (0, 0, gap - low), turn, (0, 0, -speed), linear_damping=0.0, angular_damping=0.0
        )  # fmt: skip
        self.hits: list[float] = []
        self.world.on_contact(lambda _: self.hits.append(self.world.time))

    def land(self) -> FractureEvent | None:
        """What breaks in the landing."""
        while self.world.time < 2.0 and not (self.hits and self.world.time > self.hits[0] + LANDING):
            events = self.world.step()
            if events:
                return events[0]
        return None


def strengthened(asset: BreakableAsset, factor: float) -> BreakableAsset:
    return asset.with_material(replace(asset.material, tensile_strength=factor * asset.material.tensile_strength))


def critical_height(client: int, asset: BreakableAsset, turn: FloatArray, rate: int, halvings: int = 11) -> float:
    """m, by bisection of its logarithm; an end of RANGE, to the digit, where it lies beyond."""
    low, high = ends = tuple(np.log(RANGE))
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        if Fall(client, asset, turn, float(np.exp(middle)), rate).land() is None:
            low = middle
        else:
            high = middle
    if low == ends[0]:
        return RANGE[0]
    return RANGE[1] if high == ends[1] else float(np.exp(0.5 * (low + high)))


def beyond_range(heights: FloatArray) -> npt.NDArray[np.bool_]:
    """(landings,) those that are beyond the same end of RANGE at both rates, which says nothing of a ratio."""
    return (heights[:, 0] == heights[:, 1]) & np.isin(heights[:, 0], RANGE)


def compared(heights: FloatArray) -> dict[str, Any]:
    """What the heights (landings, 2) at both rates say of one another. One that is beyond RANGE at one rate only
    counts as its end."""
    beyond = beyond_range(heights)
    found = heights[~beyond]
    ratio = found[:, 0] / found[:, 1]
    return {
        "beyond": int(beyond.sum()),
        "mean_height": np.exp(np.log(found).mean(axis=0)).tolist(),
        "ratio_median": float(np.median(ratio)),
        "ratio_mean": float(np.exp(np.log(ratio).mean())),
        "ratio_range": [float(ratio.min()), float(ratio.max())],
        "within_10_percent": float((np.abs(ratio - 1) <= 0.1).mean()),
    }


def flight(client: int, asset: BreakableAsset, turn: FloatArray, height: float, rate: int) -> tuple[FloatArray, float]:
    """(A, 3) where the atoms are AFTER the first contact, and s of computing that the simulated time took."""
    fall = Fall(client, asset, turn, height, rate)
    atoms = asset.arrays.moments[1] / asset.arrays.moments[0][:, None] * asset.scale + asset.offset
    owner = {body: np.arange(len(atoms)) for body in fall.world.bodies}
    begin = perf_counter()
    steps = 0
    while not (fall.hits and fall.world.time > fall.hits[0] + AFTER) and fall.world.time < 2.0:
        steps += 1
        for event in fall.world.step():
            del owner[event.parent]
            owner |= {
                child: piece.atoms for child, piece in zip(event.children, event.fracture.pieces, strict=True)
            }  # fmt: skip
    spent = (perf_counter() - begin) / (steps / rate)
    places = np.zeros_like(atoms)
    for body, rows in owner.items():
        position, quaternion = fall.world.pose(body)
        rotation = np.reshape(p.getMatrixFromQuaternion(quaternion.tolist()), (3, 3))
        places[rows] = atoms[rows] @ rotation.T + position
    return places, spent


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Heights, agreement and trajectories, a mesh and an orientation each."""
    count, flights = (2, 1) if quick else (24, 6)
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    turns[0] = (0, 0, 0, 1)  # upright, the flattest landing
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    client = p.connect(p.DIRECT)
    result: dict[str, Any] = {"rates": RATES, "size": SIZE, "range": RANGE, "meshes": {}, "flights": {}}
    total, done = len(MESHES) * (count + flights), 0
    for name in MESHES:
        asset = load(name).scaled(SIZE)
        strong = strengthened(asset, STRENGTH[name])
        heights, agreement = [], []
        for turn in turns:
            pair = [critical_height(client, strong, turn, rate) for rate in RATES]
            events = [Fall(client, strong, turn, 2 * max(pair), rate).land() for rate in RATES]
            whole = asset.unbroken().labels
            labels = [whole if event is None else event.fracture.labels for event in events]
            heights.append(pair)
            agreement.append(float(ari(labels[0], labels[1])))
            done += 1
            progress(done / total)
        result["meshes"][name] = {
            "strength": STRENGTH[name],
            "heights": heights,
            "ari": agreement,
            **compared(np.array(heights)),
            "ari_0.9": float((np.array(agreement) >= 0.9).mean()),
        }
        errors: dict[int, list[float]] = {rate: [] for rate in FLIGHTS}
        costs: dict[int, list[float]] = {rate: [] for rate in FLIGHTS}
        for turn in turns[:flights]:
            exact, _ = flight(client, asset, turn, 1.0, REFERENCE // (8 if quick else 1))
            weight = asset.arrays.moments[0] / asset.arrays.moments[0].sum()
            for rate in FLIGHTS:
                places, spent = flight(client, asset, turn, 1.0, rate)
                errors[rate].append(float(np.sqrt(weight @ ((places - exact) ** 2).sum(axis=1)) / SIZE))
                costs[rate].append(spent)
            done += 1
            progress(done / total)
        result["flights"][name] = {
            str(rate): {
                "error_median": float(np.median(errors[rate])),
                "error_worst": float(max(errors[rate])),
                "seconds_a_simulated_second": float(np.median(costs[rate])),
            }
            for rate in FLIGHTS
        }
    p.disconnect(client)
    return result


def table(figures: dict[str, Any]) -> str:
    (slow, fast), (low, high) = figures["rates"], figures["range"]
    lines = [
        f"| mesh | strength | landings | beyond {low:g} to {high:g} m at both | critical height at 1/{slow} s and "
        f"1/{fast} s, m, geometric mean | ratio, median | geometric mean | least to most | within 10 % | "
        "same pieces at twice the height (ARI ≥ 0.9) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["meshes"].items():
        least, most = row["ratio_range"]
        lines.append(
            f"| {name} | {row['strength']:g}x | {len(row['heights'])} | {row['beyond']} | "
            f"{row['mean_height'][0]:.3f}, {row['mean_height'][1]:.3f} | **{row['ratio_median']:.3f}** | "
            f"{row['ratio_mean']:.3f} | {least:.2f} to {most:.2f} | {row['within_10_percent']:.0%} | "
            f"{row['ari_0.9']:.0%} |"
        )
    lines += [
        "",
        "| time step, s | " + " | ".join(f"{name}: off by, of the size (worst); s a second" for name in MESHES) + " |",
        "|---|" + "---|" * len(MESHES),
    ]
    for rate in FLIGHTS:
        cells = []
        for name in MESHES:
            row = figures["flights"][name][str(rate)]
            cells.append(
                f"{row['error_median']:.3f} ({row['error_worst']:.2f}); {row['seconds_a_simulated_second']:.2f}"
            )
        lines.append(f"| 1/{rate} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.8))
    for k, name in enumerate(MESHES):
        heights = np.array(figures["meshes"][name]["heights"])
        beyond = beyond_range(heights)
        for rows, fill in ((heights[~beyond], f"C{k}"), (heights[beyond], "none")):
            label = name if fill != "none" else None
            left.loglog(rows[:, 1], rows[:, 0], "o", ms=4, alpha=0.7, color=f"C{k}", mfc=fill, label=label)
        flights = [figures["flights"][name][str(rate)] for rate in FLIGHTS]
        cost = [one["seconds_a_simulated_second"] for one in flights]
        error = [one["error_median"] for one in flights]
        right.loglog(cost, error, "o-", ms=4, color=f"C{k}", label=name)
        for rate, x, y in zip(FLIGHTS, cost, error, strict=True):
            if k == 0:
                right.annotate(f"1/{rate}", (x, y), fontsize=7, xytext=(3, 3), textcoords="offset points")
    left.plot(figures["range"], figures["range"], color="0.6", lw=1)
    left.set(
        xlabel=f"critical height at 1/{figures['rates'][1]} s, m", ylabel=f"at 1/{figures['rates'][0]} s, m"
    )  # fmt: skip
    left.legend(frameon=False, fontsize=8)
    right.set(xlabel="s of computing for a simulated second", ylabel=f"off by, of the size, {AFTER} s after contact")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
