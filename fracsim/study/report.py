"""The report of an evaluation: the thesis's tables and figures with our rows in them. Offline only."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..common.files import write_beside
from ..segmentation import METHODS
from .plan import Plan
from .report_figures import (
    Row,
    accuracy_chart,
    break_curves,
    correlation_chart,
    pareto_chart,
    picture_grid,
    rows_with,
)
from .segmenters import ATOMS, MIDPOINTS
from .view import as_png
from .work_folder import read_pictured, result_path, surface_of

# Names in benchmarks/evaluation.toml of the models that the thesis's tables compare.
PERCEPTRON = "MLP 704x7"  # the thesis's choice
CONVOLUTION = "DeltaConv"
DEFAULT = "field (default)"  # ours
THESIS_METHODS = ("felzenszwalb", "hierarchical", "kmeans", "region_growing", "watershed")
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
PICTURED = {PERCEPTRON: "mlp", CONVOLUTION: "deltaconv", DEFAULT: "field"}  # name in the plan -> in the file name
GRID_ROWS = ("region_growing", "watershed", "hierarchical", "kmeans", "felzenszwalb", MIDPOINTS, ATOMS)
PUBLISHED = "the thesis"  # how rows that others published are marked


def write_report(plan: Plan, results: dict[str, Any], out: Path, work: Path, command: str) -> list[Path]:
    """Write accuracy.json, its chart, the tables as evaluation_*.md and the figures as evaluation_*.png.

    Parameters
    ----------
    plan : Plan
        The plan.
    results : dict
        What ``evaluate`` returns.
    out : Path
        The folder to write to; it is made if it is missing.
    work : Path
        The work folder, which holds the fields and pieces for pictures.
    command : str
        The command that gave the results, for accuracy.json.

    Returns
    -------
    list of Path
        The files that were written.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = results["rows"]
    published = [{**row, "model": f"{row['model']}, {PUBLISHED}"} for row in results["plan"]["published"]]
    texts = {"accuracy.json": json.dumps({"command": command, **results}, indent=1)}
    for name, table in _tables(plan, rows, published, results["fits"]).items():
        texts[f"evaluation_{name}.md"] = table
    figures = {
        "accuracy": accuracy_chart(rows, published),
        "evaluation_5_5": correlation_chart(rows, (PERCEPTRON, CONVOLUTION, DEFAULT)),
        "evaluation_5_9": pareto_chart(plan.studies),
        "evaluation_breaks": break_curves(rows),
    }
    files = {name: (text.rstrip() + "\n").encode() for name, text in texts.items()}
    files |= {f"{name}.png": as_png(figure, 110) for name, figure in figures.items() if figure is not None}
    files |= _grids(plan, work)
    for name, data in files.items():
        write_beside(out / name, data)
    return [out / name for name in files]


def _grids(plan: Plan, work: Path) -> dict[str, bytes]:
    """Sheets of pictures for the models of the thesis and for ours, as PNG by their file names."""
    sheets = {}
    for mesh in plan.meshes:
        for model in plan.models:
            pictured = read_pictured(result_path(plan, mesh, model, work))
            if model.name in PICTURED and not mesh.splits and pictured is not None:
                names = [name for name in dict.fromkeys((*GRID_ROWS, *METHODS)) if name in pictured]
                title = f"{mesh.name}, {model.name}: test impulses"
                sheet = picture_grid(surface_of(mesh), pictured, names, title)
                sheets[f"evaluation_grid_{mesh.name}_{PICTURED[model.name]}.png"] = as_png(sheet, 80)
    return sheets


def _tables(plan: Plan, rows: list[Row], published: list[Row], fits: list[Row]) -> dict[str, str]:
    """All tables as Markdown, by the numbers of the thesis's tables."""
    measured = [mesh for mesh in plan.meshes if rows_with(rows, mesh=mesh.name)]
    base = [mesh.name for mesh in measured if not mesh.splits]
    first = measured[0].name if measured else ""
    finer = [mesh.name for mesh in measured if mesh.file == measured[0].file]
    tables = {}
    for name, mesh in (("5_10", first), *((f"a_{k}", mesh) for k, mesh in enumerate(base[1:], 1))):
        tables[name] = _table(
            [*rows_with(published, mesh=mesh), *rows_with(rows, mesh=mesh)], ("model", "segmentation"), MAIN
        )
    chosen = [
        {**r["validation"], "model": r["model"], "split": "validation", "predict_ms": r["predict_ms"]}
        for r in rows_with(rows, mesh=first, segmentation="watershed")
        if r["model"] in (PERCEPTRON, CONVOLUTION)
    ]
    chosen += [
        {**r, "split": "test"}
        for r in rows_with(rows, mesh=first, segmentation="watershed")
        if r["model"] in (PERCEPTRON, CONVOLUTION)
    ]
    columns = ("AMAE", "prediction, ms", "BC", "RC", "MSE", "ARI", "AMI")
    chosen.sort(key=lambda r: (r["model"] != PERCEPTRON, r["split"] == "test"))
    tables["5_3"] = _table(chosen, ("model", "split"), columns)
    best = [r for r in rows_with(published, mesh=first, segmentation="watershed")] + rows_with(
        rows, mesh=first, segmentation="watershed"
    )
    tables["5_8"] = _table(best, ("model",), columns)
    consistent = [r for r in rows_with(published, mesh=first) if r.get("accepted") is not None] + [
        r for r in rows_with(rows, mesh=first) if r["model"] in (PERCEPTRON, DEFAULT)
    ]
    tables["5_11"] = _table(consistent, ("model", "segmentation"), ("ARI", "ARI ≥ 0.7"))
    tables["5_12"] = _shapes(rows, base)
    tables["5_13"] = _sizes(rows, published, finer)
    sized = [
        r
        for mesh in finer
        for r in (
            *rows_with(published, mesh=mesh, model=f"{PERCEPTRON}, {PUBLISHED}"),
            *(r for r in rows_with(rows, mesh=mesh) if r["model"] in (PERCEPTRON, DEFAULT, "true field")),
        )
    ]
    tables["5_14"] = _table(sized, ("mesh", "model", "segmentation"), MAIN)
    tables["models"] = _best(rows, published, base, finer)
    tables["training"] = _trained(fits)
    return tables


