"""Watershed on a surface graph: flood from the field's peaks and join basins over the passes between them."""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph, highest_around

THRESHOLD = 0.2  # of the largest extent: the thesis's, section 4.8.1


def watershed(graph: SurfaceGraph, udf: FloatArray, threshold: float = THRESHOLD) -> IntArray:
    """(V,) basin labels of a vertex field (thesis, Algorithm 1).

    Flooding from the local maxima in falling order gives every vertex the basin of its highest neighbour, as that is
    dequeued first; two basins join over an edge of which either end exceeds the threshold, the lower end being
    dequeued when both have their basins. A vertex counts as visited from when it has a label. Ties go to the lower
    index, in the queue and among maxima.
    """
    pairs = graph.pairs
    joined = np.maximum(udf[pairs.first], udf[pairs.second]) > threshold
    return pairs.connected(joined, highest_around(pairs, udf))
