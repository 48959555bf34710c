"""The lattice simulators against textbook cases: ``python benchmarks/physics.py [--quick] [--workers N] [CASE ...]``.

Bars, beams, rods, a notched strip, a disc, a ring, plates and shells are loaded or hit, and what ``sequential`` and
``structural`` make of them is compared with theory or with published tests, at three numbers of cells on three tilings
each. Nothing is fitted to a case. Writes physics.{json,md,png} and physics_pieces.png into benchmarks/results; about 30
minutes on two cores, with ``--quick`` (one tiling of 150 cells, nothing written) one.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from physics_bodies import (
    EGG_MASS,
    EGG_MODULUS,
    EGG_SIZE,
    Make,
    Specimen,
    bent,
    cantilever,
    disc,
    egg,
    notched,
    owner,
    plate,
    pure_bending,
    ring,
    rod,
    tension,
)
from physics_engines import ENGINES, Engine, count_pieces, shares
from physics_figures import draw_pieces, draw_ratios

from fracsim.common.arrays import FloatArray, IntArray
from fracsim.common.contact import ContactLaw

RESULTS = Path(__file__).parent / "results"
COMMAND = "python benchmarks/physics.py"
CELLS = (150, 300, 600)
TILINGS = 3
BEYOND = 1.1  # times the critical load: where pieces are counted
GRAVITY = 9.81  # m/s²
NOTCHES = {0.1: 149.9, 0.5: 64.2, 1.0: 41.2}  # depth in mm, and the critical stress of the strip in MPa
LEAST_FRAGMENT = 0.012  # of the body: smaller pieces are joined to others by the simulators
LARGE = 0.05  # of the body: what counts as a piece of a bar, a beam or a disc
LOADS = (1.5, 3.0, 6.0, 12.0)  # times the critical load of a plate
CIRCLE = 0.25  # radius about the point that is hit, on which radial cracks are counted
SHORTEST = 0.03  # of that circle: a shorter stretch of one piece is a chip, not a sector
SHATTER = 8.0  # times the critical load, for statistics of fragments
HITS = 8  # on each body, for statistics of fragments

Measured = dict[str, float]
Measure = Callable[[Specimen, Engine], Measured]


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    name : str
        What is measured.
    low, high : float
        Between which theory or a published test puts it, for ``sequential`` at 300 cells and more.
    source : str
        Who says so.
    slack : float
        How much farther ``structural`` may be off.
    """

    name: str
    low: float
    high: float
    source: str
    slack: float = 0.0


@dataclass(frozen=True)
class Case:
    """A specimen, what is done to it, and what is asked of it."""

    make: Make
    measure: Measure
    rows: tuple[Row, ...]


def near_one(source: str, name: str = "load / theory") -> Row:
    """A ratio of 1, within 15 %, and 25 % for ``structural``."""
    return Row(name, 0.85, 1.15, source, 0.10)


def exactly(name: str, value: float, source: str) -> Row:
    """A count."""
    return Row(name, value - 0.01, value + 0.01, source)


# Loaded bodies


def loaded(extra: Callable[[Specimen, Engine, float], Measured] | None = None) -> Measure:
    """Measure the critical load and the pieces just above it, and what ``extra`` says."""

    def measure(specimen: Specimen, engine: Engine) -> Measured:
        critical = engine.critical()
        result = {"load / theory": critical / specimen.expected}
        if np.isfinite(critical):
            labels = engine.labels(BEYOND * critical)
            result["pieces"] = count_pieces(specimen, labels, LARGE)
            result["largest"] = float(shares(specimen, labels)[0])
        if extra:
            result |= extra(specimen, engine, critical)
        return result

    return measure


def first_crack(specimen: Specimen, engine: Engine, critical: float) -> Measured:
    """Say whether the first crack is on the side that is pulled, below in a beam pushed down between supports."""
    face = engine.first_face()
    return {"first crack on the tension side": float(specimen.lattice.faces.centroids[face, 2] < 0)}


def first_crack_above(specimen: Specimen, engine: Engine, critical: float) -> Measured:
    """The same of a cantilever, which is pulled above."""
    return {"first crack on the tension side": 1.0 - first_crack(specimen, engine, critical).popitem()[1]}


