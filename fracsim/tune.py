"""Hyperparameters: a search for a model that is both accurate and fast (thesis, sections 5.1.3 and 5.2). Offline only.

NSGA-II (Deb et al. 2002) seeks the least error over the folds of a dataset and the least time of a query. A study is a
file, or a database, that any number of processes work on at once; any of them may be killed, and started again.
"""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from . import metrics
from .asset import write_beside
from .dataset import FOLDS, Samples
from .errors import FieldError, MissingExtraError, ModelError
from .models.base import Body, model_class
from .segmentation import DEFAULTS, METHODS, SurfaceGraph
from .train import Run
from .view import as_png

try:
    import matplotlib
    import optuna
    import torch
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances
    from optuna.samplers import BaseSampler, NSGAIISampler
    from optuna.storages import BaseStorage, JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
    from optuna.trial import FrozenTrial, TrialState
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error

WEIGHT = 3.0  # of AMAE's square against the square of the seconds, in the choice (thesis, Eq. 5.1)
CHUNK = 64  # impulses whose fields are held at once
QUERIES, REPEATS = 5, 5  # impulses a fold that are timed, and how often each
PARTED = 20  # impulses a fold that part the body, whose segmentation is judged
LEAST = 10  # finished trials, for importances to mean anything
RETRIES = 1  # of a trial whose process was killed; it may be the trial that kills them
PATIENCE = 10  # seconds after which a lock on the journal is taken to be a dead process's
FAULTS = (ModelError, FieldError, MemoryError, torch.OutOfMemoryError)
MEASURES = {
    "amae": "AMAE",
    "seconds": "time of a query",
    "mse": "MSE",
    "bc": "boundary Chamfer",
    "rc": "region Chamfer",
    "ari": "ARI",
    "ami": "AMI",
}


@dataclass(frozen=True)
class Range:
    """Where an option is sought: whole numbers where both ends are. log: evenly by its logarithm."""

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ModelError(f"a range must be two finite numbers that do not fall, got {self.low} to {self.high}")
        if self.log and self.low <= 0:
            raise ModelError(f"a logarithmic range must be above 0, got {self.low}")

    def suggest(self, trial: optuna.Trial, name: str) -> float:
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    def narrowed(self, name: str, text: str) -> Range:
        """The same with the ends that a text such as "32:128" says, or the single value of one such as "64"."""
        low, _, high = text.partition(":")
        whole = isinstance(self.low, int)
        try:
            first, last = (int(end) if whole else float(end) for end in (low, high or low))
        except ValueError as error:
            kind = "whole numbers" if whole else "numbers"
            raise ModelError(f"--range {name} takes LOW:HIGH, {kind}, got {text!r}") from error
        return Range(first, last, self.log)


# Options by their names in a model's options or in its training's. MLP: thesis, section 5.2.1. DeltaConv: Table 5.5.
_SCORES = {
    "width": Range(32, 512, log=True),
    "eigenfunctions": Range(24, 192, log=True),
    "rate": Range(3e-4, 1e-2, log=True),
}
SPACES: dict[str, dict[str, Range]] = {
    "mlp": {"width": Range(32, 1024), "layers": Range(1, 20)},
    "deltaconv": {
        "layers": Range(1, 6),
        "width": Range(64, 1024),
        "depth": Range(1, 3),
        "embedding": Range(64, 2048),
        "neighbours": Range(2, 30),
        "kernel": Range(1.0, 3.0),
    },
    "field": _SCORES,
    "interfaces": _SCORES,
    "shared": {
        "knots": Range(4, 32),
        "eigenfunctions": Range(24, 192, log=True),
        "rate": Range(3e-3, 1e-1, log=True),
    },
    "nearest": {"position": Range(0.5, 30.0, log=True), "severity": Range(0.05, 5.0, log=True)},
}


