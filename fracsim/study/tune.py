"""Hyperparameters: a search for a model that is both accurate and fast (thesis, sections 5.1.3 and 5.2). Offline only.

NSGA-II (Deb et al. 2002) seeks the least error over the folds of a dataset and the least time of a query. A study is a
file, or a database, that any number of processes work on at once; any of them may be killed, and started again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from .. import metrics
from ..common.errors import FieldError, MissingExtraError, ModelError
from ..data.samples import Samples
from ..learning import model_class
from ..learning.body import BodyGeometry
from ..learning.model import Predictor
from ..learning.trainer import Run
from ..segmentation import METHODS
from ..segmentation.graph import SurfaceGraph
from .optuna_study import _bury, _ByTrial, _counts, _process
from .search_space import Search

try:
    import optuna
    import torch
    from optuna.trial import TrialState
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error

CHUNK = 64  # impulses whose fields are held at once
QUERIES, REPEATS = 5, 5  # impulses a fold that are timed, and how often each
PARTED = 20  # impulses a fold that part the body, whose segmentation is judged
LEAST = 10  # finished trials, for importances to mean anything
FAULTS = (ModelError, FieldError, MemoryError, torch.OutOfMemoryError)


def fold_of(samples: Samples, fold: int) -> Samples:
    """The samples outside the test split: those of a fold to validate on, all others to train on."""
    inside = samples.take(samples.fold >= 0)
    return replace(inside, split=(inside.fold == fold).astype(np.int64))


def tune(
    search: Search,
    body: BodyGeometry,
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
    search: Search, body: BodyGeometry, samples: Samples, values: dict[str, Any], progress: Callable[[float], None]
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
        held_out = told.of_split(1)
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


def _errors(body: BodyGeometry, samples: Samples, model: Predictor) -> dict[str, float]:
    total = {"amae": 0.0, "mse": 0.0}
    for start in range(0, len(samples), CHUNK):
        chunk = samples.take(slice(start, start + CHUNK))
        truth, guess = body.fields(chunk.labels), model.predict(chunk.impacts)
        total["amae"] += metrics.amae(truth, guess) * len(chunk)
        total["mse"] += metrics.mse(truth, guess) * len(chunk)
    return {name: value / len(samples) for name, value in total.items()}


def _segmented(body: BodyGeometry, samples: Samples, model: Predictor, graph: SurfaceGraph) -> dict[str, float]:
    parted = samples.take(np.flatnonzero(samples.labels.any(axis=1))[:PARTED])
    found: dict[str, list[float]] = {"bc": [], "rc": [], "ari": [], "ami": []}
    for k, udf in enumerate(model.predict(parted.impacts) if len(parted) else ()):
        truth = parted.labels[k][body.vertex_atom]
        labels = METHODS["watershed"](graph, udf.astype(np.float64))
        for name, value in metrics.partition_scores(body.vertices, graph.edges, truth, labels).items():
            found[name].append(value)
    return {name: float(np.mean(values)) for name, values in found.items() if values}


def _times(model: Predictor, samples: Samples) -> list[float]:
    """Seconds of each query, on one thread, for other workers may have the rest of the machine."""
    spent = []
    with threadpool_limits(1):
        for k in range(min(QUERIES, len(samples))):
            impact = samples.take(slice(k, k + 1)).impacts
            model.predict(impact)
            for _ in range(REPEATS):
                begin = time.perf_counter()
                model.predict(impact)
                spent.append(time.perf_counter() - begin)
    return spent