def inner_side(specimen: Specimen, engine: Engine, critical: float) -> Measured:
    """Say whether a ring's first crack is on its inner side, under a load."""
    x, y, _ = specimen.lattice.faces.centroids[engine.first_face()]
    return {"first crack inside, under the load": float(np.hypot(x, y) < 0.45 and abs(x) > 0.35)}


def diametral(specimen: Specimen, engine: Engine, critical: float) -> Measured:
    """Measure by how many degrees the main crack of a disc leaves the loaded diameter."""
    if not np.isfinite(critical):
        return {}
    labels = engine.labels(BEYOND * critical)
    faces = specimen.lattice.faces
    two = np.argsort(np.bincount(labels, specimen.solid.volumes))[-2:]
    ends = labels[faces.pairs]
    between = np.isin(ends, two).all(axis=1) & (ends[:, 0] != ends[:, 1])
    if not between.any():
        return {"degrees off the diameter": 90.0}
    # The crack's plane is across the direction along which its faces' middles spread least, in the disc's plane.
    middle, area = faces.centroids[between, :2], faces.areas[between]
    arm = middle - area @ middle / area.sum()
    direction = np.linalg.eigh((area[:, None] * arm).T @ arm)[1][:, 1]
    return {"degrees off the diameter": float(np.degrees(np.arccos(min(1.0, abs(direction[0])))))}


def megapascal(stress: float) -> Measure:
    """Measure a notched strip's critical stress, of which theory says how large it is."""

    def measure(specimen: Specimen, engine: Engine) -> Measured:
        ratio = engine.critical() / specimen.expected
        return {"load / theory": ratio, "MPa": ratio * stress}

    return measure


# Plates and shells


def contact_energy(specimen: Specimen, factor: float) -> float:
    """Compute the energy of approach, in E L³, at which the contact's peak force is a load factor."""
    lattice, options = specimen.lattice, specimen.options
    _, compliance = lattice.answer(specimen.forces, lattice.intact.solve(specimen.forces))
    return float(ContactLaw(options.hertz, float(compliance)).energy(factor * options.strain))


def circle_of(specimen: Specimen, labels: IntArray) -> list[tuple[int, float]]:
    """List the pieces around the circle about the point that is hit: which, and what share of the circle it has."""
    angle = np.arange(720) * 2 * np.pi / 720
    points = specimen.point * [1, 1, 0] + CIRCLE * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    distance = np.linalg.norm(points[:, None] - specimen.solid.centroids, axis=2)
    around = labels[np.argmin(distance, axis=1)]
    change = np.flatnonzero(around != np.roll(around, 1))
    if len(change) == 0:
        return [(int(around[0]), 1.0)]
    length = np.diff(np.append(change, change[0] + len(around))) / len(around)
    return list(zip(around[change].tolist(), length.tolist(), strict=True))


def sectors(specimen: Specimen, engine: Engine) -> Measured:
    """Count the sectors that a plate breaks into at rising loads, and see whether a plug is punched out of it."""
    critical = engine.critical()
    if not np.isfinite(critical):
        return {}
    counts, plugs = [], []
    centre = int(np.argmin(np.linalg.norm(specimen.solid.centroids - specimen.point, axis=1)))
    for factor in LOADS:
        labels = engine.labels(factor * critical)
        around = circle_of(specimen, labels)
        counts.append(sum(share >= SHORTEST for _, share in around))
        # A plug: the piece that is hit is cut off inside the circle, and is more than a chip.
        own = labels == labels[centre]
        volume = specimen.solid.volumes[own].sum() / specimen.solid.volumes.sum()
        plugs.append(labels[centre] not in {piece for piece, _ in around} and volume > LARGE)
    speeds = [np.sqrt(contact_energy(specimen, factor * critical)) for factor in LOADS]
    growth = np.polyfit(np.log(speeds), np.log(np.maximum(counts, 1)), 1)[0]
    result: Measured = {f"sectors at {factor:g} x": float(count) for factor, count in zip(LOADS, counts, strict=True)}
    return result | {"growth exponent": float(growth), "plugs": float(np.mean(plugs))}