@dataclass(frozen=True)
class Search:
    """What is sought. kind: of model. options: its own, for all that is not sought. ranges: of what is. folds: how
    many of the dataset's folds are held out in turn. seed: of the fits and of the search. source: the dataset's mark.
    """

    kind: str
    options: Any
    ranges: dict[str, Range]
    folds: int = FOLDS
    seed: int = 0
    source: str = ""

    def __post_init__(self) -> None:
        if not 1 <= self.folds <= FOLDS:
            raise ModelError(f"there are {FOLDS} folds, of which 1 to {FOLDS} can be asked for, got {self.folds}")
        if self.seed < 0:
            raise ModelError(f"a seed must be at least 0, got {self.seed}")
        self.with_values({name: ends.low for name, ends in self.ranges.items()})

    def with_values(self, values: dict[str, Any]) -> Any:
        """The options with these instead; those that are none of the model's own are its training's."""
        names = {field.name for field in fields(self.options)}
        own = {name: value for name, value in values.items() if name in names}
        rest = {name: value for name, value in values.items() if name not in names}
        if rest:
            if "training" not in names:
                raise ModelError(f"{self.kind} has no option {', '.join(rest)}")
            own["training"] = replace(self.options.training, **rest)
        return replace(self.options, **own)

    def identity(self) -> dict[str, Any]:
        """All that the figures of a trial depend on, beside the values that it tries."""
        return json.loads(json.dumps(asdict(self)))


def search_space(kind: str, narrowed: dict[str, str] | None = None) -> dict[str, Range]:
    """The ranges of a kind of model, some of them narrowed by texts such as "32:128"."""
    if kind not in SPACES:
        raise ModelError(f"nothing of model {kind!r} can be tuned; use one of {', '.join(SPACES)}")
    ranges = dict(SPACES[kind])
    for name, text in (narrowed or {}).items():
        if name not in ranges:
            raise ModelError(f"{name!r} is not sought; {kind} has {', '.join(ranges)}")
        ranges[name] = ranges[name].narrowed(name, text)
    return ranges


def fold_of(samples: Samples, fold: int) -> Samples:
    """The samples outside the test split: those of a fold to validate on, all others to train on."""
    inside = samples.rows(samples.fold >= 0)
    return replace(inside, split=(inside.fold == fold).astype(np.int64))


def tune(
    search: Search,
    body: Body,
    samples: Samples,
    study: optuna.Study,
    trials: int,
    population: int = 20,
    progress: Callable[[float], None] = lambda _: None,
) -> None:
    """Try hyperparameters until the study holds so many trials, those of other processes included.

    population: trials a generation of NSGA-II. When W processes work on a study, it may end with up to W - 1 more. A
    trial that was interrupted, or whose process was killed, does not count and is tried again; one that cannot be
    fitted counts, as failed.
    """
    if trials < 0 or population < 2:
        raise ModelError(f"trials must be at least 0 and a population at least 2, got {trials} and {population}")
    for fold in range(search.folds):
        split = fold_of(samples, fold).split
        if not (split == 0).any() or not (split == 1).any():
            raise ModelError(f"fold {fold} is empty; make more samples with: fracsim dataset make")
    study.sampler = _ByTrial(search.seed, population)
    me = _process("self")
    while True:
        _bury(study)
        taken = sum(map(_counts, study.get_trials(deepcopy=False)))
        progress(min(1.0, taken / max(trials, 1)))
        if taken >= trials:
            return
        trial = study.ask()
        trial.set_user_attr("process", me)
        try:
            values = {name: ends.suggest(trial, name) for name, ends in search.ranges.items()}
            found = measure(search, body, samples, values, _part(progress, taken, trials))
            trial.set_user_attr("found", found)
            study.tell(trial, [found["amae"], found["seconds"]])
        except KeyboardInterrupt:
            if study.tell(trial, state=TrialState.FAIL, skip_if_finished=True).state == TrialState.FAIL:
                study.enqueue_trial(trial.params, {"lost": trial.user_attrs.get("lost", 0)})
            raise
        except Exception as error:
            trial.set_user_attr("fault", f"{type(error).__name__}: {error}")
            study.tell(trial, state=TrialState.FAIL)
            if not isinstance(error, FAULTS):
                raise


