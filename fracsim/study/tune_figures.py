"""TODO study.tune_figures."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import MissingExtraError
from ..common.files import write_beside
from ..learning import model_class
from .search_space import Search
from .tune import LEAST
from .view import as_png

try:
    import matplotlib
    import optuna
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances
    from optuna.trial import FrozenTrial, TrialState
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error


MEASURES = {
    "amae": "AMAE",
    "seconds": "time of a query",
    "mse": "MSE",
    "bc": "boundary Chamfer",
    "rc": "region Chamfer",
    "ari": "ARI",
    "ami": "AMI",
}


# What came of it


def cost(kind: str, trial: FrozenTrial) -> float:
    """sqrt(t² + 3 AMAE²) (thesis, Eq. 5.1), with t in seconds: in milliseconds, which the thesis prints beside it, it
    would choose the fastest whatever its error."""
    amae, seconds = trial.values
    return model_class(kind).cost(amae, seconds)


def summary(study: optuna.Study, search: Search) -> dict[str, Any]:
    """All trials, the Pareto front, the chosen trial and the importances, as plain data."""
    trials = study.get_trials(deepcopy=False)
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    front = {trial.number: trial for trial in study.best_trials}
    chosen = min(front, key=lambda number: (cost(search.kind, front[number]), number), default=None)
    failed = [trial for trial in trials if trial.state == TrialState.FAIL]
    return {
        "study": study.study_name,
        "search": search.identity(),
        "counts": {
            "finished": len(complete),
            "failed": sum("fault" in trial.user_attrs for trial in failed),
            "interrupted": sum("fault" not in trial.user_attrs for trial in failed),
            "under way": sum(trial.state == TrialState.RUNNING for trial in trials),
        },
        "rule": model_class(search.kind).cost.rule,
        "chosen": chosen,
        "importances": importances(study, search.seed),
        "trials": [
            {
                "number": trial.number,
                "state": trial.state.name.lower(),
                "front": trial.number in front,
                "parameters": trial.params,
                **trial.user_attrs.get("found", {}),
                **({"fault": trial.user_attrs["fault"]} if "fault" in trial.user_attrs else {}),
            }
            for trial in trials
        ],
    }


def importances(study: optuna.Study, seed: int) -> dict[str, dict[str, float]]:
    """By fANOVA (Hutter et al. 2014): the share of the variance of each measure that each hyperparameter accounts for
    by itself (thesis, figures 5.4 and 5.8). Empty with fewer than LEAST finished trials."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    result = {}
    for name in MEASURES if len(complete) >= LEAST else ():
        values = [trial.user_attrs["found"].get(name) for trial in complete]
        if None not in values and max(values) > min(values):
            evaluator = FanovaImportanceEvaluator(seed=seed % 2**32)
            result[name] = get_param_importances(study, evaluator=evaluator, target=partial(_measure_of, name))
    return result


def _measure_of(name: str, trial: FrozenTrial) -> float:
    return float(trial.user_attrs["found"][name])


def write_figures(found: dict[str, Any], out: Path) -> list[Path]:
    """Write trials.json and, where trials finished, pareto.png, parallel.png and importances.png; returns the paths.

    found: a ``summary``.
    """
    files = {"trials.json": (json.dumps(found, indent=1) + "\n").encode()}
    if found["chosen"] is not None:
        files |= {"pareto.png": as_png(_pareto(found), 130), "parallel.png": as_png(_parallel(found), 130)}
        if found["importances"]:
            files["importances.png"] = as_png(_importances(found), 130)
    for name, data in files.items():
        write_beside(out / name, data)
    return [out / name for name in files]


def _finished(found: dict[str, Any]) -> list[dict[str, Any]]:
    return [trial for trial in found["trials"] if trial["state"] == "complete"]


def _pareto(found: dict[str, Any]) -> Figure:
    """Every trial by its time and error, the front among them, and the choice (thesis, figures 5.2 and 5.6)."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    finished = sorted(_finished(found), key=lambda trial: trial["seconds"])
    for front, colour, label in ((False, "0.65", "dominated trials"), (True, "crimson", "Pareto front")):
        points = [(trial["seconds"] * 1e3, trial["amae"]) for trial in finished if trial["front"] == front]
        if points:
            axes.plot(*zip(*points, strict=True), "o", color=colour, ms=4, mew=0, label=label)
        if front:
            axes.plot(*zip(*points, strict=True), color=colour, lw=1, drawstyle="steps-post")
    chosen = found["trials"][found["chosen"]]
    label = "chosen: " + ", ".join(f"{name} {_short(value)}" for name, value in chosen["parameters"].items())
    axes.plot(chosen["seconds"] * 1e3, chosen["amae"], "o", color="tab:blue", ms=9, mec="white", label=label)
    axes.set(xscale="log", yscale="log", xlabel="time of a query, ms", ylabel="AMAE, mean over the folds")
    axes.set_title(f"{found['search']['kind']}, {len(finished)} trials", fontsize=10)
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=7)
    return figure


def _parallel(found: dict[str, Any]) -> Figure:
    """A line a trial through its error and its hyperparameters (thesis, figures 5.3 and 5.7)."""
    ranges = found["search"]["ranges"]
    finished = sorted(_finished(found), key=lambda trial: -trial["amae"])  # the best on top
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
        if trial["number"] != found["chosen"]:
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


def _height(values: Any, low: float, high: float, log: bool) -> Any:
    """Where on an axis from 0 to 1 values are."""
    if high <= low:
        return np.full(len(values), 0.5)
    return np.log(values / low) / math.log(high / low) if log else (values - low) / (high - low)


def _importances(found: dict[str, Any]) -> Figure:
    """Bars, a hyperparameter a group and a measure a colour (thesis, figures 5.4 and 5.8)."""
    measures, names = found["importances"], list(found["search"]["ranges"])
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
    return f"{value:.0f}" if value == round(value) else f"{value:.3g}"