def drop_heights(specimen: Specimen, engine: Engine) -> Measured:
    """Work out the heights from which an egg breaks, upright and on its side, in mm."""
    result, reach = {}, specimen.surface.vertices.max(axis=0)
    for name, direction in (("upright", (0.0, 0.0, 1.0)), ("on its side", (1.0, 0.0, 0.0))):
        point = -np.asarray(direction) * reach
        hit = struck(specimen, point, np.asarray(direction))
        energy = contact_energy(hit, type(engine)(hit, 0).critical()) * EGG_MODULUS * EGG_SIZE**3
        result[f"height {name}, mm"] = 1e3 * energy / (EGG_MASS * GRAVITY)
    return result | {"upright / on its side": result["height upright, mm"] / result["height on its side, mm"]}


def struck(specimen: Specimen, point: FloatArray, direction: FloatArray) -> Specimen:
    """Hit the same body elsewhere."""
    forces = specimen.lattice.force(owner(specimen.solid, point), point, direction)
    return replace(specimen, forces=forces, point=point, direction=direction)


def power_law(masses: FloatArray, least: float) -> float:
    """Estimate tau of n(m) proportional to m^-tau, above a least mass (Clauset, Shalizi, Newman 2009, Eq. 3.1)."""
    large = masses[masses >= least]
    return float(1.0 + len(large) / np.log(large / least).sum()) if len(large) > 1 else np.nan


def fragments(specimen: Specimen, engine: Engine) -> Measured:
    """Hit a body hard at many places, and measure how the masses of its pieces are distributed."""
    surface, rng = specimen.surface, np.random.default_rng(0)
    mesh = surface.trimesh
    masses = []
    for _ in range(HITS):
        face = int(rng.choice(len(surface.faces), p=mesh.area_faces / mesh.area))
        point = rng.dirichlet(np.ones(3)) @ surface.vertices[surface.faces[face]]
        direction = -mesh.face_normals[face]
        hit = struck(specimen, point, direction)
        machine = type(engine)(hit, 0)
        critical = machine.critical()
        if np.isfinite(critical):
            masses.append(shares(hit, machine.labels(SHATTER * critical)))
    pooled = np.concatenate(masses) if masses else np.ones(1)
    return {"exponent": power_law(pooled, LEAST_FRAGMENT), "pieces a hit": len(pooled) / max(len(masses), 1)}


# The cases

BEAM = "Euler and Bernoulli's beam"
CASES: dict[str, Case] = {
    "bar in tension": Case(
        tension,
        loaded(),
        (near_one("strength times area"), exactly("pieces", 2, "one section fails")),
    ),
    "cantilever": Case(
        cantilever,
        loaded(first_crack_above),
        (near_one(BEAM), exactly("pieces", 2, BEAM), exactly("first crack on the tension side", 1, BEAM)),
    ),
    "three-point bending": Case(
        bent(0.0),
        loaded(first_crack),
        (near_one(BEAM), exactly("pieces", 2, BEAM), exactly("first crack on the tension side", 1, BEAM)),
    ),
    "four-point bending": Case(
        bent(0.3),
        loaded(first_crack),
        (near_one(BEAM), exactly("pieces", 2, BEAM), exactly("first crack on the tension side", 1, BEAM)),
    ),
    "free rod hit in its middle": Case(
        rod(0.0),
        loaded(),
        (
            near_one("moment against a rigid rod's inertia"),
            exactly("pieces", 2, "largest moment, F L / 8, in the middle"),
            Row("largest", 0.4, 0.6, "the same"),
        ),
    ),
    "free rod hit at a quarter": Case(
        rod(0.25),
        loaded(),
        (
            near_one("moment against a rigid rod's inertia"),
            exactly("pieces", 2, "largest moment at the quarter"),
            Row("largest", 0.65, 0.85, "the same"),
        ),
    ),
    "free rod hit at its end": Case(
        rod(0.48),
        loaded(),
        (
            near_one("moment against a rigid rod's inertia"),
            exactly("pieces", 2, "largest moment, 4/27 F L, a third from the end"),
            Row("largest", 0.57, 0.77, "the same"),
        ),
    ),
    **{
        f"alumina strip with a notch of {depth:g} mm": Case(
            notched(depth),
            megapascal(stress),
            (Row("MPa", 0.85 * stress, 1.15 * stress, "edge crack and strength", 0.1 * stress),),
        )
        for depth, stress in NOTCHES.items()
    },
    "Brazilian disc": Case(
        disc,
        loaded(diametral),
        (near_one("2 P / (pi D t)"), Row("degrees off the diameter", 0.0, 15.0, "the same", 5.0)),
    ),
    "ring": Case(
        ring,
        loaded(inner_side),
        (
            near_one("curved beam, Timoshenko"),
            exactly("first crack inside, under the load", 1, "the same"),
            Row("pieces", 2, 4, "hinges under the loads, then at the sides"),
        ),
    ),
    **{
        f"glass plate, {how}, hit in its centre": Case(
            plate(held),
            sectors,
            (
                Row("growth exponent", 0.25, 0.75, "sectors as the root of speed: Vandenberghe et al. 2013"),
                Row("sectors at 3 x", 3, 12, "a star: the same"),
                Row("plugs", 0.0, 0.01, "no plug below ballistic speeds"),
            ),
        )
        for how, held in (("free", False), ("clamped", True))
    },
    "egg dropped upright or on its side": Case(
        egg,
        drop_heights,
        (Row("upright / on its side", 0.0, 0.95, "upright breaks more often: Sutanto et al. 2025, 180 eggs"),),
    ),
    "shattered plate": Case(
        plate(False),
        fragments,
        (Row("exponent", 1.5, 2.0, "n(m) as m^-tau, plates: Oddershede et al. 1993; Meibom and Balslev 1996"),),
    ),
    "shattered shell": Case(
        egg,
        fragments,
        (Row("exponent", 1.2, 1.5, "1.35, eggshells: Wittel et al. 2004"),),
    ),
    "thin rod bent and let go": Case(
        pure_bending,
        loaded(),
        (
            near_one(BEAM),
            Row("pieces", 3, np.inf, "flexural waves, not in statics: Audoly and Neukirch 2005"),
        ),
    ),
}


