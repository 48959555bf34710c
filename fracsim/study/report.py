"""What an evaluation found, read out: the thesis's tables and figures with our rows in them. Offline only."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import pearsonr

from ..common.errors import MissingExtraError
from ..common.files import write_beside
from ..solids.surface import Surface
from .evaluate import kept_of, surface_of
from .plan import Plan
from .view import as_png, draw_mesh, view_frame

try:
    import matplotlib
    from matplotlib.figure import Figure
except ImportError as error:
    raise MissingExtraError("matplotlib", "plot") from error


Row = dict[str, Any]
THESIS = "MLP 704x7"
CONVOLUTION = "DeltaConv"
OURS = "field (default)"
FIVE = ("felzenszwalb", "hierarchical", "kmeans", "region_growing", "watershed")
COLUMNS: dict[str, Callable[[Row], str]] = {
    "AMAE": lambda r: _number(r.get("amae"), 4),
    "MSE": lambda r: _number(r.get("mse"), 4),
    "prediction, ms": lambda r: _ms(r.get("predict_ms")),
    "segmentation, ms": lambda r: _ms(r.get("segment_ms")),
    "p99, ms": lambda r: _ms({"median": r["predict_ms"]["p99"] + r["segment_ms"]["p99"]}) if _timed(r) else "–",
    "NetworkX, ms": lambda r: _ms(r.get("reference_ms")),
    "RC": lambda r: _number(r.get("rc"), 3),
    "BC": lambda r: _number(r.get("bc"), 3),
    "ARI": lambda r: _number(r.get("ari"), 3),
    "AMI": lambda r: _number(r.get("ami"), 3),
    "ARI ≥ 0.7": lambda r: "–" if r.get("accepted") is None else f"{r['accepted']:.0%}",
    "breaks or not": lambda r: f"{r['breaks']['balanced_accuracy']:.1%}" if r.get("breaks") else "–",
}
MAIN = ("AMAE", "prediction, ms", "segmentation, ms", "RC", "BC", "ARI", "AMI", "ARI ≥ 0.7", "breaks or not")
DRAWN = {THESIS: "mlp", CONVOLUTION: "deltaconv", OURS: "field"}
SHOWN = ("region_growing", "watershed", "hierarchical", "kmeans", "felzenszwalb", "midpoints and links", "atoms")
PARTED = "the thesis"


def write_report(plan: Plan, found: dict[str, Any], out: Path, work: Path, command: str) -> list[Path]:
    """Write accuracy.json, its chart, the tables as evaluation_*.md and the figures as evaluation_*.png.

    found: what ``evaluate`` says of the plan. work: its folder, for the pictures. Returns what was written.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows, published = found["rows"], found["plan"]["published"]
    told = [{**row, "model": f"{row['model']}, {PARTED}"} for row in published]
    texts = {"accuracy.json": json.dumps({"command": command, **found}, indent=1)}
    for name, table in _tables(plan, rows, told, found["fits"]).items():
        texts[f"evaluation_{name}.md"] = table
    written = []
    for name, text in texts.items():
        write_beside(out / name, (text.rstrip() + "\n").encode())
        written.append(out / name)
    figures = {
        "accuracy": _chart(rows, told),
        "evaluation_5_5": _correlation(rows),
        "evaluation_5_9": _fronts(plan.studies),
        "evaluation_breaks": _curves(rows),
    }
    pictures = {name: as_png(figure, 110) for name, figure in figures.items() if figure is not None}
    for mesh in plan.meshes:
        for model in plan.models:
            kept = kept_of(plan, mesh, model, work) if model.name in DRAWN and not mesh.splits else None
            if kept is not None:
                name = f"evaluation_grid_{mesh.name}_{DRAWN[model.name]}"
                title = f"{mesh.name}, {model.name}: held-out impulses"
                shown = [name for name in SHOWN if name in kept]
                pictures[name] = picture_grid(surface_of(mesh), kept, shown, title)
    for name, picture in pictures.items():
        write_beside(out / f"{name}.png", picture)
        written.append(out / f"{name}.png")
    return written


# Tables


