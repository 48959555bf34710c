"""TODO learning.shuffle."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..common.arrays import IntArray


def shuffled(start: int, stop: int, count: int, seed: int) -> IntArray:
    """Places start to stop of a random order of ``count`` rows, without the rest of it: of points there may be
    billions, and of their order a few are ever asked for.

    A Feistel network permutes the least power of 4 that holds ``count``; what falls beyond goes through it again.
    """
    half = np.uint64(max(1, -(-(count - 1).bit_length() // 2)))
    mask = np.uint64((1 << int(half)) - 1)
    keys = np.random.SeedSequence(seed).generate_state(6, np.uint64)

    def permuted(rows: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
        left, right = rows >> half, rows & mask
        for key in keys:
            mixed = (right + key) * np.uint64(0x9E3779B97F4A7C15)  # the odd multiplier nearest 2⁶⁴ / golden ratio
            left, right = right, left ^ ((mixed ^ (mixed >> np.uint64(29))) >> np.uint64(17) & mask)
        return left << half | right

    rows = permuted(np.arange(start, stop, dtype=np.uint64))
    while len(beyond := np.flatnonzero(rows >= count)):
        rows[beyond] = permuted(rows[beyond])
    return rows.astype(np.int64)


def derived_seed(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0] >> np.uint64(1))
