"""Hyperparameters: a search for a model that is both accurate and fast (thesis, sections 5.1.3 and 5.2). Offline only.

NSGA-II (Deb et al. 2002) minimises the error over the folds of a dataset and the time of a query.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import metrics
from ..common.errors import FieldError, MissingExtraError, ModelError
from ..data.samples import Samples
from ..learning import model_class
from ..learning.body import BodyGeometry
from ..learning.model import Predictor
from ..learning.trainer import Run
from ..segmentation import METHODS, Segmentation
from ..segmentation.graph import SurfaceGraph
from .optuna_study import (
    SeededSampler,
    begin_trial,
    count_trials,
    fail_trial,
    finish_trial,
    give_up_lost_trials,
    repeat_trial,
    set_segmentation,
)
from .search_space import Search

if TYPE_CHECKING:
    import optuna

try:
    import torch
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "train") from error

CHUNK = 64  # impulses whose fields are held in memory at once
QUERIES, REPEATS = 5, 5  # impulses of a fold that are timed, and how often each
SEGMENTED = 20  # impulses of a fold that break the body and whose segmentation is measured
# What a bad choice of hyperparameters may cause. Everything else is a mistake in the program.
FAULTS = (ModelError, FieldError, MemoryError, torch.OutOfMemoryError)


def fold_of(samples: Samples, fold: int) -> Samples:
    """Split the samples outside the test split for one fold.

    Parameters
    ----------
    samples : Samples
        All samples.
    fold : int
        The fold to validate on, from 0.

    Returns
    -------
    Samples
        Those outside the test split: the fold is the validation split, all others are the training split.
    """
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
    segmentation: str = "watershed",
) -> None:
    """Try hyperparameters until the study holds a number of trials, those of other processes included.

    If W processes work on a study, it may end with up to W - 1 more. A trial that was interrupted, or whose process was
    killed, does not count and is tried again. A trial whose model cannot be trained counts as failed.

    Parameters
    ----------
    search : Search
        What is searched.
    body : BodyGeometry
        The body.
    samples : Samples
        Its samples.
    study : optuna.Study
        What ``open_study`` returns.
    trials : int
        The number of trials.
    population : int
        Trials in a generation of NSGA-II.
    progress : callable
        Called with the share that is done.
    segmentation : str
        The segmentation that predicted fields are measured with, a name in ``segmentation.METHODS``.

    Raises
    ------
    ModelError
        If an argument is out of range, a fold has no samples, or the study has trials with another segmentation.
    FieldError
        If there is no segmentation of that name.
    """
    if trials < 0 or population < 2:
        raise ModelError(f"trials must be at least 0 and a population at least 2, got {trials} and {population}")
    if segmentation not in METHODS:
        raise FieldError(f"unknown segmentation {segmentation!r}; use one of {', '.join(METHODS)}")
    for fold in range(search.folds):
        split = fold_of(samples, fold).split
        if not (split == 0).any() or not (split == 1).any():
            raise ModelError(f"fold {fold} is empty; make more samples with: fracsim dataset make")
    set_segmentation(study, segmentation)
    study.sampler = SeededSampler(search.seed, population)
    while True:
        give_up_lost_trials(study)
        count = count_trials(study)
        progress(min(1.0, count / max(trials, 1)))
        if count >= trials:
            return
        trial = begin_trial(study)
        try:
            values = {name: ends.suggest(trial, name) for name, ends in search.ranges.items()}
            figures = measure(search, body, samples, values, _share_of(progress, count, trials), segmentation)
        except KeyboardInterrupt:
            repeat_trial(study, trial)
            raise
        except FAULTS as error:
            fail_trial(study, trial, error)
        except Exception as error:  # a mistake in the program: the trial records it, and it is raised
            fail_trial(study, trial, error)
            raise
        else:
            finish_trial(study, trial, figures)


def measure(
    search: Search,
    body: BodyGeometry,
    samples: Samples,
    values: dict[str, Any],
    progress: Callable[[float], None] = lambda _: None,
    segmentation: str = "watershed",
) -> dict[str, Any]:
    """Train and measure a model with certain hyperparameters, fold by fold.

    Parameters
    ----------
    search : Search
        What is searched.
    body : BodyGeometry
        The body.
    samples : Samples
        Its samples.
    values : dict of str to object
        The hyperparameters, by name.
    progress : callable
        Called with the share that is done.
    segmentation : str
        The segmentation that predicted fields are measured with, a name in ``segmentation.METHODS``.

    Returns
    -------
    dict
        ``amae`` and ``mse`` of the fields, and ``bc``, ``rc``, ``ari`` and ``ami`` of the segmentation if every fold
        has impulses that break the body: means over the folds. ``seconds``, the median time of a query of one impulse,
        on one thread or on the model's device. ``folds``, the AMAE of each fold. ``fit_seconds``, the time of all
        trainings.
    """
    options, kind = search.with_values(values), model_class(search.kind)
    graph = SurfaceGraph.of(body.surface)
    rows: list[dict[str, float]] = []
    query_seconds: list[float] = []
    fit_seconds = 0.0
    for fold in range(search.folds):
        split = fold_of(samples, fold)
        run = Run(progress=_share_of(progress, fold, search.folds))
        begin = time.perf_counter()
        model, _ = kind.fit(body, split, options, search.seed, run)
        fit_seconds += time.perf_counter() - begin
        held_out = split.of_split(1)
        scores = _segmentation_scores(body, held_out, model, graph, METHODS[segmentation])
        rows.append({**_field_errors(body, held_out, model), **scores})
        query_seconds += _query_times(model, held_out)
        progress((fold + 1) / search.folds)
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if all(name in row for row in rows)}
    return {
        **means,
        "seconds": float(np.median(query_seconds)),
        "folds": [row["amae"] for row in rows],
        "fit_seconds": fit_seconds,
    }


def _share_of(progress: Callable[[float], None], done: int, total: int) -> Callable[[float], None]:
    """Report the progress of one of several equal shares, after so many are done."""
    return lambda share: progress((done + share) / total)


def _field_errors(body: BodyGeometry, samples: Samples, model: Predictor) -> dict[str, float]:
    """Mean errors of the fields that a model predicts."""
    total = {"amae": 0.0, "mse": 0.0}
    for start in range(0, len(samples), CHUNK):
        chunk = samples.take(slice(start, start + CHUNK))
        truth, guess = body.fields(chunk.labels), model.predict(chunk.impacts)
        total["amae"] += metrics.amae(truth, guess) * len(chunk)
        total["mse"] += metrics.mse(truth, guess) * len(chunk)
    return {name: value / len(samples) for name, value in total.items()}


def _segmentation_scores(
    body: BodyGeometry, samples: Samples, model: Predictor, graph: SurfaceGraph, segmentation: Segmentation
) -> dict[str, float]:
    """Mean scores of the segmented fields of a few impulses; empty if no impulse breaks the body."""
    breaking = samples.take(np.flatnonzero(samples.labels.any(axis=1))[:SEGMENTED])
    if not len(breaking):
        return {}
    rows = []
    for atom_labels, udf in zip(breaking.labels, model.predict(breaking.impacts), strict=True):
        labels = segmentation(graph, udf.astype(np.float64))
        rows.append(metrics.partition_scores(body.vertices, graph.edges, atom_labels[body.vertex_atom], labels))
    return {name: float(np.mean([row[name] for row in rows])) for name in ("bc", "rc", "ari", "ami")}


def _query_times(model: Predictor, samples: Samples) -> list[float]:
    """Seconds of each query, on one thread, because other processes may use the rest of the machine."""
    times = []
    with threadpool_limits(1):
        for k in range(min(QUERIES, len(samples))):
            impact = samples.take(slice(k, k + 1)).impacts
            model.predict(impact)
            for _ in range(REPEATS):
                begin = time.perf_counter()
                model.predict(impact)
                times.append(time.perf_counter() - begin)
    return times