def _best(rows: list[Row], published: list[Row], base: list[str], finer: list[str]) -> str:
    """Every model with the segmentation that suits it best, by ARI."""
    result = [
        max(rows_with(source, mesh=mesh, model=model), key=lambda r: r["ari"])
        for mesh in dict.fromkeys([*base, *finer])
        for source in (published, rows)
        for model in dict.fromkeys(r["model"] for r in rows_with(source, mesh=mesh))
    ]
    return _table(result, ("mesh", "model", "segmentation"), (*MAIN, "p99, ms"))


def _shapes(rows: list[Row], meshes: list[str]) -> str:
    """Segmentation times and scores, a mesh in each group of columns (thesis, table 5.12)."""
    lines = ["| method | " + " | ".join(f"{m}: ms | BC | ARI" for m in meshes) + " |"]
    lines.append("|---" * (1 + 3 * len(meshes)) + "|")
    for model in (PERCEPTRON, DEFAULT):
        names = list(dict.fromkeys(r["segmentation"] for r in rows if r["model"] == model))
        amae = [_number(next((r["amae"] for r in rows_with(rows, mesh=m, model=model)), None), 4) for m in meshes]
        lines.append(f"| **{model}**, AMAE | " + " | ".join(f"{a} | | " for a in amae) + " |")
        for name in names:
            cells = []
            for mesh in meshes:
                row = next(iter(rows_with(rows, mesh=mesh, model=model, segmentation=name)), None)
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


def _sizes(rows: list[Row], published: list[Row], meshes: list[str]) -> str:
    """Segmentation times by resolution: published, NetworkX here, and the fast versions (thesis, table 5.13)."""
    sizes = {m: next(r["vertices"] for r in rows if r["mesh"] == m) for m in meshes}
    lines = [
        "| method | " + " | ".join(f"{sizes[m]} vertices" for m in meshes) + " |",
        "|---" * (1 + len(meshes)) + "|",
    ]

    def add_line(name: str, source: list[Row], key: str, **which: str) -> None:
        cells = [_ms(next(iter(rows_with(source, mesh=m, **which)), {}).get(key)) for m in meshes]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")

    for name in THESIS_METHODS:
        add_line(f"{name}, {PUBLISHED}", published, "segment_ms", model=f"{PERCEPTRON}, {PUBLISHED}", segmentation=name)
        add_line(f"{name}, NetworkX, here", rows, "reference_ms", model=DEFAULT, segmentation=name)
        add_line(f"{name}, fast, the same partition", rows, "segment_ms", model=DEFAULT, segmentation=name)
    for name in (MIDPOINTS, ATOMS):
        add_line(f"{name} (ours)", rows, "segment_ms", model=DEFAULT, segmentation=name)
    return "\n".join(lines)


def _trained(fits: list[Row]) -> str:
    """List how much the models were trained on, and for how long."""
    lines = ["| mesh | model | samples | steps | seconds |", "|---|---|---|---|---|"]
    for fit in fits:
        if "fit_seconds" in fit:
            steps = f"{fit['steps']:.0f}" if "steps" in fit else "–"
            samples = f"{fit['rows']:.0f}" if "rows" in fit else "–"
            lines.append(f"| {fit['mesh']} | {fit['model']} | {samples} | {steps} | {fit['fit_seconds']:.0f} |")
    return "\n".join(lines)


def _table(rows: Iterable[Row], keys: tuple[str, ...], columns: tuple[str, ...]) -> str:
    """Format a Markdown table: columns by their keys in a row, then columns of COLUMNS."""
    lines = ["| " + " | ".join((*keys, *columns)) + " |", "|---" * (len(keys) + len(columns)) + "|"]
    lines += [
        "| " + " | ".join((*(str(row[k]) for k in keys), *(COLUMNS[c](row) for c in columns))) + " |" for row in rows
    ]
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    """Format a number, or a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def _ms(value: dict[str, float] | float | None) -> str:
    """Format a time, or the median of a summary of times, in milliseconds."""
    if value is None:
        return "–"
    return f"{value['median'] if isinstance(value, dict) else value:.3g}"


def _timed(row: Row) -> bool:
    """Tell whether a row has its own times of prediction and segmentation."""
    return isinstance(row.get("predict_ms"), dict) and isinstance(row.get("segment_ms"), dict)
