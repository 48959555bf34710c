"""Segmentation: fields to labels, by the thesis's methods and by the passes at edge midpoints."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

import fracsim
from fracsim.fracture.atom_watershed import flooded_passes
from fracsim.metrics import accepted, amae, ari, mse
from fracsim.segmentation import DEFAULTS, METHODS
from fracsim.segmentation.graph import SurfaceGraph
from fracsim.segmentation.midpoints import STRAIGHT, SURE, midpoint_segmentation
from fracsim.segmentation.reference import REFERENCES, prepare
from fracsim.solids.geodesics import CAP
from fracsim.solids.surface import Surface, read_surface, refine
from fracsim.solids.walls import facing_vertices

MESHES = Path(__file__).parents[2] / "meshes"
# Within reach of what the fields below hold, so that each method has something to join and something to leave.
PARAMETERS = {
    "watershed": st.floats(0.0, 0.35),
    "region_growing": st.floats(0.0, 0.35),
    "hierarchical": st.floats(0.0, 0.7),
    "kmeans": st.integers(1, 6),
    "felzenszwalb": st.just(0.0) | st.floats(0.01, 500.0),
}


def random_graph(rng, count, pairs):
    """Any graph, vertices without neighbours and parts of their own included; some of its pairs are links."""
    ends = np.unique(np.sort(rng.integers(0, count, (pairs, 2)), axis=1), axis=0)
    ends = ends[ends[:, 0] != ends[:, 1]]
    link = rng.random(len(ends)) < 0.2
    vertices = rng.random((count, 3))
    edges = ends[~link]
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    return SurfaceGraph(vertices, np.zeros((0, 3), np.int64), edges, lengths, ends[link], 1.0)


def random_field(rng, count, levels):
    """Values up to the cap and a few below 0; of so many levels, or without ties where that is 0."""
    udf = rng.uniform(-0.05, 0.4, count)
    if levels:
        udf = np.round(udf / 0.45 * levels) * 0.45 / levels
    return np.minimum(udf, CAP if levels else 1.0)


def same(one, other):
    """Whether two labellings are one partition."""
    together = len(np.unique(np.stack([one, other]), axis=1).T)
    return together == len(np.unique(one)) == len(np.unique(other))


def both(method, graph, udf, parameter):
    return METHODS[method](graph, udf, parameter), REFERENCES[method](prepare(graph, udf), parameter)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "kmeans"])
@settings(max_examples=120, deadline=None)
@given(st.data())
def test_fast_and_reference_agree_on_any_graph_and_field(method, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    count = data.draw(st.integers(1, 200))
    graph = random_graph(rng, count, data.draw(st.integers(0, 2 * count)))
    udf = random_field(rng, count, data.draw(st.sampled_from([0, 1, 2, 4, 12])))
    fast, reference = both(method, graph, udf, data.draw(PARAMETERS[method]))
    assert same(fast, reference)
    assert set(fast) == set(range(fast.max() + 1))


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_fast_and_reference_agree_where_no_vertex_is_as_near_to_two_centres(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    graph = random_graph(rng, data.draw(st.integers(10, 200)), 0)
    udf = 3.0 * random_field(rng, len(graph), 0)  # beyond where it is clipped
    assert same(*both("kmeans", graph, udf, data.draw(PARAMETERS["kmeans"])))


def test_distances_beyond_a_half_are_alike_to_k_means():
    rng = np.random.default_rng(0)
    graph = random_graph(rng, 100, 0)
    udf = rng.uniform(0.4, 0.6, 100)
    labels = METHODS["kmeans"](graph, udf, 3)
    assert same(labels, METHODS["kmeans"](graph, np.where(udf > 0.5, 10 * udf, udf), 3))
    assert not same(labels, METHODS["kmeans"](graph, np.where(udf > 0.5, udf, 0.1 * udf), 3))


def planes(points, rng, count):
    """Distance to the nearest of some planes, capped: plateaus, ridges and junctions."""
    normal = rng.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = points @ normal.T - points[rng.integers(len(points), size=count)].mean(axis=0) @ normal.T
    return np.minimum(np.abs(height).min(axis=1), CAP)


@pytest.fixture(scope="module", params=["bunny", "vase"])
def real(request):
    surface = refine(read_surface(MESHES / f"{request.param}.obj"))
    return SurfaceGraph.of(surface, facing_vertices(surface))


@pytest.mark.parametrize("method", METHODS)
def test_fast_and_reference_agree_on_real_meshes(real, method):
    rng = np.random.default_rng(5)
    field = planes(real.vertices, rng, 2)
    rough = np.clip(planes(real.vertices, rng, 3) + 0.01 * rng.standard_normal(len(real)), 0.0, CAP)
    terraced = np.round(rough / 0.02) * 0.02
    for udf in (field, rough, terraced):
        fast, reference = both(method, real, udf, DEFAULTS[method])
        assert same(fast, reference)
        assert 1 < len(np.unique(fast)) < len(real)


def test_an_unbroken_field_is_one_piece(real):
    whole = np.full(len(real) + len(real.edges), CAP)
    for method in ("watershed", "region_growing", "hierarchical", "felzenszwalb"):
        assert not METHODS[method](real, whole[: len(real)], DEFAULTS[method]).any()
    assert not midpoint_segmentation(real, whole).any()


def test_small_components_find_a_larger_one(real):
    rng = np.random.default_rng(6)
    labels = METHODS["felzenszwalb"](real, rng.random(len(real)), DEFAULTS["felzenszwalb"])
    assert np.bincount(labels).min() >= 20


CRACK = 0.013  # rad, latitude


@pytest.fixture(scope="module")
def ball():
    """A sphere of diameter 1 m and the distance to a parallel just off its equator, which meets no vertex."""
    mesh = trimesh.creation.icosphere(4, radius=0.5)

    def latitude(points):
        return 0.5 * np.abs(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)) - CRACK)

    return mesh, latitude(mesh.vertices), latitude(mesh.vertices[mesh.edges_unique].mean(axis=1))


def test_a_crack_round_the_equator_parts_the_hemispheres(ball):
    mesh, udf, midpoints = ball
    truth = mesh.vertices[:, 2] / 0.5 > np.sin(CRACK)
    assert ari(truth, fracsim.segment(mesh, udf, threshold=0.05)) > 0.9
    assert ari(truth, fracsim.segment(mesh, udf, midpoints=midpoints)) == pytest.approx(1.0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_passes_find_what_circles_cut_out_of_a_sphere_wherever_they_cross_its_edges(seed, count):
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
    """``passes`` without links, node by node: discs that overlap, and then vertices that climb."""
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
    label = {v: number for number, part in enumerate(nx.connected_components(discs)) for v in part}
    return np.array([label[v] for v in range(count)])


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.01, 0.05]), st.booleans(), st.sampled_from([0.0, 0.1, 0.5]))
def test_passes_are_what_walking_from_disc_to_disc_finds(seed, slack, hole, missing):
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.torus(0.4, 0.1, 24, 8) if hole else trimesh.creation.icosphere(2, radius=0.5)
    mesh.vertices += 0.01 * rng.standard_normal(mesh.vertices.shape)
    if missing:  # faces; what is left has rims, and falls into parts
        mesh.update_faces(rng.random(len(mesh.faces)) > missing)
        mesh.remove_unreferenced_vertices()
    graph = SurfaceGraph.of(mesh)
    points = np.vstack([graph.vertices, graph.vertices[graph.edges].mean(axis=1)])
    nodes = np.clip(planes(points, rng, 3) + 0.01 * rng.standard_normal(len(points)), 0.0, CAP)
    labels = midpoint_segmentation(graph, nodes, slack)
    assert same(labels, walked(graph, nodes, slack))
    assert set(labels) == set(range(labels.max() + 1))


@pytest.fixture(scope="module")
def plate():
    """A plate with a disc punched out of it, whose two faces no way on the surface joins: its graph with and without
    links, the field at its nodes, and which vertices are the disc's."""
    box = trimesh.creation.box((1.0, 1.0, 0.04))
    surface = refine(
        Surface(np.asarray(box.vertices), np.asarray(box.faces, np.int64), 1.0, np.zeros(3), "plate"), 0.04
    )
    linked, plain = SurfaceGraph.of(surface, facing_vertices(surface)), SurfaceGraph.of(surface)
    nodes = np.vstack([plain.vertices, plain.vertices[plain.edges].mean(axis=1)])
    radius = np.linalg.norm(nodes[:, :2], axis=1)
    return linked, plain, np.minimum(np.abs(radius - 0.23), CAP), radius[: len(plain)] < 0.23


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


