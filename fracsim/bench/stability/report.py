"""What the stress matrix found, as a table and as a picture.

The command line uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ...common.arrays import FloatArray
from ..picture import new_figure, save_figure
from .cells import RANGES, Row
from .scenes import FAMILIES


def table(figures: dict[str, Any]) -> str:
    """Write the figures as Markdown.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.

    Returns
    -------
    str
        What held and what did not: by family, by kind of failure, and what failed cell by cell.
    """
    rows: list[Row] = figures["rows"]
    names = [name for name in FAMILIES if any(row["cell"]["family"] == name for row in rows)]
    kinds = sorted({kind for row in rows for kind in (*row["failures"], *row["engine"])})
    unplayed = f" {figures['left']} cells were not played, as the time was over." if figures["left"] else ""
    lines = [
        f"{figures['cells']} cells (seed {figures['seed']}) in {figures['seconds']:.0f} s; {figures['broke']} broke "
        f"({figures['broke'] / max(figures['cells'], 1):.0%}), {figures['failed']} failed; "
        f"the slowest took {max(row['seconds'] for row in rows):.0f} s.{unplayed}",
        "",
        "Each cell is compared with its twin, the same scene with bodies that cannot break. What both violate is the",
        "engine's; a cell fails only by what its twin does not do. Momentum: largest change of the total, over Σ|p|.",
        "Energy: largest gain, over what there was and gravity's work. Both are the largest of any step, over the",
        "cells that check them.",
        "",
        "| family | cells | broke | pieces, median | failed | engine's | worst momentum | worst energy | s a cell |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in [*names, "all"]:
        chosen = [row for row in rows if name in ("all", row["cell"]["family"])]
        pieces = [row["live"]["pieces"] for row in chosen if row["broke"]]
        lines.append(
            f"| {name} | {len(chosen)} | {sum(row['broke'] for row in chosen)} "
            f"| {np.median(pieces) if pieces else 0:.0f} "
            f"| {sum(bool(row['failures']) for row in chosen)} | {sum(bool(row['engine']) for row in chosen)} "
            f"| {_worst(chosen, 'momentum')} | {_worst(chosen, 'energy')} "
            f"| {np.mean([row['seconds'] for row in chosen]):.2f} |"
        )
    if kinds:
        lines += ["", "| violated: ours / the engine's | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
        for name in [*names, "all"]:
            chosen = [row for row in rows if name in ("all", row["cell"]["family"])]
            counts = [
                (sum(k in row["failures"] for row in chosen), sum(k in row["engine"] for row in chosen)) for k in kinds
            ]
            if any(map(any, counts)):
                lines.append(f"| {name} | " + " | ".join(f"{a} / {b}" if a or b else "" for a, b in counts) + " |")
    failed = [row for row in rows if row["failures"]]
    if failed:
        lines += [
            "",
            "What failed. With a gain of energy: the share of rotation in all energy then. Turn: the largest angle in",
            "rad that a piece turned in one step; beyond 0.2 the engine's own integration of a free spin gains energy.",
            "Overlap: how deep new pieces stood in each other or in what had hit their parent, over the size. The",
            "engine turns it into speed, which is small for what is fast and large for what is slow.",
            "",
            "| family | what | time step | m/s | density ratio | m | n | mesh | other | severity "
            "| value | turn | overlap | seed |",
            "|---" * 14 + "|",
        ]
    lines += [_line(row) for row in failed]
    notes: dict[str, int] = {}
    for row in rows:
        for note in row["live"]["notes"]:
            notes[note] = notes.get(note, 0) + 1
    if notes:
        lines += ["", "Notes of the scenes: " + ", ".join(f"{note} ({count})" for note, count in notes.items()) + "."]
    return "\n".join(lines)


def _worst(rows: Iterable[Row], name: str) -> str:
    """Write the largest residual of a name; a dash where no row checks it."""
    residuals = [row["live"]["residuals"].get(name) for row in rows]
    values = [residual for residual in residuals if residual is not None]
    return f"{max(values):.1e}" if values else "–"


def _line(row: Row) -> str:
    """Write a row of the table of failures."""
    cell, live = row["cell"], row["live"]
    values = []
    for kind in row["failures"]:
        residual = live["residuals"].get(kind)
        text = live["broken"].get(kind, "") if residual is None else f"{residual:.2g}"
        if kind == "energy" and residual is not None:
            text += f" ({live['spinning']:.0%} rotation)"
        values.append(text.replace("|", "/"))
    return (
        f"| {cell['family']} {cell['variant']} | {', '.join(row['failures'])} | 1/{1 / cell['time_step']:.0f} "
        f"| {cell['speed']:.3g} | {cell['density_ratio']:.2g} | {cell['size']:.2g} | {cell['breakables']} "
        f"| {cell['mesh']} | {cell['other']} | {cell['severity']:.2g} | {'; '.join(values)} "
        f"| {live.get('turn', 0.0):.2g} | {live.get('overlap', 0.0):.2g} | {cell['seed']} |"
    )


Figure = Callable[[list[Row]], float]  # a figure of some rows
LABELS = {"time_step": "time step, s", "speed": "speed, m/s", "density_ratio": "density ratio", "size": "size, m"}
COLUMNS, ROWS = 6, 5  # of a panel
STEP_TICKS = (1 / 2000, 1 / 1000, 1 / 500, 1 / 240, 1 / 120, 1 / 60)  # s


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw the matrix.

    Two panels show momentum and energy over time step and speed, one what failed over density ratio and size, and one
    each family.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.
    path : Path
        The PNG file to write.

    Raises
    ------
    MissingExtraError
        If Matplotlib is not installed.
    """
    figure = new_figure(13, 9, constrained=True)
    from matplotlib.colors import LogNorm

    rows: list[Row] = figures["rows"]
    matrix = [row for row in rows if row["cell"]["family"] == "matrix"]
    axes = figure.subplots(2, 2)
    figure.suptitle(f"{figures['cells']} scenes, {figures['broke']} broke, {figures['failed']} failed")

    def largest(name: str, floor: float) -> Figure:
        def of(chosen: list[Row]) -> float:
            values = [row["live"]["residuals"].get(name) for row in chosen if name not in row["engine"]]
            return max([floor, *(value for value in values if value is not None)])

        return of

    def share(chosen: list[Row]) -> float:
        return sum(bool(row["failures"]) for row in chosen) / len(chosen)

    norm = LogNorm(1e-16, 1e-3)
    _panel(axes[0, 0], matrix, "speed", "time_step", largest("momentum", 1e-16), norm=norm)
    axes[0, 0].set_title("largest change of momentum, over Σ|p| (failed / cells)")
    norm = LogNorm(1e-4, 1e2)
    _panel(axes[0, 1], matrix, "speed", "time_step", largest("energy", 1e-4), norm=norm)
    axes[0, 1].set_title("largest gain of energy, relative, where the twin has none (failed / cells)")
    _panel(axes[1, 0], matrix, "density_ratio", "size", share, vmin=0.0, vmax=1.0)
    axes[1, 0].set_title("share that failed (failed / cells)")
    _families(axes[1, 1], rows)
    save_figure(figure, path)


