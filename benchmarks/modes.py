"""Time, energy and growth of the fracture modes: ``python benchmarks/modes.py`` (about 10 minutes).

20 modes of the bunny's solid at several numbers of cells, by the first-order solver and by Clarabel's interior point
(up to some 10,000 cells), on one core each. Energies are compared mode by mode, each mode after the same ones before
it, those of the interior point: a greedy sequence that takes another turn at one mode is another sequence from there
on, which the ratio of the sums shows. Writes benchmarks/results/modes.{json,md,png}.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from fracsim.simulators.fracture_modes import Modes, fracture_modes
from fracsim.solids.cut import cut_lattice
from fracsim.solids.solid import Solid
from fracsim.solids.surface import read_surface

HERE = Path(__file__).parent
RESULTS = HERE / "results"
MODES = 20
ASKED = (1600, 3200, 6400, 13000, 26000, 50000)  # slivers joined, about a fifth fewer cells come out
INTERIOR = 13000  # the most that the interior point is asked for
TARGET_CELLS, TARGET_SECONDS = 5000, 15.0


def timed(solid: Solid, solver: str) -> tuple[Modes, float]:
    begin = time.perf_counter()
    modes = fracture_modes(solid, MODES, solver=solver)
    return modes, time.perf_counter() - begin


def last(modes: Modes) -> np.ndarray:
    return np.array([energies[-1] for energies in modes.objectives])


def exponent(cells: list[int], seconds: list[float]) -> float:
    return float(np.polyfit(np.log(cells), np.log(seconds), 1)[0])


def main() -> None:
    surface = read_surface(HERE.parent / "meshes" / "bunny.obj")
    rows = []
    for asked in ASKED:
        solid = cut_lattice(surface, asked, np.random.default_rng(0))
        modes, seconds = timed(solid, "first-order")
        row = {
            "cells": len(solid.volumes),
            "first_order_seconds": seconds,
            "first_order_programmes": sum(map(len, modes.objectives)),
            "energies": last(modes).tolist(),
        }
        if asked <= INTERIOR:
            exact, row["interior_point_seconds"] = timed(solid, "interior-point")
            row["interior_point_energies"] = last(exact).tolist()
            row["energy_ratio_sum"] = float(last(modes).sum() / last(exact).sum())
            conditional = [
                last(fracture_modes(solid, 1, known=exact.values[:k]))[0] / last(exact)[k] for k in range(MODES)
            ]
            row["energy_ratio_per_mode"] = [float(ratio) for ratio in conditional]
        rows.append(row)
        print({key: value for key, value in row.items() if not isinstance(value, list)}, flush=True)
    both = [row for row in rows if "interior_point_seconds" in row]
    growth = {
        "first-order": exponent([r["cells"] for r in rows], [r["first_order_seconds"] for r in rows]),
        "interior-point": exponent([r["cells"] for r in both], [r["interior_point_seconds"] for r in both]),
    }
    result = {"command": "python benchmarks/modes.py", "modes": MODES, "growth": growth, "rows": rows}
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "modes.json").write_text(json.dumps(result, indent=2) + "\n")
    lines = [
        f"{MODES} modes of the bunny's solid, one core. `python benchmarks/modes.py`. Energy: first-order over",
        "interior point, the worst and the mean over modes, each after the same modes; and over the sums of the two",
        f"sequences. Time grows as n^{growth['first-order']:.2f}, by the interior point as "
        f"n^{growth['interior-point']:.2f}.",
        "",
        "| cells | first-order, s | interior point, s | speed-up | energy, worst mode | mean | sums |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cell = f"| {row['cells']} | {row['first_order_seconds']:.1f} | "
        if "interior_point_seconds" in row:
            ratio = np.array(row["energy_ratio_per_mode"])
            speed = row["interior_point_seconds"] / row["first_order_seconds"]
            cell += f"{row['interior_point_seconds']:.1f} | {speed:.1f} | {ratio.max():.4f} | {ratio.mean():.4f} | "
            cell += f"{row['energy_ratio_sum']:.4f} |"
        else:
            cell += "- | - | - | - | - |"
        lines.append(cell)
    (RESULTS / "modes.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4))
    cells = np.array([row["cells"] for row in rows])
    left.loglog(cells, [r["first_order_seconds"] for r in rows], "o-", label="first-order")
    left.loglog([r["cells"] for r in both], [r["interior_point_seconds"] for r in both], "s-", label="interior point")
    anchor = rows[0]["first_order_seconds"]
    left.loglog(cells, anchor * (cells / cells[0]) ** 1.5, ":", color="grey", label="n^1.5")
    left.plot(TARGET_CELLS, TARGET_SECONDS, "kx", label="15 s at 5,000 cells")
    left.set(xlabel="cells", ylabel=f"seconds for {MODES} modes")
    left.legend()
    for row in both:
        right.plot(np.arange(1, MODES + 1), row["energy_ratio_per_mode"], "o-", ms=3, label=f"{row['cells']} cells")
    right.axhline(1.01, color="grey", ls=":", label="1 %")
    right.set(xlabel="mode", ylabel="energy, first-order / interior point", title="after the same modes")
    right.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(RESULTS / "modes.png", dpi=110)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
