"""Fracture samples: impacts drawn over a surface, and what a simulator says they do. Offline only.

Samples come in blocks, each drawn from its own seed. So any number of them, made by any number of workers or in any
number of sittings, is the beginning of one and the same sequence. ``writing`` keeps them in a file.
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
from ..simulators.capabilities import reference_factors
from .impacts import CONTACTS, KINDS, POOL, RING, SEVERAL, TILT, draw_impacts
from .workers import run_blocks

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error


BLOCK = 400  # samples that are drawn together
TEST, VALIDATION = 0.15, 0.1  # shares of a block; validation is taken from what is not test
FOLDS = 5
TRAINING_SPLIT, VALIDATION_SPLIT, TEST_SPLIT = range(3)


@dataclass(frozen=True, eq=False)
class Samples:
    """N impacts and their fractures.

    Attributes
    ----------
    faces : ndarray of int64, shape (N, K)
        The face of the surface that each contact lies on; K is ``impacts.CONTACTS``.
    barycentric : ndarray of float64, shape (N, K, 3)
        Where on the face.
    directions : ndarray of float64, shape (N, K, 3)
        Unit vectors along the impulses.
    severities : ndarray of float64, shape (N, K)
        How hard each contact is, without unit, see ``simulators.base.Impacts``; 0 where there is no contact.
    ratio : ndarray of float64, shape (N,)
        Severity as a multiple of the one at which this very impact would first break the body; or open a first crack,
        where the simulator finds that sooner (``simulators.capabilities.FirstCrack``).
    kind : ndarray of int64, shape (N,)
        Index into ``impacts.KINDS``.
    labels : ndarray of int64, shape (N, C)
        The piece of each cell.
    broken : ndarray of bool, shape (N, I)
        The interfaces that break; (N, 0) of a simulator that does not know them. An interface may break inside a piece
        whose two sides are still joined by another way.
    split : ndarray of int64, shape (N,)
        TRAINING_SPLIT, VALIDATION_SPLIT or TEST_SPLIT: 0, 1 or 2.
    fold : ndarray of int64, shape (N,)
        0 to FOLDS - 1; -1 in the test split, which no fold may contain.
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
        """The impacts alone."""
        return Impacts(self.faces, self.barycentric, self.directions, self.severities)

    def of_split(self, split: int) -> Samples:
        """Take the samples of a split.

        Parameters
        ----------
        split : int
            TRAINING_SPLIT, VALIDATION_SPLIT or TEST_SPLIT: 0, 1 or 2.

        Returns
        -------
        Samples
            These samples, in order.
        """
        return self.take(self.split == split)

    def take(self, rows: slice | IntArray | BoolArray) -> Samples:
        """Take rows.

        Parameters
        ----------
        rows : slice or ndarray
            Any index of numpy's into the first axis.

        Returns
        -------
        Samples
            The rows.
        """
        return Samples(*(getattr(self, field.name)[rows] for field in fields(self)))

    def __len__(self) -> int:
        return len(self.ratio)

    @classmethod
    def join(cls, blocks: list[Samples]) -> Samples:
        """Join blocks of samples.

        Parameters
        ----------
        blocks : list of Samples
            At least one.

        Returns
        -------
        Samples
            Their rows, in order.
        """
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
    """Draw samples.

    Points are uniform over the area, directions uniform in a cone about the inward normal, severities log-uniform about
    the threshold. None is rejected, those that break nothing included.

    Parameters
    ----------
    simulator : FractureSimulator
        What breaks the body.
    count : int
        Samples, at least 1.
    seed : int
        At least 0.
    progress : callable
        Called with the share that is done.
    workers, backend
        See ``run_blocks``.
    transform : callable
        Applied to every block before they are joined.
    begun : sequence of Samples
        The first blocks, where they have been drawn already.

    Returns
    -------
    Samples
        The samples.

    Raises
    ------
    DatasetError
        Where count or seed are out of range, or the simulator does not answer as it should.
    """
    if count < 1 or seed < 0:
        raise DatasetError(f"a count of samples must be at least 1 and a seed at least 0, got {count} and {seed}")
    blocks = []
    rest = list(range(len(begun), -(-count // BLOCK)))
    for block in itertools.chain(begun, run_blocks(sample_block, simulator, seed, rest, workers, backend)):
        blocks.append(transform(block))
        progress(min(1.0, len(blocks) * BLOCK / count))
    return Samples.join(blocks).take(slice(count))


def sample_block(simulator: FractureSimulator, seed: int, block: int) -> Samples:
    """Draw the ``block``-th BLOCK samples of a seed.

    Parameters
    ----------
    simulator : FractureSimulator
        What breaks the body.
    seed : int
        Of the whole sequence.
    block : int
        Which block.

    Returns
    -------
    Samples
        BLOCK of them.

    Raises
    ------
    DatasetError
        Where the simulator does not answer as it should.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1, block)))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        shares, kind = draw_impacts(simulator.surface, BLOCK, rng)
        ratio = ratios(BLOCK, rng)
        reference = reference_factors(simulator, shares)
        impacts = shares.times(ratio * reference)
        response = checked(simulator, impacts, reference, simulator.fracture(impacts))
    broken = response.broken
    split, fold = np.zeros(BLOCK, dtype=np.int64), np.full(BLOCK, -1)
    order = rng.permutation(BLOCK)
    test = round(TEST * BLOCK)
    split[order[:test]] = TEST_SPLIT
    split[order[test : test + round(VALIDATION * (BLOCK - test))]] = VALIDATION_SPLIT
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
    """Check what a simulator of whatever origin answered.

    Parameters
    ----------
    simulator : FractureSimulator
        The simulator.
    impacts : Impacts
        What it was asked.
    thresholds : ndarray of float64, shape (N,)
        What it said of when each impact begins to break the body.
    response : Response
        What it said of the pieces.

    Returns
    -------
    Response
        The same, with labels of int64.

    Raises
    ------
    DatasetError
        Where shapes, types or values are not what they should be.
    """
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
    """Lay down how samples are drawn; files drawn by other rules are read but not extended.

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
