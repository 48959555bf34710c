"""The pictures of ``physics.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from physics_bodies import Make
from physics_engines import ENGINES, count_pieces


def draw_ratios(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw every load and stress over what is expected, by simulator and number of cells."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    chosen = [row for row in rows if row["measured"] in ("load / theory", "MPa")]
    figure, axes = pyplot.subplots(figsize=(9, 0.42 * len(chosen) + 1.2))
    for shift, (engine, colour) in enumerate(zip(ENGINES, ("tab:blue", "tab:orange"), strict=True)):
        for k, row in enumerate(chosen):
            scale = 2.0 / (row["expected"]["low"] + row["expected"]["high"])
            for j, (count, (mean, least, greatest)) in enumerate(row["got"][engine].items()):
                y = k + 0.36 * shift + 0.09 * j - 0.27
                label = f"{engine}, {count} cells" if k == 0 else None
                alpha = (0.35, 0.65, 1.0)[j % 3]
                axes.plot([least * scale, greatest * scale], [y, y], color=colour, alpha=alpha, lw=1.5)
                axes.plot([mean * scale], [y], "o", color=colour, alpha=alpha, ms=4, label=label)
    axes.axvspan(0.85, 1.15, color="0.9", zorder=0)
    axes.axvline(1.0, color="0.5", lw=0.8)
    axes.set_yticks(range(len(chosen)), [row["case"] for row in chosen])
    axes.invert_yaxis()
    axes.set(xlabel="critical load over what theory says; grey: within 15 %; bars: three tilings", xscale="log")
    ticks = (0.5, 0.7, 0.85, 1.0, 1.15, 1.5, 2.0, 3.0)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.legend(fontsize=7, loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def draw_pieces(scenes: list[tuple[Make, float, str]], path: Path, cells: int = 600) -> None:
    """Draw flat bodies from above, each at a factor of its critical load, as both simulators break them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import colormaps, pyplot
    from matplotlib.collections import PolyCollection

    figure, grid = pyplot.subplots(len(ENGINES), len(scenes), figsize=(2.2 * len(scenes), 2.45 * len(ENGINES)))
    for column, (make, factor, title) in enumerate(scenes):
        specimen = make(cells, 0)
        solid = specimen.solid
        corner = solid.points[solid.triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        top = (solid.sides[:, 1] < 0) & (normal[:, 2] > 0.9 * np.linalg.norm(normal, axis=1))
        for row, (name, engine) in enumerate(ENGINES.items()):
            machine = engine(specimen, 0)
            labels = machine.labels(factor * machine.critical())
            order = np.argsort(np.argsort(-np.bincount(labels, solid.volumes)))
            colours = colormaps["tab20"](order[labels[solid.sides[top, 0]]] % 20)
            axes = grid[row, column]
            axes.add_collection(PolyCollection(corner[top, :, :2], facecolors=colours, edgecolors=colours, lw=0.2))
            axes.set(xlim=(-0.52, 0.52), ylim=(-0.52, 0.52), aspect="equal", xticks=[], yticks=[])
            axes.set_title(f"{title}: {count_pieces(specimen, labels)} pieces", fontsize=7)
            if column == 0:
                axes.set_ylabel(name)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
