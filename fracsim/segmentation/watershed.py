"""Watershed: flood a field from its maxima and join basins across high passes.

It imports numpy and scipy only, and may be used by every room above ``common``.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph, highest_neighbour

THRESHOLD = 0.2  # of the largest extent (thesis, section 4.8.1)


def watershed(graph: SurfaceGraph, udf: FloatArray, threshold: float = THRESHOLD) -> IntArray:
    """Label the basins of a field (thesis, Algorithm 1).

    The thesis floods from the local maxima in falling order. That gives every vertex the basin of its highest
    neighbour, because this neighbour leaves the queue first. Two basins join across an edge if either end is above the
    threshold: when the lower end leaves the queue, both have their basins. A vertex counts as visited from the moment
    it has a label. Of equal values the lower index comes first, in the queue and among maxima.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.
    threshold : float
        Height of a pass from which two basins join, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        Basin of each vertex, from 0.
    """
    pairs = graph.pairs
    joined = np.maximum(udf[pairs.first], udf[pairs.second]) > threshold
    return pairs.connected(joined, highest_neighbour(pairs, udf))