def test_slack_keeps_a_crack_that_the_field_fills_in_part(plate):
    _, plain, nodes, disc = plate
    points = np.vstack([plain.vertices, plain.vertices[plain.edges].mean(axis=1)])
    gap = np.linalg.norm(points - points[np.argmin(nodes)], axis=1)
    filled = np.maximum(nodes, 0.04 * (1 - (gap / 0.08) ** 2))
    assert ari(disc, midpoint_segmentation(plain, filled)) < 0.9  # the crack leaks
    assert ari(by_face(plain, disc), midpoint_segmentation(plain, filled, 0.06)) > 0.95


def test_links_are_edges_to_the_vertex_watershed(ball):
    mesh, udf, _ = ball
    poles = [[int(np.argmax(mesh.vertices[:, 2])), int(np.argmin(mesh.vertices[:, 2]))]]
    joined = fracsim.segment(mesh, udf, links=poles)
    assert joined[poles[0][0]] == joined[poles[0][1]]


@pytest.mark.parametrize("method", METHODS)
def test_size_does_not_matter(ball, method):
    mesh, udf, _ = ball
    big = trimesh.Trimesh(mesh.vertices * 8, mesh.faces, process=False)  # a power of two: not even rounding differs
    assert same(fracsim.segment(mesh, udf, method), fracsim.segment(big, udf * 8, method))