def _tables(plan: Plan, rows: list[Row], told: list[Row], fits: list[Row]) -> dict[str, str]:
    measured = [mesh for mesh in plan.meshes if _of(rows, mesh=mesh.name)]
    base = [mesh.name for mesh in measured if not mesh.splits]
    first = measured[0].name if measured else ""
    finer = [mesh.name for mesh in measured if mesh.file == measured[0].file]
    tables = {}
    for name, mesh in (("5_10", first), *((f"a_{k}", mesh) for k, mesh in enumerate(base[1:], 1))):
        tables[name] = _table([*_of(told, mesh=mesh), *_of(rows, mesh=mesh)], ("model", "segmentation"), MAIN)
    chosen = [
        {**r["validation"], "model": r["model"], "split": "validation", "predict_ms": r["predict_ms"]}
        for r in _of(rows, mesh=first, segmentation="watershed")
        if r["model"] in (THESIS, CONVOLUTION)
    ]
    chosen += [
        {**r, "split": "test"}
        for r in _of(rows, mesh=first, segmentation="watershed")
        if r["model"] in (THESIS, CONVOLUTION)
    ]
    columns = ("AMAE", "prediction, ms", "BC", "RC", "MSE", "ARI", "AMI")
    chosen.sort(key=lambda r: (r["model"] != THESIS, r["split"] == "test"))
    tables["5_3"] = _table(chosen, ("model", "split"), columns)
    best = [r for r in _of(told, mesh=first, segmentation="watershed")] + _of(
        rows, mesh=first, segmentation="watershed"
    )
    tables["5_8"] = _table(best, ("model",), columns)
    consistent = [r for r in _of(told, mesh=first) if r.get("accepted") is not None] + [
        r for r in _of(rows, mesh=first) if r["model"] in (THESIS, OURS)
    ]
    tables["5_11"] = _table(consistent, ("model", "segmentation"), ("ARI", "ARI ≥ 0.7"))
    tables["5_12"] = _shapes(rows, base)
    tables["5_13"] = _sizes(rows, told, finer)
    sized = [
        r
        for mesh in finer
        for r in (
            *_of(told, mesh=mesh, model=f"{THESIS}, {PARTED}"),
            *(r for r in _of(rows, mesh=mesh) if r["model"] in (THESIS, OURS, "true field")),
        )
    ]
    tables["5_14"] = _table(sized, ("mesh", "model", "segmentation"), MAIN)
    tables["models"] = _best(rows, told, base, finer)
    tables["training"] = _trained(fits)
    return tables


def _best(rows: list[Row], told: list[Row], base: list[str], finer: list[str]) -> str:
    """Every model with the segmentation that suits it best, by ARI."""
    result = [
        max(_of(source, mesh=mesh, model=model), key=lambda r: r["ari"])
        for mesh in dict.fromkeys([*base, *finer])
        for source in (told, rows)
        for model in dict.fromkeys(r["model"] for r in _of(source, mesh=mesh))
    ]
    return _table(result, ("mesh", "model", "segmentation"), (*MAIN, "p99, ms"))


def _shapes(rows: list[Row], meshes: list[str]) -> str:
    lines = ["| method | " + " | ".join(f"{m}: ms | BC | ARI" for m in meshes) + " |"]
    lines.append("|---" * (1 + 3 * len(meshes)) + "|")
    for model in (THESIS, OURS):
        names = list(dict.fromkeys(r["segmentation"] for r in rows if r["model"] == model))
        amae = [_number(next((r["amae"] for r in _of(rows, mesh=m, model=model)), None), 4) for m in meshes]
        lines.append(f"| **{model}**, AMAE | " + " | ".join(f"{a} | | " for a in amae) + " |")
        for name in names:
            cells = []
            for mesh in meshes:
                row = next(iter(_of(rows, mesh=mesh, model=model, segmentation=name)), None)
                cells += (
                    ["–"] * 3
                    if row is None
                    else [
                        f"{row['segment_ms']['mean']:.3g} ± {row['segment_ms']['std']:.2g}",
                        f"{_number(row['bc'], 3)} ± {_number(row['bc_std'], 2)}",
                        f"{_number(row['ari'], 3)} ± {_number(row['ari_std'], 2)}",
                    ]
                )
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _sizes(rows: list[Row], told: list[Row], meshes: list[str]) -> str:
    """Segmentation times over resolutions: the thesis's, its algorithms in NetworkX here, and ours."""
    sizes = {m: next(r["vertices"] for r in rows if r["mesh"] == m) for m in meshes}
    lines = [
        "| method | " + " | ".join(f"{sizes[m]} vertices" for m in meshes) + " |",
        "|---" * (1 + len(meshes)) + "|",
    ]

    def line(name: str, source: list[Row], key: str, **which: str) -> None:
        found = [next(iter(_of(source, mesh=m, **which)), {}) for m in meshes]
        lines.append(f"| {name} | " + " | ".join(_ms(r.get(key)) for r in found) + " |")

    for name in FIVE:
        line(f"{name}, {PARTED}", told, "segment_ms", model=f"{THESIS}, {PARTED}", segmentation=name)
        line(f"{name}, NetworkX, here", rows, "reference_ms", model=OURS, segmentation=name)
        line(f"{name}, fast, the same partition", rows, "segment_ms", model=OURS, segmentation=name)
    for name in ("midpoints and links", "atoms"):
        line(f"{name} (ours)", rows, "segment_ms", model=OURS, segmentation=name)
    return "\n".join(lines)


