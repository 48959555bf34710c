"""Fracture samples: impulses drawn over a surface, and what a simulator says they do. Offline only.

Samples come in blocks, each drawn from its own seed, so that any number of them, made by any number of workers or in
any number of sittings, is the beginning of one and the same sequence. ``storage`` keeps them in a file.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import DatasetError, MissingExtraError
from ..geometry.sampling import CONE, SEVERITY, ratios
from ..simulators.base import FractureSimulator, Impacts, Response
from .impacts import CONTACTS, KINDS, POOL, RING, SEVERAL, TILT, draw_impacts
from .workers import run_blocks

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error


BLOCK = 400  # samples that are drawn together
TEST, VALIDATION = 0.15, 0.1  # shares of a block; validation is taken from what is not test
FOLDS = 5


@dataclass(frozen=True, eq=False)
class Samples:
    """Impulses and their fractures.

    faces: (N, CONTACTS) and barycentric: (N, CONTACTS, 3), where on the surface; directions: (N, CONTACTS, 3).
    severities: (N, CONTACTS), impulse / (mass * breaking velocity), 0 where there is no contact.
    ratio: (N,), severity as a multiple of the one at which this very impact would first part the body.
    kind: (N,), index into KINDS. labels: (N, P), the piece of each part. broken: (N, I), the interfaces that give
    way, or (N, 0) from a simulator that knows none; one that broke within a piece, its sides being joined another
    way, parts nothing. split: (N,), 0 train, 1 validation, 2 test. fold: (N,), 0 to FOLDS - 1, or -1 in the test
    split, which no fold may contain.
    """

    faces: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray
    ratio: FloatArray
    kind: IntArray
    labels: IntArray
    broken: BoolArray
    split: IntArray
    fold: IntArray

    @property
    def impacts(self) -> Impacts:
        return Impacts(self.faces, self.barycentric, self.directions, self.severities)

    def of_split(self, split: int) -> Samples:
        return self.take(self.split == split)

    def take(self, rows: slice | IntArray | BoolArray) -> Samples:
        return Samples(*(getattr(self, field.name)[rows] for field in fields(self)))

    def __len__(self) -> int:
        return len(self.ratio)

    @classmethod
    def join(cls, blocks: list[Samples]) -> Samples:
        return cls(*(np.concatenate([getattr(block, field.name) for block in blocks]) for field in fields(cls)))


def sample(
    simulator: FractureSimulator,
    count: int,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
    workers: int = 1,
    backend: str = "joblib",
    transform: Callable[[Samples], Samples] = lambda block: block,
    begun: Sequence[Samples] = (),
) -> Samples:
    """``count`` samples: points uniform over the area, directions uniform in a cone about the inward normal,
    severity log-uniform about the threshold; none is rejected, those that break nothing included.

    transform: applied to every block before they are joined. begun: the first blocks, where they are there already."""
    if count < 1 or seed < 0:
        raise DatasetError(f"a count of samples must be at least 1 and a seed at least 0, got {count} and {seed}")
    blocks = []
    rest = list(range(len(begun), -(-count // BLOCK)))
    for block in itertools.chain(begun, run_blocks(sample_block, simulator, seed, rest, workers, backend)):
        blocks.append(transform(block))
        progress(min(1.0, len(blocks) * BLOCK / count))
    return Samples.join(blocks).take(slice(count))


def sample_block(simulator: FractureSimulator, seed: int, block: int) -> Samples:
    """The ``block``-th BLOCK samples of a seed."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1, block)))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        shares, kind = draw_impacts(simulator.surface, BLOCK, rng)
        ratio = ratios(BLOCK, rng)
        thresholds = simulator.thresholds(shares)
        impacts = shares.times(ratio * thresholds)
        response = checked(simulator, impacts, thresholds, simulator.fracture(impacts))
    broken = response.broken
    split, fold = np.zeros(BLOCK, dtype=np.int64), np.full(BLOCK, -1)
    order = rng.permutation(BLOCK)
    test = round(TEST * BLOCK)
    split[order[:test]] = 2
    split[order[test : test + round(VALIDATION * (BLOCK - test))]] = 1
    fold[rng.permutation(order[test:])] = np.arange(BLOCK - test) % FOLDS
    return Samples(
        impacts.faces,
        impacts.barycentric,
        impacts.directions,
        impacts.severities,
        ratio,
        kind,
        response.labels,
        np.zeros((BLOCK, 0), dtype=bool) if broken is None else broken,
        split,
        fold,
    )


def checked(simulator: FractureSimulator, impacts: Impacts, thresholds: FloatArray, response: Response) -> Response:
    """The response, if a simulator of whatever origin answered as it should; DatasetError says what is wrong."""
    name, count, parts = type(simulator).__name__, len(impacts), len(simulator.cells.volumes)
    if np.shape(thresholds) != (count,) or not (np.isfinite(thresholds).all() and (np.asarray(thresholds) > 0).all()):
        raise DatasetError(f"{name}: thresholds must be ({count},), finite and positive")
    labels = np.asarray(response.labels)
    if labels.shape != (count, parts) or labels.dtype.kind not in "iu":
        raise DatasetError(
            f"{name}: labels must be integers of shape ({count}, {parts}), got {labels.dtype} of {labels.shape}"
        )
    if labels.min(initial=0) < 0 or labels.max(initial=0) >= parts:
        raise DatasetError(f"{name}: labels must lie in 0 to {parts - 1}")
    broken = response.broken
    if broken is not None and (broken.dtype != bool or broken.ndim != 2 or len(broken) != count):
        raise DatasetError(f"{name}: broken must be booleans of shape ({count}, interfaces), or None")
    return Response(labels.astype(np.int64, copy=False), broken)


def sampling_rules() -> dict[str, Any]:
    """Lay down how samples are drawn; files drawn by other rules are read but not gone on with.

    Returns
    -------
    dict
        The numbers that drawing depends on, as JSON can hold them.
    """
    return {
        "block": BLOCK,
        "contacts": CONTACTS,
        "several": SEVERAL,
        "kinds": list(KINDS),
        "cone": CONE,
        "severity": list(SEVERITY),
        "test": TEST,
        "validation": VALIDATION,
        "folds": FOLDS,
        "pool": POOL,
        "ring": list(RING),
        "tilt": TILT,
    }
