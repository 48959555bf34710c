"""TODO bench.stability.report."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ...common.arrays import FloatArray
from ...common.errors import MissingExtraError
from ...common.files import write_beside
from .scenes import FAMILIES
from .stage import RANGES, Row

# Reading it


def table(figures: dict[str, Any]) -> str:
    """What held and what did not, as Markdown: by family, by kind of failure, and cell by cell what failed."""
    rows: list[Row] = figures["rows"]
    names = [name for name in FAMILIES if any(row["cell"]["family"] == name for row in rows)]
    kinds = sorted({kind for row in rows for kind in (*row["failures"], *row["engine"])})
    left = f" {figures['left']} cells were not played for want of time." if figures["left"] else ""
    lines = [
        f"{figures['cells']} cells (seed {figures['seed']}) in {figures['seconds']:.0f} s; {figures['broke']} broke "
        f"({figures['broke'] / max(figures['cells'], 1):.0%}), {figures['failed']} failed; "
        f"the slowest took {max(row['seconds'] for row in rows):.0f} s.{left}",
        "",
        "A cell fails by what its twin, the same scene with bodies that cannot break, does not do as well; what the",
        "twin does too is the engine's. Momentum: worst change of the total over Σ|p|. Energy: worst gain, over what",
        "there was and gravity's work. Both are the worst of any step, over the cells that check them.",
        "",
        "| family | cells | broke | pieces, median | failed | engine's | worst momentum | worst energy | s a cell |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in [*names, "all"]:
        own = [row for row in rows if name in ("all", row["cell"]["family"])]
        pieces = [row["live"]["pieces"] for row in own if row["broke"]]
        lines.append(
            f"| {name} | {len(own)} | {sum(row['broke'] for row in own)} | {np.median(pieces) if pieces else 0:.0f} "
            f"| {sum(bool(row['failures']) for row in own)} | {sum(bool(row['engine']) for row in own)} "
            f"| {_worst(own, 'momentum')} | {_worst(own, 'energy')} "
            f"| {np.mean([row['seconds'] for row in own]):.2f} |"
        )
    if kinds:
        lines += ["", "| violated: ours / the engine's | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
        for name in [*names, "all"]:
            own = [row for row in rows if name in ("all", row["cell"]["family"])]
            counts = [(sum(k in row["failures"] for row in own), sum(k in row["engine"] for row in own)) for k in kinds]
            if any(map(any, counts)):
                lines.append(f"| {name} | " + " | ".join(f"{a} / {b}" if a or b else "" for a, b in counts) + " |")
    failed = [row for row in rows if row["failures"]]
    if failed:
        lines += [
            "",
            "What failed. With a gain of energy: how much of all energy was rotation then. Turn: rad, the farthest",
            "that a piece turned in one step; beyond 0.2 the engine's own integration of a free spin gains energy.",
            "Overlap: of the size, how deep new pieces stood in each other or in what had hit their parent, which the",
            "engine turns into speed; it is small against what is fast and much against what is slow.",
            "",
            "| family | what | time step | m/s | density ratio | m | n | mesh | other | severity "
            "| found | turn | overlap | seed |",
            "|---" * 14 + "|",
        ]
    lines += [_line(row) for row in failed]
    notes: dict[str, int] = {}
    for row in rows:
        for note in row["live"]["notes"]:
            notes[note] = notes.get(note, 0) + 1
    if notes:
        lines += ["", "Told by the scenes: " + ", ".join(f"{note} ({count})" for note, count in notes.items()) + "."]
    return "\n".join(lines)


def _worst(rows: Iterable[Row], name: str) -> str:
    values = [row["live"]["residuals"].get(name) for row in rows]
    found = [value for value in values if value is not None]
    return f"{max(found):.1e}" if found else "–"


def _line(row: Row) -> str:
    cell, live = row["cell"], row["live"]
    found = []
    for kind in row["failures"]:
        residual = live["residuals"].get(kind)
        text = live["broken"].get(kind, "") if residual is None else f"{residual:.2g}"
        if kind == "energy" and residual is not None:
            text += f" ({live['spinning']:.0%} rotation)"
        found.append(text.replace("|", "/"))
    return (
        f"| {cell['family']} {cell['variant']} | {', '.join(row['failures'])} | 1/{1 / cell['time_step']:.0f} "
        f"| {cell['speed']:.3g} | {cell['density_ratio']:.2g} | {cell['size']:.2g} | {cell['breakables']} "
        f"| {cell['mesh']} | {cell['other']} | {cell['severity']:.2g} | {'; '.join(found)} "
        f"| {live.get('turn', 0.0):.2g} | {live.get('overlap', 0.0):.2g} | {cell['seed']} |"
    )


def draw(figures: dict[str, Any], path: Path) -> None:
    """A picture of the matrix: what momentum and energy did over time step and speed, what failed over density ratio
    and size, and each family.

    Raises MissingExtraError without matplotlib.
    """
    try:
        from matplotlib.colors import LogNorm
        from matplotlib.figure import Figure
        from matplotlib.ticker import FuncFormatter
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot") from error
    rows: list[Row] = figures["rows"]
    matrix = [row for row in rows if row["cell"]["family"] == "matrix"]
    figure = Figure(figsize=(13, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    figure.suptitle(f"{figures['cells']} scenes, {figures['broke']} broke, {figures['failed']} failed")
    labels = {"time_step": "time step, s", "speed": "speed, m/s", "density_ratio": "density ratio", "size": "size, m"}

    def bins(name: str, count: int) -> FloatArray:
        low, high = RANGES[name]
        return np.geomspace(low * (1 - 1e-9), high * (1 + 1e-9), count + 1)

    def grid(axis: Any, x: str, y: str, of: Callable[[list[Row]], float], **style: Any) -> None:
        across, up = bins(x, 6), bins(y, 5)
        values = np.full((5, 6), np.nan)
        for (j, i), _ in np.ndenumerate(values):
            own = [
                row
                for row in matrix
                if across[i] <= row["cell"][x] < across[i + 1] and up[j] <= row["cell"][y] < up[j + 1]
            ]
            if own:
                values[j, i] = of(own)
                failed = sum(bool(row["failures"]) for row in own)
                place = np.sqrt(across[i] * across[i + 1]), np.sqrt(up[j] * up[j + 1])
                axis.text(*place, f"{failed}/{len(own)}", ha="center", va="center", fontsize=9)
        mesh = axis.pcolormesh(across, up, values, edgecolor="white", **style)
        axis.set(xscale="log", yscale="log", xlabel=labels[x], ylabel=labels[y])
        if y == "time_step":
            steps = [1 / 2000, 1 / 1000, 1 / 500, 1 / 240, 1 / 120, 1 / 60]
            axis.set_yticks(steps, minor=False)
            axis.set_yticks([], minor=True)
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"1/{1 / value:.0f}"))
        figure.colorbar(mesh, ax=axis)

    def worst(name: str, floor: float) -> Callable[[list[Row]], float]:
        def of(own: list[Row]) -> float:
            values = [row["live"]["residuals"].get(name) for row in own if name not in row["engine"]]
            return max([floor, *(value for value in values if value is not None)])

        return of

    def share(own: list[Row]) -> float:
        return sum(bool(row["failures"]) for row in own) / len(own)

    color = {"cmap": "RdYlGn_r"}
    grid(axes[0, 0], "speed", "time_step", worst("momentum", 1e-16), norm=LogNorm(1e-16, 1e-3), **color)
    axes[0, 0].set_title("worst change of momentum, of Σ|p| (failed / cells)")
    grid(axes[0, 1], "speed", "time_step", worst("energy", 1e-4), norm=LogNorm(1e-4, 1e2), **color)
    axes[0, 1].set_title("worst gain of energy, relative, where the twin has none (failed / cells)")
    grid(axes[1, 0], "density_ratio", "size", share, vmin=0.0, vmax=1.0, **color)
    axes[1, 0].set_title("share that failed (failed / cells)")
    names = [name for name in FAMILIES if any(row["cell"]["family"] == name for row in rows)][::-1]
    left = np.zeros(len(names))
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
        axes[1, 1].barh(names, width, left=left, color=shade, label=label)
        left += width
    axes[1, 1].set_yticks(range(len(names)), [f"{name} ({total})" for name, total in zip(names, totals, strict=True)])
    axes[1, 1].set(xlim=(0, 1), title="families (cells)")
    axes[1, 1].legend(loc="lower center", bbox_to_anchor=(0.5, -0.2), ncols=4, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_beside(path, buffer.getvalue())