def _bins(name: str, count: int) -> FloatArray:
    """Divide an axis of the matrix evenly in its logarithm."""
    low, high = RANGES[name]
    return np.geomspace(low * (1 - 1e-9), high * (1 + 1e-9), count + 1)


def _panel(axis: Any, matrix: list[Row], x: str, y: str, of: Figure, **style: Any) -> None:
    """Draw a figure of the cells over two of their axes, and how many of how many failed."""
    from matplotlib.ticker import FuncFormatter

    across, up = _bins(x, COLUMNS), _bins(y, ROWS)
    values = np.full((ROWS, COLUMNS), np.nan)
    for (j, i), _ in np.ndenumerate(values):
        chosen = [
            row for row in matrix if across[i] <= row["cell"][x] < across[i + 1] and up[j] <= row["cell"][y] < up[j + 1]
        ]
        if chosen:
            values[j, i] = of(chosen)
            failed = sum(bool(row["failures"]) for row in chosen)
            place = np.sqrt(across[i] * across[i + 1]), np.sqrt(up[j] * up[j + 1])
            axis.text(*place, f"{failed}/{len(chosen)}", ha="center", va="center", fontsize=9)
    mesh = axis.pcolormesh(across, up, values, edgecolor="white", cmap="RdYlGn_r", **style)
    axis.set(xscale="log", yscale="log", xlabel=LABELS[x], ylabel=LABELS[y])
    if y == "time_step":
        axis.set_yticks(STEP_TICKS, minor=False)
        axis.set_yticks([], minor=True)
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"1/{1 / value:.0f}"))
    axis.figure.colorbar(mesh, ax=axis)


def _families(axis: Any, rows: list[Row]) -> None:
    """Draw a bar for each family: the shares of cells that held and that failed."""
    names = [name for name in FAMILIES if any(row["cell"]["family"] == name for row in rows)][::-1]
    start = np.zeros(len(names))
    verdicts: tuple[tuple[str, str, Callable[[Row], bool]], ...] = (
        ("held, broke", "#4c9f70", lambda row: not row["failures"] and not row["engine"] and row["broke"]),
        ("held, did not break", "#b8d8c0", lambda row: not row["failures"] and not row["engine"] and not row["broke"]),
        ("the engine's", "#b0b0b0", lambda row: not row["failures"] and bool(row["engine"])),
        ("failed", "#c8452f", lambda row: bool(row["failures"])),
    )
    totals = [sum(row["cell"]["family"] == name for row in rows) for name in names]
    for label, shade, belongs in verdicts:
        counts = np.array([sum(row["cell"]["family"] == name and belongs(row) for row in rows) for name in names])
        width = counts / np.array(totals)
        axis.barh(names, width, left=start, color=shade, label=label)
        start += width
    axis.set_yticks(range(len(names)), [f"{name} ({total})" for name, total in zip(names, totals, strict=True)])
    axis.set(xlim=(0, 1), title="families (cells)")
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, -0.2), ncols=4, frameon=False)