def measure(
    search: Search, body: Body, samples: Samples, values: dict[str, Any], progress: Callable[[float], None]
) -> dict[str, Any]:
    """Fit and judge the model with these values, fold by fold.

    Means over the folds: amae and mse of the fields and, where impulses part the body, bc, rc, ari and ami of the
    watershed of the first PARTED. seconds: the median of a query of one impulse, on one thread or the model's device.
    folds: amae of each. fit_seconds: of all fits.
    """
    options, kind = search.with_values(values), model_class(search.kind)
    graph = SurfaceGraph.of(body.surface)
    rows: list[dict[str, float]] = []
    spent: list[float] = []
    fitting = 0.0
    for fold in range(search.folds):
        told = fold_of(samples, fold)
        run = Run(progress=_part(progress, fold, search.folds))
        begin = time.perf_counter()
        model, _ = kind.fit(body, told, options, search.seed, run)
        fitting += time.perf_counter() - begin
        held_out = told.part(1)
        rows.append({**_errors(body, held_out, model), **_segmented(body, held_out, model, graph)})
        spent += _times(model, held_out)
        progress((fold + 1) / search.folds)
    # One that not every fold knows is of none.
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if all(name in row for row in rows)}
    return {
        **means,
        "seconds": float(np.median(spent)),
        "folds": [row["amae"] for row in rows],
        "fit_seconds": fitting,
    }


def _part(progress: Callable[[float], None], done: int, of: int) -> Callable[[float], None]:
    """Progress of the piece after so many of all."""
    return lambda share: progress((done + share) / of)


def _errors(body: Body, samples: Samples, model: Any) -> dict[str, float]:
    total = {"amae": 0.0, "mse": 0.0}
    for start in range(0, len(samples), CHUNK):
        chunk = samples.rows(slice(start, start + CHUNK))
        truth, guess = body.fields(chunk.labels), model.predict(chunk.blows)
        total["amae"] += metrics.amae(truth, guess) * len(chunk)
        total["mse"] += metrics.mse(truth, guess) * len(chunk)
    return {name: value / len(samples) for name, value in total.items()}


def _segmented(body: Body, samples: Samples, model: Any, graph: SurfaceGraph) -> dict[str, float]:
    parted = samples.rows(np.flatnonzero(samples.labels.any(axis=1))[:PARTED])
    found: dict[str, list[float]] = {"bc": [], "rc": [], "ari": [], "ami": []}
    for k, udf in enumerate(model.predict(parted.blows) if len(parted) else ()):
        truth = parted.labels[k][body.vertex_atom]
        labels = METHODS["watershed"](graph, udf.astype(np.float64), DEFAULTS["watershed"])
        for name, value in metrics.partition_scores(body.vertices, graph.edges, truth, labels).items():
            found[name].append(value)
    return {name: float(np.mean(values)) for name, values in found.items() if values}


def _times(model: Any, samples: Samples) -> list[float]:
    """Seconds of each query, on one thread, for other workers may have the rest of the machine."""
    spent = []
    with threadpool_limits(1):
        for k in range(min(QUERIES, len(samples))):
            blow = samples.rows(slice(k, k + 1)).blows
            model.predict(blow)
            for _ in range(REPEATS):
                begin = time.perf_counter()
                model.predict(blow)
                spent.append(time.perf_counter() - begin)
    return spent


# Studies


class _ByTrial(BaseSampler):
    """NSGA-II that draws each trial from a seed of the trial's own, so that no two processes, and no two sittings of
    one, try the same."""

    def __init__(self, seed: int, population: int) -> None:
        self.seed, self.population = seed, population

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        seed = int(np.random.SeedSequence([self.seed, trial.number]).generate_state(1)[0])
        self.own = NSGAIISampler(population_size=self.population, seed=seed)
        self.own.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, Any]:
        return self.own.infer_relative_search_space(study, trial)

    def sample_relative(self, study: optuna.Study, trial: FrozenTrial, search_space: Any) -> dict[str, Any]:
        return self.own.sample_relative(study, trial, search_space)

    def sample_independent(self, study: optuna.Study, trial: FrozenTrial, param_name: str, distribution: Any) -> Any:
        return self.own.sample_independent(study, trial, param_name, distribution)


