"""What the lattice simulators cost: ``python benchmarks/lattice_cost.py`` (about 8 minutes on two cores).

The ceramic mug of ``meshes``, 0.1 m, cut into 150 to 2,000 cells. For each number and simulator: seconds to build it,
and milliseconds of a single impact on one core, at 1, 2 and 4 times the force of its first crack. Then 5,000 samples of
`structural` at 300 cells, as a bake draws them, in two worker processes. Writes
benchmarks/results/lattice_cost.{json,md,png}. Run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from fracsim.common.material import as_material
from fracsim.data.writing import make_dataset
from fracsim.geometry.sampling import CONE, SurfacePoints, cone
from fracsim.simulators.base import FractureSimulator, Impacts
from fracsim.simulators.capabilities import reference_factors
from fracsim.simulators.registry import make_simulator, options_for_body
from fracsim.solids.surface import Surface, read_surface, refine

HERE = Path(__file__).parent
RESULTS = HERE / "results"
MESH, SIZE, MATERIAL = "mug", 0.1, "ceramic"
CELLS = (150, 300, 600, 1000, 2000)
SIMULATORS = ("structural", "sequential")
IMPACTS = {"structural": 12, "sequential": 3}  # a number and simulator
LONGEST = 60.0  # s that the impacts of a number of cells may take; when they took longer, no more cells are tried
FACTORS = (1.0, 2.0, 4.0)  # times the force of the first crack
SAMPLES, WORKERS, CELLS_OF_A_BAKE = 5000, 2, 300


def single_impacts(surface: Surface, count: int) -> Impacts:
    """Draw single impacts of severity 1, N = count, uniform over the area."""
    rng = np.random.default_rng(0)
    points = SurfacePoints(surface.vertices, surface.faces)
    face, barycentric = points.draw(count, rng)
    direction = cone(-points.normals[face], CONE, rng)
    return Impacts(face[:, None], barycentric[:, None], direction[:, None], np.ones((count, 1)))


def seconds_each(simulator: FractureSimulator, impacts: Impacts) -> list[float]:
    """Time each impact by itself, in s."""
    factor = reference_factors(simulator, impacts) * np.resize(FACTORS, len(impacts))
    hard, seconds = impacts.times(factor), []
    for row in range(len(hard)):
        one = Impacts(*(getattr(hard, name)[row : row + 1] for name in vars(hard)))
        begin = time.perf_counter()
        simulator.fracture(one)
        seconds.append(time.perf_counter() - begin)
    return seconds


def measure(cells: tuple[int, ...], samples: int) -> dict:
    """Build, break and sample; rows by simulator and number of cells."""
    surface = replace(refine(read_surface(HERE.parent / "meshes" / f"{MESH}.obj")), scale=SIZE)
    rows = []
    for name in SIMULATORS:
        for number in cells:
            options = options_for_body(name, as_material(MATERIAL), SIZE, cells=number)
            begin = time.perf_counter()
            simulator = make_simulator(surface, options, 0)
            built = time.perf_counter() - begin
            with threadpool_limits(1):
                first = single_impacts(surface, 1)
                seconds_each(simulator, first)  # what is worked out once
                begin = time.perf_counter()
                reference_factors(simulator, single_impacts(surface, 10))
                first_crack = (time.perf_counter() - begin) / 10
                seconds = seconds_each(simulator, single_impacts(surface, IMPACTS[name]))
            row = {
                "simulator": name,
                "cells": len(getattr(simulator, "fine_cells", simulator.cells).volumes),
                "build_s": built,
                "first_crack_ms": 1e3 * first_crack,
                "impact_ms": 1e3 * float(np.mean(seconds)),
                "slowest_ms": 1e3 * max(seconds),
            }
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
            if sum(seconds) > LONGEST:
                break
    options = options_for_body("structural", as_material(MATERIAL), SIZE, cells=CELLS_OF_A_BAKE)
    with tempfile.TemporaryDirectory() as folder:
        stages = make_dataset(Path(folder) / "mug.h5", surface, samples, 0, options, workers=WORKERS)
    return {"rows": rows, "samples": samples, "workers": WORKERS, "stages": stages}


def growth(rows: list[dict], key: str) -> float:
    """Fit the power of the number of cells that a time grows with."""
    cells, times = np.log([row["cells"] for row in rows]), np.log([row[key] for row in rows])
    return float(np.polyfit(cells, times, 1)[0]) if len(rows) > 1 else float("nan")


def table(data: dict) -> str:
    """Write the figures as Markdown."""
    of = {name: [row for row in data["rows"] if row["simulator"] == name] for name in SIMULATORS}
    powers = ", ".join(f"{name} as n^{growth(of[name], 'impact_ms'):.2f}" for name in SIMULATORS)
    stages = data["stages"]
    lines = [
        f"The {MATERIAL} {MESH} of {SIZE} m, one core, single impacts at {', '.join(f'{x:g}' for x in FACTORS)} times "
        "the force of their first crack. `python benchmarks/lattice_cost.py`",
        f"Time of an impact grows with the number n of cells: {powers}.",
        "",
        "| simulator | cells | build, s | first crack, ms | an impact, ms | slowest, ms |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['simulator']} | {row['cells']} | {row['build_s']:.1f} | {row['first_crack_ms']:.1f} "
        f"| {row['impact_ms']:.0f} | {row['slowest_ms']:.0f} |"
        for row in data["rows"]
    ]
    each = 1e3 * stages["samples"] * data["workers"] / data["samples"]
    lines += [
        "",
        f"A dataset of {data['samples']} samples from `structural` at {CELLS_OF_A_BAKE} cells, by {data['workers']} "
        f"workers, takes {stages['samples']:.0f} s for the samples ({each:.0f} ms of a core each), "
        f"{stages['repeatability']:.0f} s for how well the simulator repeats itself, and {stages['cells']:.0f} s for "
        "its cells.",
    ]
    return "\n".join(lines) + "\n"


def draw(data: dict, path: Path) -> None:
    """Plot the time of an impact against the number of cells."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.4))
    for name in SIMULATORS:
        rows = [row for row in data["rows"] if row["simulator"] == name]
        axes.loglog([row["cells"] for row in rows], [row["impact_ms"] for row in rows], "o-", label=name)
    axes.set(xlabel="cells", ylabel="ms an impact, one core", xticks=CELLS, xticklabels=[str(n) for n in CELLS])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two numbers of cells and few samples, to try it")
    quick = parser.parse_args().quick
    data = measure(CELLS[:2], 400) if quick else measure(CELLS, SAMPLES)
    text = table(data)
    print(text)
    if not quick:
        RESULTS.mkdir(exist_ok=True)
        data["command"] = "python benchmarks/lattice_cost.py"
        (RESULTS / "lattice_cost.json").write_text(json.dumps(data, indent=2) + "\n")
        (RESULTS / "lattice_cost.md").write_text(text)
        draw(data, RESULTS / "lattice_cost.png")


if __name__ == "__main__":
    main()
