"""Graph-based segmentation by Felzenszwalb and Huttenlocher (2004).

It imports numpy and scipy only, and may be used by every room above ``common``.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph

Number = TypeVar("Number", float, FloatArray)

SCALE = 4.0  # k (thesis, section 4.8.1)
SMALLEST = 20  # vertices of a component that has a neighbour (thesis, section 4.8.1)


def felzenszwalb(graph: SurfaceGraph, udf: FloatArray, scale: float = SCALE) -> IntArray:
    """Label the components of a field (thesis, Algorithm 5 and Eq. 4.6).

    Edges in rising order of weight, of equal weights in lexicographic order, join two components if the weight is at
    most the largest weight within either one plus ``scale`` divided by its number of vertices. Then the same edges in
    the same order join components of which one has fewer than ``SMALLEST`` vertices.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.
    scale : float
        k: larger values give larger components.

    Returns
    -------
    ndarray of int64, shape (V,)
        Component of each vertex, from 0.

    Notes
    -----
    Edges are taken in blocks, because a loop in Python over all of them is slow. Edges of a block that cannot join
    anything are removed first: those within a component, all but the first between the same two components, and those
    at a component whose bound is below the first weight of the block, which will never join anything again.
    """
    pairs = graph.pairs
    cost = transformed_udf(udf, udf.max())
    weight = cost[pairs.first] + cost[pairs.second]
    order = np.argsort(weight, kind="stable")
    first, second, weight = pairs.first[order], pairs.second[order], weight[order]
    count = len(graph)
    parent, size, bound = list(range(count)), [1] * count, [scale] * count

    def find(x: int) -> int:
        """Find the root of the component of a vertex."""
        while parent[x] != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        return x

    def open_edges(rows: slice) -> tuple[IntArray, IntArray, FloatArray]:
        """Find edges of a block between different components, the first of each two components, in order."""
        root = _roots(parent)
        a, b = root[first[rows]], root[second[rows]]
        between = np.flatnonzero(a != b)
        key = np.minimum(a, b)[between] * count + np.maximum(a, b)[between]
        between = between[np.sort(np.unique(key, return_index=True)[1])]
        return a[between], b[between], weight[rows][between]

    start, length = 0, max(count // 2, 1)
    while start < len(weight):
        rows = slice(start, start + length)
        a, b, w = open_edges(rows)
        limit = np.asarray(bound)
        possible = np.minimum(limit[a], limit[b]) >= weight[start]
        for i, j, value in zip(a[possible].tolist(), b[possible].tolist(), w[possible].tolist(), strict=True):
            i, j = find(i), find(j)
            if i != j and value <= bound[i] and value <= bound[j]:
                if size[i] < size[j]:
                    i, j = j, i
                parent[j] = i
                size[i] += size[j]
                bound[i] = value + scale / size[i]
        start, length = start + length, 2 * length
    a, b, _ = open_edges(slice(None))
    sizes = np.asarray(size)
    small = np.minimum(sizes[a], sizes[b]) < SMALLEST
    for i, j in zip(a[small].tolist(), b[small].tolist(), strict=True):
        i, j = find(i), find(j)
        if i != j and min(size[i], size[j]) < SMALLEST:
            parent[j] = i
            size[i] += size[j]
    return np.unique(_roots(parent), return_inverse=True)[1].astype(np.int64)


def transformed_udf(udf: Number, top: float) -> Number:
    """Transform a field so that it is large near cracks and 0 at its maximum (thesis, Eq. 4.6).

    Parameters
    ----------
    udf : float or ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.
    top : float
        The maximum of the field.

    Returns
    -------
    float or ndarray of float64, shape (V,)
        ``(10 (top - udf)) ** 10``. The weight of an edge is the sum of this at both ends.
    """
    x = 10.0 * (top - udf)
    square = x * x  # products round alike for numbers and arrays; powers may not
    fourth = square * square
    return fourth * fourth * square


def _roots(parent: list[int]) -> IntArray:
    """Find the root of every vertex (V,), without changing the list."""
    root = np.asarray(parent)
    while True:
        above = root[root]
        if np.array_equal(above, root):
            return root
        root = above
