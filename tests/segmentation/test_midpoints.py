"""Midpoint segmentation: against a slow version of it, and on surfaces whose pieces are known."""

from __future__ import annotations

from dataclasses import replace

import networkx as nx
import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from segmentation_samples import planes, same

from fracsim.metrics import ari
from fracsim.segmentation.graph import SurfaceGraph
from fracsim.segmentation.midpoints import STRAIGHT, SURE, midpoint_segmentation
from fracsim.solids.geodesics import CAP


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_midpoint_segmentation_finds_the_pieces_that_circles_cut_from_a_sphere(seed, count):
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(4, radius=0.5)
    graph = SurfaceGraph.of(ball)
    axes = rng.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angle = rng.uniform(0.3, np.pi / 2, count)

    def signed(points):
        points = points / np.linalg.norm(points, axis=1)[:, None]
        return 0.5 * (np.arccos(np.clip(points @ axes.T, -1.0, 1.0)) - angle)  # (N, count)

    nodes = np.vstack([graph.vertices, graph.vertices[graph.edges].mean(axis=1)])
    labels = midpoint_segmentation(graph, np.minimum(np.abs(signed(nodes)).min(axis=1), CAP))
    inside = signed(graph.vertices) < 0
    side = inside @ (1 << np.arange(count))
    pieces = graph.surface.connected(side[graph.surface.first] == side[graph.surface.second])
    assert ari(pieces, labels) > 0.97


def walked(graph, nodes, slack):
    """Midpoint segmentation without links, node by node: overlapping discs, then vertices without an overlap."""
    count, edge = len(graph), {tuple(e): k for k, e in enumerate(graph.edges.tolist())}
    discs = nx.Graph()
    discs.add_nodes_from(range(len(nodes)))
    for (a, b), k in edge.items():
        for v in (a, b):
            if nodes[v] + nodes[count + k] > SURE * graph.lengths[k] + slack:
                discs.add_edge(v, count + k)
    for face in graph.faces.tolist():
        k = [edge[min(a, b), max(a, b)] for a, b in zip(face, face[1:] + face[:1], strict=True)]
        for i in range(3):
            x, y, third = k[i], k[i - 1], k[i - 2]
            if nodes[count + x] + nodes[count + y] > SURE * graph.lengths[third] + slack:
                discs.add_edge(count + x, count + y)
    best = {}
    for (a, b), k in edge.items():
        low, high, middle = min(nodes[a], nodes[b]), max(nodes[a], nodes[b]), nodes[count + k]
        if middle > high / 2 and abs(middle - (low + high) / 2) <= STRAIGHT * low + slack:
            for here, there in ((a, b), (b, a)):
                best[here] = max(best.get(here, (0.0, 0, 0)), (middle, k, there))
    alone = [v for v in range(count) if not discs[v]]
    discs.add_edges_from((v, best[v][2]) for v in alone if v in best)
    label = {v: number for number, nodes_of in enumerate(nx.connected_components(discs)) for v in nodes_of}
    return np.array([label[v] for v in range(count)])


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.01, 0.05]), st.booleans(), st.sampled_from([0.0, 0.1, 0.5]))
def test_midpoint_segmentation_agrees_with_a_walk_from_disc_to_disc(seed, slack, hole, missing):
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.torus(0.4, 0.1, 24, 8) if hole else trimesh.creation.icosphere(2, radius=0.5)
    mesh.vertices += 0.01 * rng.standard_normal(mesh.vertices.shape)
    if missing:  # remove faces, so that the surface has rims and falls into components
        mesh.update_faces(rng.random(len(mesh.faces)) > missing)
        mesh.remove_unreferenced_vertices()
    graph = SurfaceGraph.of(mesh)
    points = np.vstack([graph.vertices, graph.vertices[graph.edges].mean(axis=1)])
    nodes = np.clip(planes(points, rng, 3) + 0.01 * rng.standard_normal(len(points)), 0.0, CAP)
    labels = midpoint_segmentation(graph, nodes, slack)
    assert same(labels, walked(graph, nodes, slack))
    assert set(labels) == set(range(labels.max() + 1))


def by_face(graph, disc):
    return disc * (1 + (graph.vertices[:, 2] > 0))


def test_links_join_the_two_faces_of_a_shard(plate):
    linked, plain, nodes, disc = plate
    apart, together = midpoint_segmentation(plain, nodes), midpoint_segmentation(linked, nodes)
    assert [ari(by_face(plain, disc), labels) > 0.99 for labels in (apart, together)] == [True, False]
    assert ari(disc, together) > 0.99


def test_links_across_a_crack_do_not_join_its_sides(plate):
    linked, plain, nodes, disc = plate
    radius = np.linalg.norm(plain.vertices[:, :2], axis=1)
    inner, outer = np.flatnonzero(np.abs(radius - 0.13) < 0.03)[:12], np.flatnonzero(np.abs(radius - 0.33) < 0.03)
    _, nearest = cKDTree(plain.vertices[outer]).query(plain.vertices[inner])
    wrong = np.stack([inner, outer[nearest]], axis=1)
    graph = replace(plain, links=np.vstack([linked.links, wrong]))
    assert ari(disc, midpoint_segmentation(graph, nodes)) > 0.99


def test_slack_keeps_a_crack_that_the_field_hides_in_one_place(plate):
    _, plain, nodes, disc = plate
    points = np.vstack([plain.vertices, plain.vertices[plain.edges].mean(axis=1)])
    gap = np.linalg.norm(points - points[np.argmin(nodes)], axis=1)
    filled = np.maximum(nodes, 0.04 * (1 - (gap / 0.08) ** 2))
    assert ari(disc, midpoint_segmentation(plain, filled)) < 0.9  # the two sides join where the crack is hidden
    assert ari(by_face(plain, disc), midpoint_segmentation(plain, filled, 0.06)) > 0.95
