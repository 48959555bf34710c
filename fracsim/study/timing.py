"""Timing of single queries, as a simulation makes them. The study's own modules use it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ..data.samples import Samples
from ..simulators.base import Impacts


def one_by_one(
    predict: Callable[[Impacts], npt.NDArray[Any]],
    samples: Samples,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[npt.NDArray[Any], list[float]]:
    """Ask a model about one impact after another, as a simulation would.

    Parameters
    ----------
    predict : callable
        Answers N impacts with an array whose first dimension is N.
    samples : Samples
        The impacts.
    progress : callable, optional
        Called with the share that is done.

    Returns
    -------
    answers : ndarray, shape (N, ...)
        The answers.
    times : list of float
        How long each took, in milliseconds.
    """
    answers, times = [], []
    for k in range(len(samples)):
        impact = samples.take(slice(k, k + 1)).impacts
        begin = time.perf_counter()
        answers.append(predict(impact)[0])
        times.append((time.perf_counter() - begin) * 1e3)
        progress((k + 1) / len(samples))
    return np.array(answers), times


def time_summary(times: list[float]) -> dict[str, float]:
    """Summarise times.

    Parameters
    ----------
    times : list of float
        Times, in milliseconds.

    Returns
    -------
    dict of str to float
        ``median``, ``mean``, ``std`` and ``p99``, the 99th percentile, in milliseconds.
    """
    return {
        "median": float(np.median(times)),
        "mean": float(np.mean(times)),
        "std": float(np.std(times)),
        "p99": float(np.quantile(times, 0.99)),
    }
