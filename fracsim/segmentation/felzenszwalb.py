"""Graph-based segmentation by Felzenszwalb and Huttenlocher (2004) on a surface graph."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph

Number = TypeVar("Number", float, FloatArray)

SCALE = 4.0  # k
SMALLEST = 20  # vertices of a component, if it has a neighbour (both: thesis, section 4.8.1)


def felzenszwalb(graph: SurfaceGraph, udf: FloatArray, scale: float = SCALE) -> IntArray:
    """(V,) component labels of a vertex field (thesis, Algorithm 5 and Eq. 4.6).

    Edges by rising weight, ties in lexicographic order, join two components where the weight is at most the largest
    weight within either plus scale / its vertices. Then the same edges, in the same order, join components of which
    either has fewer than SMALLEST vertices.

    Edges are taken in blocks. What a block cannot join is sorted out beforehand: edges within a component, all but
    the first between the same two, and edges at a component whose bound is below the block's first weight, for it
    will never join anything again.
    """
    pairs = graph.pairs
    worth = transformed(udf, udf.max())
    weight = worth[pairs.first] + worth[pairs.second]
    order = np.argsort(weight, kind="stable")
    first, second, weight = pairs.first[order], pairs.second[order], weight[order]
    count = len(graph)
    parent, size, bound = list(range(count)), [1] * count, [scale] * count

    def find(x: int) -> int:
        while parent[x] != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        return x

    def left(rows: slice) -> tuple[IntArray, IntArray, FloatArray]:
        """The edges of a block that run between two components: the first of each two, in order."""
        root = _roots(parent)
        a, b = root[first[rows]], root[second[rows]]
        between = np.flatnonzero(a != b)
        key = np.minimum(a, b)[between] * count + np.maximum(a, b)[between]
        between = between[np.sort(np.unique(key, return_index=True)[1])]
        return a[between], b[between], weight[rows][between]

    start, length = 0, max(count // 2, 1)
    while start < len(weight):
        rows = slice(start, start + length)
        a, b, w = left(rows)
        limit = np.asarray(bound)
        open_ = np.minimum(limit[a], limit[b]) >= weight[start]
        for i, j, value in zip(a[open_].tolist(), b[open_].tolist(), w[open_].tolist(), strict=True):
            i, j = find(i), find(j)
            if i != j and value <= bound[i] and value <= bound[j]:
                if size[i] < size[j]:
                    i, j = j, i
                parent[j] = i
                size[i] += size[j]
                bound[i] = value + scale / size[i]
        start, length = start + length, 2 * length
    a, b, _ = left(slice(None))
    sizes = np.asarray(size)
    small = np.minimum(sizes[a], sizes[b]) < SMALLEST
    for i, j in zip(a[small].tolist(), b[small].tolist(), strict=True):
        i, j = find(i), find(j)
        if i != j and min(size[i], size[j]) < SMALLEST:
            parent[j] = i
            size[i] += size[j]
    return np.unique(_roots(parent), return_inverse=True)[1].astype(np.int64)


def transformed(udf: Number, top: float) -> Number:
    """Large near cracks, 0 where the field is highest (thesis, Eq. 4.6)."""
    x = 10.0 * (top - udf)
    square = x * x  # by products, which round alike for numbers and arrays; powers need not
    fourth = square * square
    return fourth * fourth * square


def _roots(parent: list[int]) -> IntArray:
    root = np.asarray(parent)
    while True:
        above = root[root]
        if np.array_equal(above, root):
            return root
        root = above
