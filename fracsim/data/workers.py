"""Blocks of samples made by many processes, on this machine or on a Ray cluster. Sampling uses it."""

from __future__ import annotations

import collections
import os
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from ..common.errors import DatasetError, MissingExtraError

try:
    import joblib
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error


Subject = TypeVar("Subject")
Result = TypeVar("Result")


def run_blocks(
    job: Callable[[Subject, int, int], Result],
    simulator: Subject,
    seed: int,
    blocks: list[int],
    workers: int = 1,
    backend: str = "joblib",
) -> Iterator[Result]:
    """Run ``job(simulator, seed, block)`` for every block, in order, whoever does it.

    The bits are the same for any number of workers and either backend.

    Parameters
    ----------
    job : callable
        What makes a block.
    simulator : object
        What the job asks: a simulator, or whatever holds one. Sent to every worker.
    seed : int
        Of all blocks.
    blocks : list of int
        Which blocks.
    workers : int
        Processes.
    backend : str
        "joblib" for this machine. "ray" for the cluster that ray is connected to, or that the environment's RAY_ADDRESS
        names, or else this machine; the block of a node that dies is made again by another.

    Yields
    ------
    object
        What the job returns, block by block.

    Raises
    ------
    DatasetError
        Where workers or backend are out of range.
    MissingExtraError
        Where ray is asked for and not installed.
    """
    check_workers(workers, backend)
    if backend == "ray":
        yield from _on_ray(job, simulator, seed, blocks, workers)
    elif workers == 1:
        for block in blocks:
            yield job(simulator, seed, block)
    else:
        # In windows, so that no more than these wait in memory for whoever takes the results.
        with joblib.Parallel(n_jobs=workers, return_as="generator", batch_size=1) as parallel:
            for start in range(0, len(blocks), 4 * workers):
                window = blocks[start : start + 4 * workers]
                yield from parallel(joblib.delayed(job)(simulator, seed, block) for block in window)


def check_workers(workers: int, backend: str) -> None:
    """Refuse numbers of workers and backends that cannot be.

    Parameters
    ----------
    workers : int
        Processes.
    backend : str
        "joblib" or "ray".

    Raises
    ------
    DatasetError
        Where either is out of range.
    """
    if backend not in ("joblib", "ray"):
        raise DatasetError(f"unknown backend {backend!r}; use joblib or ray")
    if workers < 1:
        raise DatasetError(f"workers must be at least 1, got {workers}")


def _on_ray(
    job: Callable[[Subject, int, int], Result],
    simulator: Subject,
    seed: int,
    blocks: list[int],
    workers: int,
) -> Iterator[Result]:
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("ray", "ray") from error
    if not ray.is_initialized():
        address, count = (None, None) if "RAY_ADDRESS" in os.environ else ("local", workers)
        ray.init(address, num_cpus=count, log_to_driver=False, configure_logging=False)
    remote = ray.remote(max_retries=-1)(job)
    shared = ray.put(simulator)
    # Twice as many under way as there are workers: enough to keep them busy, few enough to fit any memory.
    waiting: collections.deque[Any] = collections.deque()
    for block in blocks:
        waiting.append(remote.remote(shared, seed, block))
        if len(waiting) >= 2 * workers:
            yield ray.get(waiting.popleft())
    while waiting:
        yield ray.get(waiting.popleft())
