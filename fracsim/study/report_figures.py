"""The charts and picture sheets of an evaluation. Offline only; ``write_report`` uses it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import pearsonr

from ..common.errors import MissingExtraError
from ..solids.surface import Surface
from .segmenters import ATOMS
from .view import draw_mesh, view_frame

try:
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ImportError as error:
    raise MissingExtraError("matplotlib", "plot") from error

Row = dict[str, Any]
LOWEST = 2e-4  # 1 - ARI below this is drawn here, because a logarithmic axis has no 0
NEAR = 0.02  # of the largest extent: vertices this close to a crack say from where a picture is taken


def rows_with(rows: Iterable[Row], **values: str) -> list[Row]:
    """Select rows.

    Parameters
    ----------
    rows : iterable of dict
        Rows of ``evaluate``.
    **values : str
        The values that a row must have, by name.

    Returns
    -------
    list of dict
        The rows that have them all, in order.
    """
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def accuracy_chart(rows: list[Row], published: list[Row]) -> Figure:
    """Draw time against error: every model, segmentation and mesh in one chart.

    Parameters
    ----------
    rows : list of dict
        Rows of ``evaluate``.
    published : list of dict
        Rows that others published.

    Returns
    -------
    Figure
        The chart.
    """
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots()
    measured = [r for r in rows if r["kind"] != "simulator" and r["predict_ms"]["median"] > 0]
    meshes = list(dict.fromkeys(r["mesh"] for r in (*rows, *published)))
    models = list(dict.fromkeys(r["model"] for r in measured))
    colours = dict(zip(models, matplotlib.color_sequences["tab20"], strict=False))
    markers = dict(zip(meshes, "os^DPX*v", strict=False))

    def place(row: Row) -> tuple[float, float]:
        """Time and error of a row."""
        spent = sum(
            v["median"] if isinstance(v, dict) else v or 0.0 for v in (row.get("predict_ms"), row["segment_ms"])
        )
        return spent, max(1.0 - row["ari"], LOWEST)

    for row in measured:
        axes.plot(*place(row), markers[row["mesh"]], color=colours[row["model"]], ms=5, alpha=0.75, mew=0)
    for row in published:
        axes.plot(*place(row), markers[row["mesh"]], mfc="none", color="black", ms=6, mew=0.9)
    points = sorted(place(r) for r in measured if r["kind"] not in ("precomputed", "nearest"))
    front: list[tuple[float, float]] = []
    for point in points:
        if not front or point[1] < front[-1][1]:
            front.append(point)
    if front:
        axes.plot(*np.array(front).T, "-", color="crimson", lw=1.5, drawstyle="steps-post")
    handles = [Line2D([], [], marker="o", ls="", color=c, label=m) for m, c in colours.items()]
    hollow: Row = {"marker": "o", "ls": "", "mfc": "none", "color": "black"}
    handles.append(Line2D([], [], label="the thesis (on a GPU, NetworkX, its own data)", **hollow))
    handles.append(Line2D([], [], color="crimson", label="Pareto front of the learned models"))
    handles += [Line2D([], [], marker=k, ls="", color="grey", label=m) for m, k in markers.items()]
    figure.legend(handles=handles, fontsize=8, loc="outside right upper")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="median time of prediction and segmentation, ms",
        ylabel="1 − ARI, test split",
    )
    axes.grid(alpha=0.25, which="both")
    return figure


def correlation_chart(rows: list[Row], models: tuple[str, ...]) -> Figure | None:
    """Draw AMAE against boundary Chamfer distance, a point an impulse (thesis, figure 5.5 and table 5.4).

    Parameters
    ----------
    rows : list of dict
        Rows of ``evaluate``.
    models : tuple of str
        Names of the models to draw.

    Returns
    -------
    Figure or None
        The chart of the first mesh, or None if none of these models is measured on it.
    """
    mesh = rows[0]["mesh"] if rows else ""
    shown = [r for r in rows_with(rows, mesh=mesh, segmentation="watershed") if r["model"] in models]
    if not shown:
        return None
    figure = Figure(figsize=(4.2 * len(shown), 3.6), layout="constrained")
    for axes, row in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        pairs = np.array(row["amae_and_bc"], dtype=float)
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        axes.plot(*pairs.T, ".", ms=4)
        title = row["model"]
        if len(pairs) > 2 and (np.ptp(pairs, axis=0) > 0).all():
            correlation = pearsonr(*pairs.T)
            title += f"\nr = {correlation.statistic:.2f}, p = {correlation.pvalue:.1g}"
        axes.set_title(title, fontsize=9)
        axes.set(xlabel="AMAE", ylabel="boundary Chamfer distance, watershed")
    return figure


def break_curves(rows: list[Row]) -> Figure | None:
    """Draw the share of impulses that are predicted to break the body, by severity divided by threshold.

    The true curve is a step at 1.

    Parameters
    ----------
    rows : list of dict
        Rows of ``evaluate``.

    Returns
    -------
    Figure or None
        A chart for each mesh, or None if no model is measured.
    """
    shown = [r for r in rows if r.get("breaks") and r["segmentation"] == ATOMS and r["kind"] != "simulator"]
    meshes = list(dict.fromkeys(r["mesh"] for r in shown))
    if not shown:
        return None
    models = list(dict.fromkeys(r["model"] for r in shown))
    colours = dict(zip(models, matplotlib.color_sequences["tab20"], strict=False))
    figure = Figure(figsize=(3.2 * len(meshes) + 2.2, 3.4), layout="constrained")
    for axes, mesh in zip(figure.subplots(1, len(meshes), squeeze=False, sharey=True)[0], meshes, strict=True):
        for row in rows_with(shown, mesh=mesh):
            bins = np.array(row["breaks"]["bins"])
            curve = [np.nan if v is None else v for v in row["breaks"]["curve"]]
            axes.plot(np.sqrt(bins[1:] * bins[:-1]), curve, ".-", lw=1, color=colours[row["model"]])
        axes.step([bins[0], 1.0, bins[-1]], [0, 0, 1], where="pre", color="black", lw=0.8, ls=":")
        axes.set(xscale="log", xlabel="severity / threshold", title=mesh)
        axes.set_xticks((0.3, 0.5, 1, 2, 5), ("0.3", "0.5", "1", "2", "5"))
        axes.set_xticks((), minor=True)
    handles = [Line2D([], [], marker=".", color=c, label=m) for m, c in colours.items()]
    figure.legend(handles=handles, fontsize=7, loc="outside right upper")
    figure.axes[0].set_ylabel("share predicted to break")
    return figure


def pareto_chart(studies: Iterable[str]) -> Figure | None:
    """Draw the Pareto fronts of tuning studies in one chart (thesis, figures 5.2, 5.6 and 5.9).

    Parameters
    ----------
    studies : iterable of str
        Paths of ``trials.json`` files, each in a folder named after its study.

    Returns
    -------
    Figure or None
        The chart, or None if there are no studies.
    """
    results = [(Path(study).parent.name, json.loads(Path(study).read_text(encoding="utf-8"))) for study in studies]
    if not results:
        return None
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for (name, study), colour in zip(results, matplotlib.color_sequences["tab10"], strict=False):
        trials = [trial for trial in study["trials"] if trial["amae"] is not None]
        points = np.array([[trial["seconds"] * 1e3, trial["amae"]] for trial in trials])
        front = np.array([trial["front"] for trial in trials])
        axes.plot(*points[~front].T, ".", color=colour, alpha=0.4)
        axes.plot(*points[front][np.argsort(points[front][:, 0])].T, "o-", color=colour, label=name)
        chosen = [trial["number"] for trial in trials].index(study["chosen"])
        axes.plot(*points[chosen], "o", color=colour, ms=10, mfc="none")
    axes.set(xscale="log", yscale="log", xlabel="time of a query, ms", ylabel="AMAE, mean over the folds")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.25, which="both")
    return figure


def picture_grid(
    surface: Surface, pictured: dict[str, npt.NDArray[Any]], segmentations: list[str], title: str
) -> Figure:
    """Draw fields and pieces as in the thesis's figures 5.10 to 5.12, one impulse in each column.

    Parameters
    ----------
    surface : Surface
        The mesh.
    pictured : dict of str to ndarray
        ``true`` and ``predicted`` fields (N, V), true ``labels`` (N, V), and labels (N, V) by each segmentation.
    segmentations : list of str
        Names of the segmentations to draw, a row each.
    title : str
        The title of the sheet.

    Returns
    -------
    Figure
        Rows for the true field, the predicted field, the true pieces and each segmentation.
    """
    count = min(len(pictured[name]) for name in ("true", "predicted", "labels", *segmentations))
    lines = ["true field", "predicted field", "true pieces", *segmentations]
    figure = Figure(figsize=(1.9 * count + 1, 1.75 * len(lines)), layout="constrained")
    axes = figure.subplots(len(lines), count, squeeze=False)
    cap = float(pictured["true"].max())
    for k in range(count):
        near = pictured["true"][k] < NEAR
        outward = surface.vertices[near].mean(axis=0) if near.any() else np.array([1.0, 0.0, 0.0])
        frame = view_frame(outward)
        for axis, name in zip(axes[:, k], lines, strict=True):
            if name.endswith("field"):
                udf = pictured["true" if name.startswith("true") else "predicted"][k]
                colours = matplotlib.colormaps["Reds"](udf[surface.faces].mean(axis=1) / cap)
            else:
                labels = pictured["labels" if name == "true pieces" else name][k]
                order = np.argsort(-np.bincount(labels), kind="stable")  # the largest pieces get the same colours
                rank = np.empty(len(order), dtype=np.int64)
                rank[order] = np.arange(len(order))
                colours = matplotlib.colormaps["tab20"](rank[labels[surface.faces[:, 0]]] % 20)
            draw_mesh(axis, surface.vertices, surface.faces, colours, frame)
            axis.set_axis_off()
    for axis, name in zip(axes[:, 0], lines, strict=True):
        axis.set_title(name, fontsize=8, loc="left")
    figure.suptitle(title, fontsize=9)
    return figure
