"""Charts of a study of hyperparameters: Pareto front, parallel coordinates and importances. Offline only.

They are drawn from the plain data of ``summary``, so that a committed trials.json can be drawn again.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.errors import MissingExtraError
from ..common.files import write_beside
from .tune_summary import MEASURES
from .view import as_png

try:
    import matplotlib
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
except ImportError as error:
    raise MissingExtraError("matplotlib", "plot") from error


def write_figures(results: dict[str, Any], out: Path) -> list[Path]:
    """Write trials.json and, if trials finished, pareto.png, parallel.png and importances.png.

    Parameters
    ----------
    results : dict
        What ``summary`` returns.
    out : Path
        An existing folder.

    Returns
    -------
    list of Path
        The files that were written.
    """
    files = {"trials.json": (json.dumps(results, indent=1) + "\n").encode()}
    if results["chosen"] is not None:
        figures = {"pareto": pareto_chart(results), "parallel": parallel_chart(results)}
        if results["importances"]:
            figures["importances"] = importance_chart(results)
        files |= {f"{name}.png": as_png(figure, 130) for name, figure in figures.items()}
    for name, data in files.items():
        write_beside(out / name, data)
    return [out / name for name in files]


def _finished(results: dict[str, Any]) -> list[dict[str, Any]]:
    """List the trials that finished."""
    return [trial for trial in results["trials"] if trial["state"] == "complete"]


def pareto_chart(results: dict[str, Any]) -> Figure:
    """Draw every trial by its time and error, the Pareto front and the choice (thesis, figures 5.2 and 5.6).

    Parameters
    ----------
    results : dict
        What ``summary`` returns, of a study with finished trials.

    Returns
    -------
    Figure
        The chart.
    """
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    finished = sorted(_finished(results), key=lambda trial: trial["seconds"])
    for front, colour, label in ((False, "0.65", "dominated trials"), (True, "crimson", "Pareto front")):
        points = [(trial["seconds"] * 1e3, trial["amae"]) for trial in finished if trial["front"] == front]
        if points:
            axes.plot(*zip(*points, strict=True), "o", color=colour, ms=4, mew=0, label=label)
        if front:
            axes.plot(*zip(*points, strict=True), color=colour, lw=1, drawstyle="steps-post")
    chosen = results["trials"][results["chosen"]]
    label = "chosen: " + ", ".join(f"{name} {_short(value)}" for name, value in chosen["parameters"].items())
    axes.plot(chosen["seconds"] * 1e3, chosen["amae"], "o", color="tab:blue", ms=9, mec="white", label=label)
    axes.set(xscale="log", yscale="log", xlabel="time of a query, ms", ylabel="AMAE, mean over the folds")
    axes.set_title(f"{results['search']['kind']}, {len(finished)} trials", fontsize=10)
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=7)
    return figure


def parallel_chart(results: dict[str, Any]) -> Figure:
    """Draw a line for each trial through its error and its hyperparameters (thesis, figures 5.3 and 5.7).

    Parameters
    ----------
    results : dict
        What ``summary`` returns, of a study with finished trials.

    Returns
    -------
    Figure
        The chart.
    """
    ranges = results["search"]["ranges"]
    finished = sorted(_finished(results), key=lambda trial: -trial["amae"])  # the best on top
    amae = np.array([trial["amae"] for trial in finished])
    columns = [("AMAE", amae, amae.min(), amae.max(), True)]
    for name, ends in ranges.items():
        values = np.array([trial["parameters"][name] for trial in finished], dtype=float)
        columns.append((name, values, ends["low"], ends["high"], ends["log"]))
    figure = Figure(figsize=(1.5 * len(columns) + 2, 4.2), layout="constrained")
    axes = figure.subplots()
    heights = np.stack([_height(values, low, high, log) for _, values, low, high, log in columns], axis=1)
    norm = LogNorm(amae.min(), max(amae.max(), amae.min() * 1.001))
    colours = matplotlib.colormaps["viridis"]
    places = range(len(columns))
    for trial, line in zip(finished, heights, strict=True):
        if trial["number"] != results["chosen"]:
            axes.plot(places, line, color=colours(norm(trial["amae"])), lw=0.8, alpha=0.7)
        else:
            chosen = line
    axes.plot(places, chosen, color="black", lw=2.2, marker="o", ms=4, label="chosen", zorder=5)
    for place, (_, _, low, high, log) in zip(places, columns, strict=True):
        axes.axvline(place, color="black", lw=0.8)
        ticks = np.geomspace(low, high, 5) if log else np.linspace(low, high, 5)
        if isinstance(low, int):
            ticks = np.round(ticks)
        for value, height in zip(ticks, _height(ticks, low, high, log), strict=True):
            box = {"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.5}
            axes.text(place + 0.04, height, _short(value), fontsize=7, va="center", zorder=6, bbox=box)
    axes.set_xticks(places, [name for name, *_ in columns])
    axes.set_yticks([])
    axes.set(xlim=(-0.1, len(columns) - 0.6), ylim=(-0.03, 1.03))
    axes.spines[:].set_visible(False)
    axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    figure.colorbar(matplotlib.cm.ScalarMappable(norm, "viridis"), ax=axes, label="AMAE", pad=0.01)
    return figure


def _height(values: npt.NDArray[np.float64], low: float, high: float, log: bool) -> npt.NDArray[np.float64]:
    """Place values on an axis from 0 to 1."""
    if high <= low:
        return np.full(len(values), 0.5)
    return np.log(values / low) / math.log(high / low) if log else (values - low) / (high - low)


def importance_chart(results: dict[str, Any]) -> Figure:
    """Draw a group of bars for each hyperparameter, a bar for each measure (thesis, figures 5.4 and 5.8).

    Parameters
    ----------
    results : dict
        What ``summary`` returns, of a study with importances.

    Returns
    -------
    Figure
        The chart.
    """
    measures, names = results["importances"], list(results["search"]["ranges"])
    figure = Figure(figsize=(7, 0.5 + 0.12 * len(measures) * len(names) + 0.25 * len(names)), layout="constrained")
    axes = figure.subplots()
    height = 0.8 / len(measures)
    for k, (measure, shares) in enumerate(measures.items()):
        where = np.arange(len(names)) + (k - (len(measures) - 1) / 2) * height
        axes.barh(where, [shares.get(name, 0.0) for name in names], height, label=MEASURES[measure])
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xlabel="importance by fANOVA", xlim=(0, 1))
    axes.grid(alpha=0.25, axis="x")
    axes.legend(fontsize=7)
    return figure


def _short(value: float) -> str:
    """Format a number for a chart."""
    return f"{value:.0f}" if value == round(value) else f"{value:.3g}"
