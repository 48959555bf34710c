"""Hierarchical clustering on a surface graph."""

from __future__ import annotations

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph

STOP = 0.2  # of the largest extent: the sum of an edge's ends below which merging ends (thesis, section 4.8.1)


def hierarchical(graph: SurfaceGraph, udf: FloatArray, stop: float = STOP) -> IntArray:
    """(V,) cluster labels of a vertex field (thesis, Algorithm 3).

    Merging over edges by falling sum of their ends until it falls below ``stop`` leaves what hangs together by the
    edges before: neither the order nor ties matter.
    """
    pairs = graph.pairs
    return pairs.connected(udf[pairs.first] + udf[pairs.second] >= stop)