def test_midpoints_follow_the_list_of_edges_of_the_mesh(ball):
    mesh, udf, midpoints = ball

    class Shuffled:
        vertices, faces = mesh.vertices, mesh.faces
        order = np.random.default_rng(0).permutation(len(midpoints))
        edges_unique = mesh.edges_unique[order, ::-1]

    class Plain:
        vertices, faces = mesh.vertices, mesh.faces

    graph = SurfaceGraph.of(mesh)
    lexicographic = np.lexsort(np.sort(mesh.edges_unique, axis=1).T[::-1])
    np.testing.assert_array_equal(np.sort(mesh.edges_unique, axis=1)[lexicographic], graph.edges)
    expected = fracsim.segment(mesh, udf, midpoints=midpoints)
    for twin, given_ in ((Shuffled, midpoints[Shuffled.order]), (Plain, midpoints[lexicographic])):
        np.testing.assert_array_equal(fracsim.segment(twin, udf, midpoints=given_), expected)


def test_the_flood_passes_where_two_of_a_border_stand_above_it():
    udf = np.array([0.0, 0.05, 0.05, 0.02])
    interface_vertices = np.array([[0, 1, 2, 3], [0, 1, 3, 3], [1, 2, 1, 2]])
    own = np.array([[0.0] * 4, [0.0] * 4, [0.05] * 4])
    np.testing.assert_array_equal(flooded_passes(udf, interface_vertices, own, 0.03), [True, False, False])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"udf": np.ones(3)}, r"udf must have shape \(2562,\), got \(3,\)"),
        ({"udf": np.full(2562, np.nan)}, "not finite"),
        ({"udf": ["a"] * 2562}, "array of numbers"),
        ({"udf": ["1"] * 2562}, "array of numbers"),
        ({"udf": np.ones(2562, complex)}, "array of numbers, got complex"),
        ({"udf": [None] * 2562}, "array of numbers, got object"),
        ({"udf": [[1.0], [1.0, 2.0]]}, "array of numbers"),
        ({"method": "sorcery"}, "unknown segmentation 'sorcery'"),
        ({"midpoints": np.ones(4)}, "midpoints must have shape"),
        ({"midpoints": np.ones(7680), "method": "kmeans"}, "kmeans takes no midpoints"),
        ({"links": [[0, 2562]]}, "links must name vertices from 0 to 2561, got 0 to 2562"),
        ({"links": [[-1, 5]]}, "links must name vertices"),
        ({"links": [[0.0, 1.0]]}, r"links must be integers of shape \(L, 2\), got float64"),
        ({"links": [0, 1]}, "links must be integers of shape"),
        ({"links": [[0, 1], [2]]}, "links must be pairs"),
        ({"threshold": np.inf}, "threshold holds values that are not finite"),
        ({"threshold": "high"}, "threshold must be an array of numbers"),
        ({"threshold": [0.1, 0.2]}, "threshold must have shape"),
        ({"method": "kmeans", "threshold": 2.5}, "whole number of clusters"),
        ({"method": "kmeans", "threshold": 0}, "whole number of clusters"),
    ],
)
def test_bad_input_is_a_typed_error(ball, change, fault):
    mesh, udf, _ = ball
    with pytest.raises(fracsim.FracsimError, match=fault):
        fracsim.segment(mesh, **{"udf": udf, **change})


@pytest.mark.parametrize(
    ("vertices", "faces", "fault"),
    [
        (np.eye(3), [[0, 1, 3]], "faces must name vertices from 0 to 2"),
        (np.eye(3), [[0.0, 1.0, 2.0]], "faces must be integers"),
        (np.eye(3)[:, :2], [[0, 1, 2]], "vertices must have shape"),
        (np.zeros((3, 3)), [[0, 1, 2]], "finite extent"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "finite extent"),
    ],
)
def test_a_mesh_that_is_none_is_a_typed_error(vertices, faces, fault):
    class Mesh:
        pass

    mesh = Mesh()
    mesh.vertices, mesh.faces = vertices, faces
    with pytest.raises(fracsim.MeshError, match=fault):
        fracsim.segment(mesh, np.ones(3))


def test_segmenting_loads_neither_networkx_nor_scikit_learn():
    code = """
import sys, types, numpy as np, fracsim
mesh = types.SimpleNamespace(vertices=np.eye(4, 3), faces=[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
for method in ("watershed", "region_growing", "hierarchical", "felzenszwalb"):
    fracsim.segment(mesh, np.ones(4), method)
fracsim.segment(mesh, np.ones(4), midpoints=np.ones(6))
print(*{name.split(".")[0] for name in sys.modules} & {"networkx", "sklearn", "torch", "trimesh"})
"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == ""


def test_the_measures_are_the_thesis_ones():
    truth, guess = np.array([0.0, 0.1, 0.3]), np.array([0.1, 0.1, 0.2])
    assert mse(truth, guess) == pytest.approx(0.02 / 3)
    assert amae(truth, guess) == pytest.approx((0.1 + 0 + 0.1 / 4) / 3)
    assert ari([0, 0, 1, 1], [5, 5, 2, 2]) == 1.0
    assert accepted([0, 0, 1, 1], [5, 5, 2, 2])
    assert not accepted([0, 0, 1, 1], [0, 1, 0, 1])
