"""Watershed on a surface graph: flood from the field's peaks and join basins over the passes between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

THRESHOLD = 0.2  # of the largest extent: the thesis's, section 4.8.1


def watershed(udf: FloatArray, edges: IntArray, threshold: float = THRESHOLD) -> IntArray:
    """(V,) basin labels of a vertex field (thesis, Algorithm 1), with the field in the units of ``threshold``.

    Flooding from the local maxima in falling order gives every vertex the basin of its highest neighbour;
    two basins join over an edge of which either end exceeds the threshold. Ties go to the lower index.
    """
    count = len(udf)
    rank = np.empty(count, dtype=np.int64)
    rank[np.lexsort((-np.arange(count), udf))] = np.arange(count)  # a total order: higher field, lower index
    start, end = np.concatenate([edges, edges[:, ::-1]]).T
    highest = rank.copy()
    np.maximum.at(highest, start, rank[end])
    by_rank = np.argsort(rank)
    joined = edges[(udf[edges] > threshold).any(axis=1)]
    rows = np.concatenate([np.arange(count), joined[:, 0]])
    columns = np.concatenate([by_rank[highest], joined[:, 1]])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def watershed_passes(
    udf: FloatArray, midpoints: FloatArray, edges: IntArray, lengths: FloatArray, links: IntArray
) -> IntArray:
    """(V,) labels where the field is also known halfway along every edge, the pass between its two ends.

    A crack that crosses an edge dips there below both ends, so ends join where the pass is at least 0.7 of
    their mean and more than 0.2 of the edge's length. Links join outright: they run through the solid.
    """
    joined = (midpoints > 0.2 * lengths) & (midpoints > 0.7 * udf[edges].mean(axis=1))
    pairs = np.vstack([edges[joined], links])
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(udf), len(udf)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def flooded_passes(udf: FloatArray, shores: IntArray, own: FloatArray, height: float) -> BoolArray:
    """Which of a set of given basins' borders the flood passes over: the merging step of a watershed whose
    basins are known beforehand (the asset's atoms).

    shores: (I, S) vertices along each border. own: (I, S) their distances to it, which the field reads there
    when the border is a crack. The flood passes where the field stands more than ``height`` above that, at the
    second highest of the S: a border that other cracks run beside is still high somewhere.
    """
    second = shores.shape[1] - 2
    return np.asarray(np.partition(udf[shores] - own, second, axis=1)[:, second] > height)
