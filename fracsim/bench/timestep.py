"""How much of a break depends on the time step: ``fracsim bench timestep``.

The lowest height from which a landing breaks an object is found by bisection, with a long and with a short time step;
the objects are made so strong that it is about half a metre. At twice that height the pieces are compared. Trajectories
after a break, at the objects' own strength, are compared with those of a much shorter step, and with what a simulated
second costs. Only the command line uses this module.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pybullet as p

from ..common.arrays import BoolArray, FloatArray
from ..fracture.asset import BreakableAsset, load
from ..metrics import ari
from ..physics.events import FractureEvent
from ..physics.world import World
from .picture import new_figure, save_figure

# The factor on each object's own strength: an object as weak as the chair would break in a fall that is hardly a hit.
STRENGTH = {"bunny": 2.5, "chair": 8.0, "vase": 1.0}
MESHES = tuple(STRENGTH)
SIZE = 0.3  # m, the largest extent of the objects
GRAVITY = 9.81  # m/s²
RATES = (120, 960)  # Hz, whose critical heights are compared
FLIGHTS = (60, 120, 240, 480, 960, 1920)  # Hz, whose trajectories are compared with the reference's
REFERENCE = 7680  # Hz
QUICK_REFERENCE = 960  # Hz
LANDINGS, QUICK_LANDINGS = 24, 2  # orientations, of which the first is upright
TRAJECTORIES, QUICK_TRAJECTORIES = 6, 1  # of those, whose trajectories are compared
HALVINGS = 11  # of the logarithm of RANGE: to 0.4 %
LANDING = 0.03  # s after the first contact: what breaks later is another fall
RANGE = (0.01, 30.0)  # m, of heights; from lower ones a long step's threshold on impact speed hides hits
START_GAP = 0.02  # m: a fall begins so far above the floor, at the speed it then has
FALL_TIME = 2.0  # s, after which a fall ends in any case
AFTER = 0.1  # s after the first contact, when trajectories are compared
SAME = 0.9  # an adjusted Rand index from which two breaks count as the same


class Fall:
    """An asset over a floor, about to land as if it had fallen from a height.

    Parameters
    ----------
    client : int
        A PyBullet client, which is reset.
    asset : BreakableAsset
        What falls.
    orientation : ndarray of float64, shape (4,)
        Its quaternion x, y, z, w.
    height : float
        Of its lowest point above the floor, m.
    rate : int
        Steps of the simulation, Hz.

    Attributes
    ----------
    world : World
        The world that it falls in.
    hits : list of float
        Times of its contacts, s.
    """

    def __init__(self, client: int, asset: BreakableAsset, orientation: FloatArray, height: float, rate: int) -> None:
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=client)
        p.setTimeStep(1 / rate, physicsClientId=client)
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        floor = p.createMultiBody(0, plane, physicsClientId=client)
        p.changeDynamics(floor, -1, restitution=1.0, lateralFriction=1.0, physicsClientId=client)
        self.world = World(client)
        rotation = np.reshape(p.getMatrixFromQuaternion(orientation.tolist()), (3, 3))
        low = float((asset.vertices @ rotation[2]).min())
        gap = min(height, START_GAP)
        # The engine's velocity is half a step behind its places, as in a leapfrog.
        speed = max(np.sqrt(2 * GRAVITY * (height - gap)) - 0.5 * GRAVITY / rate, 0.0)
        self.world.add(asset, (0, 0, gap - low), orientation, (0, 0, -speed), linear_damping=0.0, angular_damping=0.0)
        self.hits: list[float] = []
        self.world.on_contact(lambda _: self.hits.append(self.world.time))

    def land(self) -> FractureEvent | None:
        """Let it land.

        Returns
        -------
        FractureEvent or None
            The first break of the landing, if there is one.
        """
        while self.world.time < FALL_TIME and not self.past(LANDING):
            events = self.world.step()
            if events:
                return events[0]
        return None

    def past(self, seconds: float) -> bool:
        """Tell whether the first contact is longer ago.

        Parameters
        ----------
        seconds : float
            How long, s.

        Returns
        -------
        bool
            False as long as there was no contact.
        """
        return bool(self.hits) and self.world.time > self.hits[0] + seconds


def strengthened(asset: BreakableAsset, factor: float) -> BreakableAsset:
    """Make an asset stronger.

    Parameters
    ----------
    asset : BreakableAsset
        The asset.
    factor : float
        On its tensile strength.

    Returns
    -------
    BreakableAsset
        The same asset of another material.
    """
    return asset.with_material(replace(asset.material, tensile_strength=factor * asset.material.tensile_strength))


def critical_height(client: int, asset: BreakableAsset, orientation: FloatArray, rate: int) -> float:
    """Find the lowest height from which a landing breaks an asset, by bisection of its logarithm.

    Parameters
    ----------
    client : int
        A PyBullet client, which is reset.
    asset : BreakableAsset
        What falls.
    orientation : ndarray of float64, shape (4,)
        Its quaternion x, y, z, w.
    rate : int
        Steps of the simulation, Hz.

    Returns
    -------
    float
        m; an end of RANGE exactly where the height lies beyond.
    """
    low, high = lowest, highest = np.log(RANGE)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if Fall(client, asset, orientation, float(np.exp(middle)), rate).land() is None:
            low = middle
        else:
            high = middle
    if low == lowest:
        return RANGE[0]
    return RANGE[1] if high == highest else float(np.exp(0.5 * (low + high)))


def beyond_range(heights: FloatArray) -> BoolArray:
    """Find the landings whose ratio of heights says nothing.

    Parameters
    ----------
    heights : ndarray of float64, shape (N, 2)
        At both rates, m.

    Returns
    -------
    ndarray of bool, shape (N,)
        Whether both are beyond the same end of RANGE.
    """
    return (heights[:, 0] == heights[:, 1]) & np.isin(heights[:, 0], RANGE)


def compared(heights: FloatArray) -> dict[str, Any]:
    """Compare the critical heights at both rates.

    Parameters
    ----------
    heights : ndarray of float64, shape (N, 2)
        m. One that is beyond RANGE at one rate only counts as that end of RANGE.

    Returns
    -------
    dict
        Plain data: mean heights, and the ratio of the first to the second.
    """
    beyond = beyond_range(heights)
    inside = heights[~beyond]
    ratio = inside[:, 0] / inside[:, 1]
    return {
        "beyond": int(beyond.sum()),
        "mean_height": np.exp(np.log(inside).mean(axis=0)).tolist(),
        "ratio_median": float(np.median(ratio)),
        "ratio_mean": float(np.exp(np.log(ratio).mean())),
        "ratio_range": [float(ratio.min()), float(ratio.max())],
        "within_10_percent": float((np.abs(ratio - 1) <= 0.1).mean()),
    }


def flight(
    client: int, asset: BreakableAsset, orientation: FloatArray, height: float, rate: int
) -> tuple[FloatArray, float]:
    """Let an asset land, break and fly.

    Parameters
    ----------
    client : int
        A PyBullet client, which is reset.
    asset : BreakableAsset
        What falls.
    orientation : ndarray of float64, shape (4,)
        Its quaternion x, y, z, w.
    height : float
        From which it falls, m.
    rate : int
        Steps of the simulation, Hz.

    Returns
    -------
    places : ndarray of float64, shape (A, 3)
        Where its atoms are AFTER the first contact, m.
    seconds : float
        Seconds of computing for a simulated second.
    """
    fall = Fall(client, asset, orientation, height, rate)
    atoms = asset.arrays.moments[1] / asset.arrays.moments[0][:, None] * asset.scale + asset.offset
    body_atoms = {body: np.arange(len(atoms)) for body in fall.world.bodies}
    begin = perf_counter()
    steps = 0
    while not fall.past(AFTER) and fall.world.time < FALL_TIME:
        steps += 1
        for event in fall.world.step():
            del body_atoms[event.parent]
            pieces = zip(event.children, event.fracture.pieces, strict=True)
            body_atoms |= {child: piece.atoms for child, piece in pieces}
    seconds = (perf_counter() - begin) / (steps / rate)
    places = np.zeros_like(atoms)
    for body, rows in body_atoms.items():
        position, quaternion = fall.world.pose(body)
        rotation = np.reshape(p.getMatrixFromQuaternion(quaternion.tolist()), (3, 3))
        places[rows] = atoms[rows] @ rotation.T + position
    return places, seconds


def measure(quick: bool, seed: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Measure critical heights, the agreement of the pieces, and trajectories of each mesh.

    Parameters
    ----------
    quick : bool
        Whether to measure few orientations.
    seed : int
        Draws the orientations.
    progress : callable
        Called with the share done, from 0 to 1.

    Returns
    -------
    dict
        Plain data.
    """
    landings, trajectories = (QUICK_LANDINGS, QUICK_TRAJECTORIES) if quick else (LANDINGS, TRAJECTORIES)
    rng = np.random.default_rng(seed)
    orientations = rng.normal(size=(landings, 4))
    orientations[0] = (0, 0, 0, 1)  # upright, the flattest landing
    orientations /= np.linalg.norm(orientations, axis=1)[:, None]
    client = p.connect(p.DIRECT)
    result: dict[str, Any] = {"rates": RATES, "size": SIZE, "range": RANGE, "meshes": {}, "flights": {}}
    done, total = 0, len(MESHES) * (landings + trajectories)
    for name in MESHES:
        asset = load(name).scaled(SIZE)
        strong = strengthened(asset, STRENGTH[name])
        heights, agreement = [], []
        for orientation in orientations:
            pair = [critical_height(client, strong, orientation, rate) for rate in RATES]
            events = [Fall(client, strong, orientation, 2 * max(pair), rate).land() for rate in RATES]
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
            "ari_0.9": float((np.array(agreement) >= SAME).mean()),
        }
        errors: dict[int, list[float]] = {rate: [] for rate in FLIGHTS}
        costs: dict[int, list[float]] = {rate: [] for rate in FLIGHTS}
        for orientation in orientations[:trajectories]:
            exact, _ = flight(client, asset, orientation, 1.0, QUICK_REFERENCE if quick else REFERENCE)
            weight = asset.arrays.moments[0] / asset.arrays.moments[0].sum()
            for rate in FLIGHTS:
                places, seconds = flight(client, asset, orientation, 1.0, rate)
                errors[rate].append(float(np.sqrt(weight @ ((places - exact) ** 2).sum(axis=1)) / SIZE))
                costs[rate].append(seconds)
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
    """Write the figures as Markdown.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.

    Returns
    -------
    str
        A table of critical heights, and one of trajectories.
    """
    (slow, fast), (low, high) = figures["rates"], figures["range"]
    lines = [
        f"| mesh | strength | landings | beyond {low:g} to {high:g} m at both | critical height at 1/{slow} s and "
        f"1/{fast} s, m, geometric mean | ratio, median | geometric mean | smallest to largest | within 10 % | "
        "same pieces at twice the height (ARI ≥ 0.9) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["meshes"].items():
        smallest, largest = row["ratio_range"]
        lines.append(
            f"| {name} | {row['strength']:g}x | {len(row['heights'])} | {row['beyond']} | "
            f"{row['mean_height'][0]:.3f}, {row['mean_height'][1]:.3f} | **{row['ratio_median']:.3f}** | "
            f"{row['ratio_mean']:.3f} | {smallest:.2f} to {largest:.2f} | {row['within_10_percent']:.0%} | "
            f"{row['ari_0.9']:.0%} |"
        )
    lines += [
        "",
        "| time step, s | "
        + " | ".join(f"{name}: error / size (worst); s a simulated second" for name in MESHES)
        + " |",
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
    """Draw the critical heights at both rates, and the error of a trajectory over what it costs.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.
    path : Path
        The PNG file to write.
    """
    figure = new_figure(9, 3.8)
    left, right = figure.subplots(1, 2)
    for k, name in enumerate(MESHES):
        heights = np.array(figures["meshes"][name]["heights"])
        beyond = beyond_range(heights)
        for rows, fill in ((heights[~beyond], f"C{k}"), (heights[beyond], "none")):
            label = name if fill != "none" else None
            left.loglog(rows[:, 1], rows[:, 0], "o", ms=4, alpha=0.7, color=f"C{k}", mfc=fill, label=label)
        flights = [figures["flights"][name][str(rate)] for rate in FLIGHTS]
        cost = [row["seconds_a_simulated_second"] for row in flights]
        error = [row["error_median"] for row in flights]
        right.loglog(cost, error, "o-", ms=4, color=f"C{k}", label=name)
        for rate, x, y in zip(FLIGHTS, cost, error, strict=True):
            if k == 0:
                right.annotate(f"1/{rate}", (x, y), fontsize=7, xytext=(3, 3), textcoords="offset points")
    left.plot(figures["range"], figures["range"], color="0.6", lw=1)
    slow, fast = figures["rates"]
    left.set(xlabel=f"critical height with steps of 1/{fast} s, m", ylabel=f"with steps of 1/{slow} s, m")
    left.legend(frameon=False, fontsize=8)
    right.set(xlabel="s of computing for a simulated second", ylabel=f"error / size, {AFTER} s after contact")
    save_figure(figure, path)
