"""The surface graph: its lists of edges and neighbours, and connected components."""

from __future__ import annotations

import networkx as nx
import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from segmentation_samples import same

from fracsim.segmentation.graph import Pairs, SurfaceGraph, descending_order, highest_neighbour, surface_edges


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_connected_components_are_those_of_networkx(seed, count):
    rng = np.random.default_rng(seed)
    ends = np.unique(np.sort(rng.integers(0, count, (count, 2)), axis=1), axis=0)
    ends = ends[ends[:, 0] != ends[:, 1]]
    pairs, joined = Pairs(ends, count), rng.random(len(ends)) < 0.5
    follows = np.where(rng.random(count) < 0.2, rng.integers(0, count, count), np.arange(count))
    extra = rng.integers(0, count + 3, (3, 2)).astype(np.int32)
    graph = nx.Graph()
    graph.add_nodes_from(range(count + 3))
    graph.add_edges_from(ends[joined].tolist())
    graph.add_edges_from(enumerate(follows.tolist()))
    graph.add_edges_from((count + m, node) for m, row in enumerate(extra.tolist()) for node in row)
    expected = np.empty(count + 3, dtype=int)
    for number, component in enumerate(nx.connected_components(graph)):
        expected[list(component)] = number
    labels = pairs.connected(joined, follows, extra)
    assert same(labels, expected[:count])
    assert set(labels) == set(range(labels.max() + 1))


def test_neighbours_list_each_vertex_and_all_that_it_is_paired_with():
    pairs = Pairs(np.array([[0, 1], [0, 2], [2, 3]]), 5)
    starts, vertices = pairs.neighbours
    lists = [sorted(part.tolist()) for part in np.split(vertices, starts[1:])]
    assert lists == [[0, 1, 2], [0, 1], [0, 2, 3], [2, 3], [4]]
    assert pairs.degrees.tolist() == [2, 1, 2, 1, 0]


def test_surface_edges_are_sorted_and_come_once():
    edges = surface_edges(np.array([[2, 0, 1], [1, 3, 2], [4, 4, 0]]))
    assert edges.tolist() == [[0, 1], [0, 2], [0, 4], [1, 2], [1, 3], [2, 3]]


def test_adjacent_edges_share_a_face_and_the_third_edge_closes_it():
    mesh = trimesh.creation.icosphere(1, radius=0.5)
    graph = SurfaceGraph.of(mesh)
    adjacent, third_lengths = graph.adjacent_edges
    assert adjacent.shape == (len(graph.edges), 4)
    for edge, (others, lengths) in enumerate(zip(adjacent, third_lengths, strict=True)):
        expected = set()
        for row in graph.face_edges[(graph.face_edges == edge).any(axis=1)]:
            a, b = (int(k) for k in row if k != edge)
            expected |= {(a, graph.lengths[b]), (b, graph.lengths[a])}
        assert set(zip(others.tolist(), lengths.tolist(), strict=True)) == expected


def test_of_equal_heights_the_lower_index_is_the_higher_one():
    udf = np.array([0.1, 0.3, 0.3, 0.2])
    order, rank = descending_order(udf)
    assert order.tolist() == [1, 2, 3, 0]
    assert rank[order].tolist() == [3, 2, 1, 0]
    assert highest_neighbour(Pairs(np.array([[0, 1], [1, 2], [2, 3]]), 4), udf).tolist() == [1, 1, 1, 2]