def _trained(fits: list[Row]) -> str:
    lines = ["| mesh | model | rows | steps | seconds |", "|---|---|---|---|---|"]
    for fit in fits:
        if "fit_seconds" in fit:
            steps = f"{fit['steps']:.0f}" if "steps" in fit else "–"
            rows = f"{fit['rows']:.0f}" if "rows" in fit else "–"
            lines.append(f"| {fit['mesh']} | {fit['model']} | {rows} | {steps} | {fit['fit_seconds']:.0f} |")
    return "\n".join(lines)


def _table(rows: Iterable[Row], keys: tuple[str, ...], columns: tuple[str, ...]) -> str:
    lines = ["| " + " | ".join((*keys, *columns)) + " |", "|---" * (len(keys) + len(columns)) + "|"]
    lines += [
        "| " + " | ".join((*(str(row[k]) for k in keys), *(COLUMNS[c](row) for c in columns))) + " |" for row in rows
    ]
    return "\n".join(lines)


def _of(rows: Iterable[Row], **which: str) -> list[Row]:
    return [row for row in rows if all(row[key] == value for key, value in which.items())]


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _ms(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value['median'] if isinstance(value, dict) else value:.3g}"


def _timed(row: Row) -> bool:
    return isinstance(row.get("predict_ms"), dict) and isinstance(row.get("segment_ms"), dict)


# Figures


