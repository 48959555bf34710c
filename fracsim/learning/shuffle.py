"""Random orders of very many rows, and seeds that follow from other seeds. The trainer uses both."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..common.arrays import IntArray


def shuffled(start: int, stop: int, count: int, seed: int) -> IntArray:
    """Work out a stretch of a random order of ``count`` rows, without the rest of it.

    Of training points there may be billions, and only a few places of their order are ever asked for. A Feistel network
    (Luby and Rackoff 1988) permutes the least power of 4 that is at least ``count``; a row beyond ``count`` goes
    through it again until it falls below.

    Parameters
    ----------
    start, stop : int
        The stretch.
    count : int
        Rows.
    seed : int
        Fixes the order.

    Returns
    -------
    ndarray of int64, shape (stop - start,)
        The rows at these places.

    Examples
    --------
    >>> import numpy as np
    >>> order = np.concatenate([shuffled(0, 4, 10, 3), shuffled(4, 10, 10, 3)])
    >>> np.sort(order)
    array([0, 1, 2, 3, 4, 5, 6, 7, 8, 9])
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
    """Derive a seed from another one and a key.

    Parameters
    ----------
    seed : int
        The first seed.
    *key : int
        What the new seed is for.

    Returns
    -------
    int
        A seed below 2**63.
    """
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0] >> np.uint64(1))
