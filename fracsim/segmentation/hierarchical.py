"""Hierarchical clustering: merge over edges by falling height, down to a fixed height.

It imports numpy and scipy only, and may be used by every room above ``common``.
"""

from __future__ import annotations

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph

STOP = 0.2  # of the largest extent: merging ends where the two ends of an edge add up to less (thesis, section 4.8.1)


def hierarchical(graph: SurfaceGraph, udf: FloatArray, stop: float = STOP) -> IntArray:
    """Label the clusters of a field (thesis, Algorithm 3).

    The thesis merges over edges in falling order of the sum of their ends, until the sum falls below ``stop``. The
    result is the connected components of the edges before that; neither their order nor ties matter.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.
    stop : float
        The sum of the field at both ends of an edge below which merging ends, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        Cluster of each vertex, from 0.
    """
    pairs = graph.pairs
    return pairs.connected(udf[pairs.first] + udf[pairs.second] >= stop)