def open_study(storage: str, name: str, search: Search) -> optuna.Study:
    """A study, new or begun. storage: a journal file, or the URL of a database.

    Raises ModelError where there is a study of that name about something else.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(
            storage=_storage(storage), study_name=name, directions=["minimize", "minimize"], load_if_exists=True
        )
        before = study.user_attrs.get("search")
    except (ValueError, KeyError, TypeError) as error:  # a journal's lines are not what they should be
        raise ModelError(f"{storage}: not a journal of a study ({error}); name another with --storage") from error
    if before is None:
        study.set_user_attr("search", search.identity())
    elif before != search.identity():
        now = search.identity()
        differ = ", ".join(f"{key} was {before.get(key)}" for key in now if before.get(key) != now[key])
        raise ModelError(f"study {name!r} is about something else ({differ}); give another --study or --out")
    return study


def _storage(storage: str) -> BaseStorage:
    if "://" in storage:
        try:
            return RDBStorage(storage)
        except Exception as error:  # of SQLAlchemy's and any driver's own kind; with a password in it, maybe
            raise ModelError(f"the database of the study cannot be opened ({type(error).__name__})") from error
    path = Path(storage).absolute()
    if not path.parent.is_dir() or path.is_dir():
        raise ModelError(f"{storage}: not a file in a folder that is there; create the folder first")
    lock = JournalFileOpenLock(str(path), grace_period=PATIENCE)
    if path.is_file():
        _mend(path, lock)
    return JournalStorage(JournalFileBackend(str(path), lock))


def _mend(path: Path, lock: JournalFileOpenLock) -> None:
    """Take the end off a journal that a machine's death left in the middle of a line, for the next line would be
    joined to it, and none could be read."""
    lock.acquire()
    try:
        with path.open("r+b") as file:
            data = file.read()
            if data and not data.startswith(b"{"):
                raise ModelError(f"{path}: not a journal of a study; name another with --storage")
            file.truncate(data.rfind(b"\n") + 1)
    finally:
        lock.release()


def _counts(trial: FrozenTrial) -> bool:
    """Whether a trial is one of those asked for: it ended of itself, or is under way here."""
    if trial.state == TrialState.FAIL:
        return "fault" in trial.user_attrs
    if trial.state == TrialState.RUNNING:
        return _alive(trial.user_attrs.get("process", "")) is True
    return trial.state == TrialState.COMPLETE


def _bury(study: optuna.Study) -> None:
    """Give up the trials of this machine's dead processes, and ask for them again."""
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if _alive(trial.user_attrs.get("process", "")) is False:
            try:
                study.tell(trial.number, state=TrialState.FAIL)
            except (ValueError, optuna.exceptions.UpdateFinishedTrialError):
                continue  # another process was first
            lost = trial.user_attrs.get("lost", 0)
            if trial.params and lost < RETRIES:
                study.enqueue_trial(trial.params, {"lost": lost + 1})


def _process(pid: str) -> str:
    """A name of a process of this machine that no later one will have; "" where there is none."""
    try:
        number, rest = Path(f"/proc/{pid}/stat").read_text().split(" ", 1)
    except FileNotFoundError:
        return ""
    state, *told = rest.rpartition(") ")[2].split()
    return "" if state in "ZX" else f"{platform.node()}:{number}:{told[18]}"  # the 22nd field: when it began


def _alive(process: str) -> bool | None:
    """None where it is on another machine, or unknown."""
    node, _, rest = process.partition(":")
    return None if node != platform.node() or not rest else _process(rest.split(":")[0]) == process


# What came of it


def cost(trial: FrozenTrial) -> float:
    """sqrt(t² + 3 AMAE²) (thesis, Eq. 5.1), with t in seconds: in milliseconds, which the thesis prints beside it, it
    would choose the fastest whatever its error."""
    amae, seconds = trial.values
    return math.sqrt(seconds**2 + WEIGHT * amae**2)


def summary(study: optuna.Study, search: Search) -> dict[str, Any]:
    """All trials, the Pareto front, the chosen trial and the importances, as plain data."""
    trials = study.get_trials(deepcopy=False)
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    front = {trial.number: trial for trial in study.best_trials}
    chosen = min(front, key=lambda number: (cost(front[number]), number), default=None)
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
        "rule": "least sqrt(seconds^2 + 3 amae^2) on the Pareto front (thesis, Eq. 5.1)",
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