def _chart(rows: list[Row], told: list[Row]) -> Figure:
    """Run time against error: every model, segmentation and mesh on one chart."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots()
    measured = [r for r in rows if r["kind"] != "simulator" and r["predict_ms"]["median"] > 0]
    meshes = list(dict.fromkeys(r["mesh"] for r in (*rows, *told)))
    models = list(dict.fromkeys(r["model"] for r in measured))
    colours = dict(zip(models, matplotlib.color_sequences["tab20"], strict=False))
    marks = dict(zip(meshes, "os^DPX*v", strict=False))

    def place(row: Row) -> tuple[float, float]:
        spent = sum(
            v["median"] if isinstance(v, dict) else v or 0.0 for v in (row.get("predict_ms"), row["segment_ms"])
        )
        return spent, max(1.0 - row["ari"], 2e-4)

    for row in measured:
        axes.plot(*place(row), marks[row["mesh"]], color=colours[row["model"]], ms=5, alpha=0.75, mew=0)
    for row in told:
        axes.plot(*place(row), marks[row["mesh"]], mfc="none", color="black", ms=6, mew=0.9)
    points = sorted(place(r) for r in measured if r["kind"] not in ("precomputed", "nearest"))
    front: list[tuple[float, float]] = []
    for point in points:
        if not front or point[1] < front[-1][1]:
            front.append(point)
    if front:
        axes.plot(*np.array(front).T, "-", color="crimson", lw=1.5, drawstyle="steps-post")
    handles = [matplotlib.lines.Line2D([], [], marker="o", ls="", color=c, label=m) for m, c in colours.items()]
    hollow: Row = {"marker": "o", "ls": "", "mfc": "none", "color": "black"}
    handles.append(matplotlib.lines.Line2D([], [], label="the thesis (GPU, NetworkX, its own data)", **hollow))
    handles.append(matplotlib.lines.Line2D([], [], color="crimson", label="Pareto front of what is learned"))
    handles += [matplotlib.lines.Line2D([], [], marker=k, ls="", color="grey", label=m) for m, k in marks.items()]
    figure.legend(handles=handles, fontsize=8, loc="outside right upper")
    axes.set(xscale="log", yscale="log", xlabel="prediction and segmentation, median ms", ylabel="1 − ARI, test split")
    axes.grid(alpha=0.25, which="both")
    return figure


def _correlation(rows: list[Row]) -> Figure | None:
    """AMAE against boundary Chamfer, impulse by impulse (thesis, figure 5.5 and table 5.4)."""
    mesh = rows[0]["mesh"] if rows else ""
    shown = [r for r in _of(rows, mesh=mesh, segmentation="watershed") if r["model"] in (THESIS, CONVOLUTION, OURS)]
    if not shown:
        return None
    figure = Figure(figsize=(4.2 * len(shown), 3.6), layout="constrained")
    for axes, row in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        pairs = np.array(row["amae_and_bc"], dtype=float)
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        axes.plot(*pairs.T, ".", ms=4)
        title = row["model"]
        if len(pairs) > 2 and (np.ptp(pairs, axis=0) > 0).all():
            found = pearsonr(*pairs.T)
            title += f"\nr = {found.statistic:.2f}, p = {found.pvalue:.1g}"
        axes.set_title(title, fontsize=9)
        axes.set(xlabel="AMAE", ylabel="boundary Chamfer, watershed")
    return figure


def _curves(rows: list[Row]) -> Figure | None:
    """Share of impulses that break the body over severity / threshold; the truth is a step at 1."""
    shown = [r for r in rows if r.get("breaks") and r["segmentation"] == "atoms" and r["kind"] != "simulator"]
    meshes = list(dict.fromkeys(r["mesh"] for r in shown))
    if not shown:
        return None
    models = list(dict.fromkeys(r["model"] for r in shown))
    colours = dict(zip(models, matplotlib.color_sequences["tab20"], strict=False))
    figure = Figure(figsize=(3.2 * len(meshes) + 2.2, 3.4), layout="constrained")
    for axes, mesh in zip(figure.subplots(1, len(meshes), squeeze=False, sharey=True)[0], meshes, strict=True):
        for row in _of(shown, mesh=mesh):
            bins = np.array(row["breaks"]["bins"])
            curve = [np.nan if v is None else v for v in row["breaks"]["curve"]]
            axes.plot(np.sqrt(bins[1:] * bins[:-1]), curve, ".-", lw=1, color=colours[row["model"]])
        axes.step([bins[0], 1.0, bins[-1]], [0, 0, 1], where="pre", color="black", lw=0.8, ls=":")
        axes.set(xscale="log", xlabel="severity / threshold", title=mesh)
        axes.set_xticks((0.3, 0.5, 1, 2, 5), ("0.3", "0.5", "1", "2", "5"))
        axes.set_xticks((), minor=True)
    handles = [matplotlib.lines.Line2D([], [], marker=".", color=c, label=m) for m, c in colours.items()]
    figure.legend(handles=handles, fontsize=7, loc="outside right upper")
    figure.axes[0].set_ylabel("share that breaks")
    return figure


def _fronts(studies: Iterable[str]) -> Figure | None:
    """The Pareto fronts of tuning studies, one over the other (thesis, figures 5.2, 5.6 and 5.9)."""
    found = [(Path(study).parent.name, json.loads(Path(study).read_text(encoding="utf-8"))) for study in studies]
    if not found:
        return None
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for (name, study), colour in zip(found, matplotlib.color_sequences["tab10"], strict=False):
        trials = [trial for trial in study["trials"] if trial["amae"] is not None]
        points = np.array([[trial["seconds"] * 1e3, trial["amae"]] for trial in trials])
        front = np.array([trial["front"] for trial in trials])
        axes.plot(*points[~front].T, ".", color=colour, alpha=0.4)
        axes.plot(*points[front][np.argsort(points[front][:, 0])].T, "o-", color=colour, label=name)
        chosen = [trial["number"] for trial in trials].index(study["chosen"])
        axes.plot(*points[chosen], "o", color=colour, ms=10, mfc="none")
    axes.set(xscale="log", yscale="log", xlabel="ms, one query", ylabel="AMAE, validation folds")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.25, which="both")
    return figure


def picture_grid(surface: Surface, kept: dict[str, Any], names: list[str], title: str) -> bytes:
    """A sheet like the thesis's figures 5.10 to 5.12, as PNG: an impulse a column; true field, predicted field, true
    pieces, and one row for each segmentation in ``names``."""
    count = min(len(kept[name]) for name in ("true", "predicted", "labels", *names))
    lines = ["true field", "predicted field", "true pieces", *names]
    figure = Figure(figsize=(1.9 * count + 1, 1.75 * len(lines)), layout="constrained")
    axes = figure.subplots(len(lines), count, squeeze=False)
    cap = float(kept["true"].max())
    for k in range(count):
        near = kept["true"][k] < 0.02
        outward = surface.vertices[near].mean(axis=0) if near.any() else np.array([1.0, 0.0, 0.0])
        frame = view_frame(outward)
        for axis, name in zip(axes[:, k], lines, strict=True):
            if name.endswith("field"):
                udf = kept["true" if name.startswith("true") else "predicted"][k]
                colours = matplotlib.colormaps["Reds"](udf[surface.faces].mean(axis=1) / cap)
            else:
                labels = kept["labels" if name == "true pieces" else name][k]
                order = np.argsort(-np.bincount(labels), kind="stable")  # the largest pieces get the same colours
                rank = np.empty(len(order), dtype=np.int64)
                rank[order] = np.arange(len(order))
                colours = matplotlib.colormaps["tab20"](rank[labels[surface.faces[:, 0]]] % 20)
            draw_mesh(axis, surface.vertices, surface.faces, colours, frame)
            axis.set_axis_off()
    for axis, name in zip(axes[:, 0], lines, strict=True):
        axis.set_title(name, fontsize=8, loc="left")
    figure.suptitle(title, fontsize=9)
    return as_png(figure, 80)
