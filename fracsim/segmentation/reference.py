"""The thesis's segmentations as the thesis states them, vertex by vertex on a NetworkX graph.

The fast ones are tested and timed against these; only tests, benchmarks and studies may import this file. Where the
thesis leaves something open, the docstrings of the fast ones say how both read it.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from .felzenszwalb import SMALLEST, transformed_udf
from .graph import SurfaceGraph
from .kmeans import ITERATIONS, features, first_centres
from .region_growing import STEP

try:
    import networkx as nx
except ImportError as error:
    raise MissingExtraError("networkx", "bake") from error


def prepare(graph: SurfaceGraph, udf: FloatArray) -> nx.Graph:
    """Build the graph that the thesis's pipeline starts from.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.

    Returns
    -------
    networkx.Graph
        Vertices 0 to V - 1 with attributes ``udf`` and ``position``, and their edges and links.
    """
    result = nx.Graph()
    for vertex, (height, position) in enumerate(zip(udf.tolist(), graph.vertices.tolist(), strict=True)):
        result.add_node(vertex, udf=height, position=position)
    result.add_edges_from(zip(graph.pairs.first.tolist(), graph.pairs.second.tolist(), strict=True))
    return result


def watershed(graph: nx.Graph, threshold: float) -> IntArray:
    """Label the basins of a field (thesis, Algorithm 1).

    Parameters
    ----------
    graph : networkx.Graph
        What ``prepare`` returns.
    threshold : float
        Height of a pass from which two basins join, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        A label for each vertex; any numbers.
    """
    udf = nx.get_node_attributes(graph, "udf")
    label = {vertex: vertex for vertex in _maxima(graph, udf)}
    groups = nx.utils.UnionFind(label)
    queue = [(-udf[vertex], vertex) for vertex in label]
    heapq.heapify(queue)
    while queue:
        _, vertex = heapq.heappop(queue)
        for neighbour in graph[vertex]:
            if neighbour not in label and udf[neighbour] <= udf[vertex]:
                label[neighbour] = label[vertex]
                heapq.heappush(queue, (-udf[neighbour], neighbour))
            elif (
                neighbour in label
                and label[neighbour] != label[vertex]
                and (udf[neighbour] > threshold or udf[vertex] > threshold)
            ):
                groups.union(label[neighbour], label[vertex])
    return np.array([groups[label[vertex]] for vertex in graph])


def region_growing(graph: nx.Graph, merged: float) -> IntArray:
    """Label the regions of a field (thesis, section 4.6.1 and section 4.8.1).

    Parameters
    ----------
    graph : networkx.Graph
        What ``prepare`` returns.
    merged : float
        Height of both ends of an edge from which two regions join, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        A label for each vertex; any numbers.
    """
    udf = nx.get_node_attributes(graph, "udf")
    seeds = sorted(_maxima(graph, udf), key=lambda vertex: (-udf[vertex], vertex))
    label = {vertex: number for number, vertex in enumerate(seeds)}
    top = max(udf.values())
    last = max(math.ceil(top / STEP), 0)
    levels: dict[int, list[int]] = {}
    for vertex in graph:
        levels.setdefault(min(math.ceil((top - udf[vertex]) / STEP), last), []).append(vertex)
    waiting: set[int] = set()
    for level in sorted(levels):
        waiting.update(vertex for vertex in levels[level] if vertex not in label)
        grown = True
        while grown:
            chosen = {}
            for vertex in waiting:
                votes = Counter(label[neighbour] for neighbour in graph[vertex] if neighbour in label)
                if votes:
                    chosen[vertex] = min(votes, key=lambda region: (-votes[region], region))
            label.update(chosen)
            waiting.difference_update(chosen)
            grown = bool(chosen)
    groups = nx.utils.UnionFind(range(len(seeds)))
    for a, b in graph.edges:
        if label[a] != label[b] and udf[a] >= merged and udf[b] >= merged:
            groups.union(label[a], label[b])
    return np.array([groups[label[vertex]] for vertex in graph])


def hierarchical(graph: nx.Graph, stop: float) -> IntArray:
    """Label the clusters of a field (thesis, Algorithm 3).

    Parameters
    ----------
    graph : networkx.Graph
        What ``prepare`` returns.
    stop : float
        The sum of both ends of an edge below which merging ends, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        A label for each vertex; any numbers.
    """
    udf = nx.get_node_attributes(graph, "udf")
    clusters = nx.utils.UnionFind(graph)
    for a, b in sorted(graph.edges, key=lambda edge: udf[edge[0]] + udf[edge[1]], reverse=True):
        if udf[a] + udf[b] < stop:
            break
        if clusters[a] != clusters[b]:
            clusters.union(a, b)
    return np.array([clusters[vertex] for vertex in graph])


def kmeans(graph: nx.Graph, clusters: float) -> IntArray:
    """Label clusters (thesis, Algorithm 4), from the same first centres as the fast version.

    Parameters
    ----------
    graph : networkx.Graph
        What ``prepare`` returns.
    clusters : float
        The number of clusters.

    Returns
    -------
    ndarray of int64, shape (V,)
        A label for each vertex; any numbers.
    """
    positions = np.array(list(nx.get_node_attributes(graph, "position").values()))
    heights = np.array(list(nx.get_node_attributes(graph, "udf").values()))
    array = features(positions, heights)
    means, items = first_centres(array, clusters).tolist(), array.tolist()
    label: list[int] = []
    for _ in range(ITERATIONS):
        before = label
        label = []
        for item in items:
            square = [sum((x - y) ** 2 for x, y in zip(item, mean, strict=True)) for mean in means]
            label.append(square.index(min(square)))
        if label == before:
            break
        for cluster in range(len(means)):
            members = [item for item, number in zip(items, label, strict=True) if number == cluster]
            if members:
                means[cluster] = [sum(column) / len(members) for column in zip(*members, strict=True)]
    return np.array(label)


def felzenszwalb(graph: nx.Graph, scale: float) -> IntArray:
    """Label the components of a field (thesis, Algorithm 5 and Eq. 4.6), and join small ones.

    Parameters
    ----------
    graph : networkx.Graph
        What ``prepare`` returns.
    scale : float
        k: larger values give larger components.

    Returns
    -------
    ndarray of int64, shape (V,)
        A label for each vertex; any numbers.
    """
    udf = nx.get_node_attributes(graph, "udf")
    top = max(udf.values())
    weight = {(a, b): transformed_udf(udf[a], top) + transformed_udf(udf[b], top) for a, b in graph.edges}
    edges = sorted(weight, key=lambda edge: (weight[edge], edge))
    component = {vertex: [vertex] for vertex in graph}  # every vertex of a component knows all of it
    largest = dict.fromkeys(graph, 0.0)  # weight within, by the component's first vertex

    def join(a: int, b: int) -> None:
        larger, smaller = component[a], component[b]
        if len(larger) < len(smaller):
            larger, smaller = smaller, larger
        larger.extend(smaller)
        for vertex in smaller:
            component[vertex] = larger

    for a, b in edges:
        first, second = component[a], component[b]
        bound = min(largest[vertices[0]] + scale / len(vertices) for vertices in (first, second))
        if first is not second and weight[a, b] <= bound:
            join(a, b)
            largest[component[a][0]] = weight[a, b]
    for a, b in edges:
        if component[a] is not component[b] and min(len(component[a]), len(component[b])) < SMALLEST:
            join(a, b)
    return np.array([component[vertex][0] for vertex in graph])


def _maxima(graph: nx.Graph, udf: dict[int, float]) -> list[int]:
    """List vertices larger than all their neighbours; of equal values, the lower index is larger."""
    return [v for v in graph if all((udf[v], -v) > (udf[n], -n) for n in graph[v])]


# Names of the fast versions -> function from the graph of ``prepare`` and the parameter to labels (V,).
REFERENCES: dict[str, Callable[[nx.Graph, float], IntArray]] = {
    "watershed": watershed,
    "region_growing": region_growing,
    "hierarchical": hierarchical,
    "kmeans": kmeans,
    "felzenszwalb": felzenszwalb,
}
