"""Watershed on a surface graph: flood from the field's peaks and join basins over the passes between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .graph import SurfaceGraph, highest_around

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

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


def flooded_passes(udf: FloatArray, shores: IntArray, own: FloatArray, height: float) -> BoolArray:
    """Which of a set of given basins' borders the flood passes over: the merging step of a watershed whose
    basins are known beforehand (the asset's atoms).

    shores: (I, S) vertices along each border. own: (I, S) their distances to it, which the field reads there
    when the border is a crack. The flood passes where the field stands more than ``height`` above that, at the
    second highest of the S: a border that other cracks run beside is still high somewhere.
    """
    return np.asarray(np.count_nonzero(udf[shores] - own > height, axis=1) >= 2)