Result = dict[str, Any]


def run_one(name: str, engine: str, cells: int, seed: int) -> Result:
    """Measure one case on one tiling with one simulator."""
    case, begin = CASES[name], time.perf_counter()
    specimen = case.make(cells, seed)
    measured = case.measure(specimen, ENGINES[engine](specimen, seed))
    return {
        "case": name,
        "engine": engine,
        "cells": cells,
        "seed": seed,
        "measured": measured,
        "seconds": time.perf_counter() - begin,
    }


def rows_of(results: list[Result]) -> list[dict[str, Any]]:
    """Gather what was measured on every tiling into the rows of the table.

    Returns
    -------
    list of dict
        With the case, what is measured, what is expected and by whom, ``got`` by simulator and number of cells, each as
        mean, least and greatest over the tilings, and ``holds`` by simulator: whether the means at 300 cells and more,
        or at the most there are, lie where they are expected.
    """
    rows = []
    for name, case in CASES.items():
        own = [result for result in results if result["case"] == name]
        for row in case.rows if own else ():
            got: dict[str, dict[str, list[float]]] = {}
            holds = {}
            for engine in ENGINES:
                by_count = got[engine] = {}
                for cells in sorted({result["cells"] for result in own}):
                    values = [
                        result["measured"].get(row.name, np.nan)
                        for result in own
                        if result["engine"] == engine and result["cells"] == cells
                    ]
                    by_count[str(cells)] = [float(x) for x in (np.mean(values), np.min(values), np.max(values))]
                slack = row.slack if engine == "structural" else 0.0
                fine = [by_count[count][0] for count in by_count if int(count) >= min(300, int(max(by_count, key=int)))]
                holds[engine] = all(row.low - slack <= value <= row.high + slack for value in fine)
            expected = {"low": row.low, "high": row.high, "slack": row.slack, "source": row.source}
            rows.append({"case": name, "measured": row.name, "expected": expected, "got": got, "holds": holds})
    return rows


def number(value: float) -> str:
    """Write a number with three digits."""
    return "–" if not np.isfinite(value) else f"{round(value, 9) + 0.0:.3g}"


def spread(three: list[float]) -> str:
    """Write a mean, and the least and greatest where they differ."""
    mean, least, greatest = three
    return number(mean) if number(least) == number(greatest) else f"{number(mean)} ({number(least)}–{number(greatest)})"


