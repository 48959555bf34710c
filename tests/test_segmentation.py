"""Segmentation: fields to labels, by the thesis's rule and by the passes at edge midpoints."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import fracsim
from fracsim.metrics import accepted, amae, ari, mse
from fracsim.segmentation.watershed import watershed


def flood(udf, edges, threshold):
    """The thesis's Algorithm 1, literally: a queue of vertices by falling field, from the local maxima."""
    count = len(udf)
    neighbours = [[] for _ in range(count)]
    for a, b in edges:
        neighbours[a].append(b)
        neighbours[b].append(a)
    label = np.full(count, -1)
    parent = list(range(count))

    def find(x):
        while parent[x] != x:
            x = parent[x]
        return x

    queue = []
    for v in range(count):
        if all(udf[v] > udf[n] for n in neighbours[v]):
            label[v] = v
            heapq.heappush(queue, (-udf[v], v))
    while queue:
        _, v = heapq.heappop(queue)
        for n in neighbours[v]:
            if label[n] < 0 and udf[n] <= udf[v]:
                label[n] = label[v]
                heapq.heappush(queue, (-udf[n], n))
            if label[n] >= 0 and find(label[n]) != find(label[v]) and max(udf[n], udf[v]) > threshold:
                parent[find(label[n])] = find(label[v])
    return np.array([find(x) for x in label])


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_the_watershed_gives_the_partition_of_the_thesis_algorithm(seed, threshold):
    rng = np.random.default_rng(seed)
    count = 30
    edges = np.unique(np.sort(rng.integers(0, count, (60, 2)), axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    udf = rng.permutation(count) / count  # no ties
    assert ari(flood(udf, edges, threshold), watershed(udf, edges, threshold)) == pytest.approx(1.0)


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


def test_links_join_what_the_surface_does_not(ball):
    mesh, udf, midpoints = ball
    poles = [[int(np.argmax(mesh.vertices[:, 2])), int(np.argmin(mesh.vertices[:, 2]))]]
    joined = fracsim.segment(mesh, udf, midpoints=midpoints, links=poles)
    assert joined[poles[0][0]] == joined[poles[0][1]]


def test_size_does_not_matter(ball):
    mesh, udf, _ = ball
    big = trimesh.Trimesh(mesh.vertices * 7, mesh.faces, process=False)
    np.testing.assert_array_equal(
        fracsim.segment(mesh, udf, threshold=0.1), fracsim.segment(big, udf * 7, threshold=0.1)
    )


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"udf": np.ones(3)}, r"udf must have shape \(2562,\), got \(3,\)"),
        ({"udf": np.full(2562, np.nan)}, "not finite"),
        ({"udf": ["a"] * 2562}, "array of numbers"),
        ({"method": "sorcery"}, "unknown segmentation 'sorcery'"),
        ({"midpoints": np.ones(4)}, "midpoints must have shape"),
    ],
)
def test_bad_input_is_a_typed_error(ball, change, fault):
    mesh, udf, _ = ball
    with pytest.raises(fracsim.FracsimError, match=fault):
        fracsim.segment(mesh, **{"udf": udf, **change})


def test_the_measures_are_the_thesis_ones():
    truth, guess = np.array([0.0, 0.1, 0.3]), np.array([0.1, 0.1, 0.2])
    assert mse(truth, guess) == pytest.approx(0.02 / 3)
    assert amae(truth, guess) == pytest.approx((0.1 + 0 + 0.1 / 4) / 3)
    assert ari([0, 0, 1, 1], [5, 5, 2, 2]) == 1.0
    assert accepted([0, 0, 1, 1], [5, 5, 2, 2])
    assert not accepted([0, 0, 1, 1], [0, 1, 0, 1])
