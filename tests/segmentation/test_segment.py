"""``fracsim.segment`` and ``fracsim.register_segmentation``: what they accept, and what they refuse."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from segmentation_samples import same

import fracsim
from fracsim.metrics import ari
from fracsim.segmentation import METHODS
from fracsim.segmentation.graph import SurfaceGraph

CRACK = 0.013  # rad, the latitude of the ball's crack


def test_a_crack_round_the_equator_separates_the_hemispheres(ball):
    mesh, udf, midpoints = ball
    truth = mesh.vertices[:, 2] / 0.5 > np.sin(CRACK)
    assert ari(truth, fracsim.segment(mesh, udf, threshold=0.05)) > 0.9
    assert ari(truth, fracsim.segment(mesh, udf, midpoints=midpoints)) == pytest.approx(1.0)


def test_the_watershed_treats_links_as_edges(ball):
    mesh, udf, _ = ball
    top, bottom = int(np.argmax(mesh.vertices[:, 2])), int(np.argmin(mesh.vertices[:, 2]))
    apart = fracsim.segment(mesh, udf)
    assert apart[top] != apart[bottom]
    joined = fracsim.segment(mesh, udf, links=[[top, bottom]])
    assert joined[top] == joined[bottom]


@pytest.mark.parametrize("method", METHODS)
def test_size_does_not_matter(ball, method):
    mesh, udf, _ = ball
    big = trimesh.Trimesh(mesh.vertices * 8, mesh.faces, process=False)  # a power of two: not even rounding differs
    assert same(fracsim.segment(mesh, udf, method), fracsim.segment(big, udf * 8, method))


def test_midpoints_are_read_in_the_order_of_the_edges_of_the_mesh(ball):
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
    for twin, values in ((Shuffled, midpoints[Shuffled.order]), (Plain, midpoints[lexicographic])):
        np.testing.assert_array_equal(fracsim.segment(twin, udf, midpoints=values), expected)


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
def test_a_mesh_of_wrong_arrays_is_a_typed_error(vertices, faces, fault):
    class Mesh:
        pass

    mesh = Mesh()
    mesh.vertices, mesh.faces = vertices, faces
    with pytest.raises(fracsim.MeshError, match=fault):
        fracsim.segment(mesh, np.ones(3))


@pytest.fixture
def toy():
    """A segmentation of our own, registered for one test: vertices above a height are one piece, all others alone."""
    asked = []

    def above(graph, udf, height):
        asked.append((graph, udf, height))
        return graph.pairs.connected(np.minimum(udf[graph.pairs.first], udf[graph.pairs.second]) > height)

    fracsim.register_segmentation("above", above, 0.125)
    yield asked
    del METHODS["above"]


def test_a_registered_segmentation_is_called_by_its_name_with_its_default(ball, toy):
    mesh, udf, _ = ball
    labels = fracsim.segment(mesh, udf, "above")
    graph, field, height = toy[0]
    assert (len(graph), height) == (len(mesh.vertices), 0.125)
    np.testing.assert_allclose(field, udf / graph.size)
    high = field > 0.125
    assert len(np.unique(labels[high & (mesh.vertices[:, 2] > 0)])) == 1
    assert len(np.unique(labels)) == 2 + np.count_nonzero(~high)
    fracsim.segment(mesh, udf, "above", threshold=0.25)
    assert toy[1][2] == 0.25


@pytest.mark.parametrize(
    ("name", "function", "default", "fault"),
    [
        ("watershed", print, 0.1, "the segmentation name 'watershed' is taken"),
        ("", print, 0.1, "not empty"),
        ("toy", "a text", 0.1, "cannot be called"),
        ("toy", print, np.nan, "finite number"),
        ("toy", print, None, "finite number"),
    ],
)
def test_a_registration_that_cannot_work_is_refused(name, function, default, fault):
    before = dict(METHODS)
    with pytest.raises(fracsim.FieldError, match=fault):
        fracsim.register_segmentation(name, function, default)
    assert before == METHODS


@pytest.mark.parametrize("answer", [np.zeros(3, dtype=int), np.zeros(2562), None])
def test_labels_of_a_registered_segmentation_that_are_none_are_refused(ball, answer):
    mesh, udf, _ = ball
    fracsim.register_segmentation("wrong", lambda graph, field, parameter: answer, 0.0)
    try:
        with pytest.raises(fracsim.FieldError, match=r"'wrong' must return integers of shape \(2562,\)"):
            fracsim.segment(mesh, udf, "wrong")
    finally:
        del METHODS["wrong"]


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