def expected_text(expected: dict[str, float]) -> str:
    """Write what is expected."""
    low, high = expected["low"], expected["high"]
    if high - low < 0.05:
        return number(round((low + high) / 2))
    if not np.isfinite(high):
        return f"≥ {number(low)}"
    return f"{number(low)}–{number(high)}"


def markdown(rows: list[dict[str, Any]]) -> str:
    """Write the table."""
    counts = list(next(iter(rows[0]["got"].values())))
    heads = [f"{engine}, {count}" for engine in ENGINES for count in counts]
    lines = [
        f"Textbook cases, {TILINGS} tilings each: mean (least–greatest). A case holds where the means at 300 and at "
        "600 cells are as expected; `structural` is allowed 10 % more of a load or a stress, and 5° more off a "
        "diameter. `python benchmarks/physics.py`",
        "",
        "| case | measured | expected | " + " | ".join(heads) + " | holds | source |",
        "|---" * (len(heads) + 5) + "|",
    ]
    for row in rows:
        cells = [spread(row["got"][engine][count]) for engine in ENGINES for count in counts]
        holds = [engine for engine in ENGINES if row["holds"][engine]]
        verdict = "both" if len(holds) == len(ENGINES) else holds[0] if holds else "**neither**"
        head = [row["case"], row["measured"], expected_text(row["expected"])]
        lines.append("| " + " | ".join([*head, *cells, verdict, row["expected"]["source"]]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description="Compare the lattice simulators with textbook cases.")
    parser.add_argument("cases", nargs="*", help="all by default")
    parser.add_argument("--quick", action="store_true", help="one tiling of 150 cells; nothing is written")
    parser.add_argument("--table", action="store_true", help="write table and pictures again from the runs in the JSON")
    parser.add_argument("--resume", action="store_true", help="go on where a run was stopped")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    if args.table:
        write(json.loads((RESULTS / "physics.json").read_text())["runs"])
        return
    if unknown := set(args.cases) - set(CASES):
        parser.error(f"no such case: {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    counts, tilings = ((150,), 1) if args.quick else (CELLS, TILINGS)
    part, whole = RESULTS / "physics.part.json", not (args.quick or args.cases)
    results = json.loads(part.read_text()) if args.resume and part.exists() else []
    done = {(run["case"], run["engine"], run["cells"], run["seed"]) for run in results}
    wanted = [
        (name, engine, cells, seed)
        for cells in counts
        for name in args.cases or CASES
        for seed in range(tilings)
        for engine in ENGINES
    ]
    jobs = [delayed(run_one)(*job) for job in wanted if job not in done]
    begin = time.perf_counter()
    for count, result in enumerate(Parallel(args.workers, return_as="generator_unordered")(jobs), start=1):
        results.append(result)
        said = ", ".join(f"{key} {number(value)}" for key, value in result["measured"].items())
        left = (time.perf_counter() - begin) / count * (len(jobs) - count)
        print(
            f"{count}/{len(jobs)}, {left:.0f} s to go: {result['case']}, {result['engine']}, {result['cells']} cells: "
            f"{said} ({result['seconds']:.1f} s)",
            flush=True,
        )
        if whole:
            part.write_text(json.dumps(results))
    results.sort(key=lambda run: wanted.index((run["case"], run["engine"], run["cells"], run["seed"])))
    if whole:
        write(results)
        part.unlink()
    else:
        print(markdown(rows_of(results)))


def write(results: list[Result]) -> None:
    """Write the runs, the table and the pictures."""
    rows = rows_of(results)
    print(markdown(rows))
    RESULTS.mkdir(exist_ok=True)
    data = {"command": COMMAND, "rows": rows, "runs": results}
    (RESULTS / "physics.json").write_text(json.dumps(data, indent=1) + "\n")
    (RESULTS / "physics.md").write_text(markdown(rows))
    draw_ratios(rows, RESULTS / "physics.png")
    scenes = [(plate(False), factor, f"plate, {factor:g} x critical") for factor in LOADS[:3]]
    draw_pieces([*scenes, (disc, BEYOND, "disc"), (ring, BEYOND, "ring")], RESULTS / "physics_pieces.png")


if __name__ == "__main__":
    main()
