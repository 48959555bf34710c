"""The thesis's segmentations: the fast versions against the thesis's own statements of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from segmentation_samples import planes, same

from fracsim.segmentation import METHODS
from fracsim.segmentation.graph import SurfaceGraph
from fracsim.segmentation.midpoints import midpoint_segmentation
from fracsim.segmentation.reference import REFERENCES, prepare
from fracsim.solids.geodesics import CAP

# Within the range of the fields below, so that each method joins some vertices and leaves others apart.
PARAMETERS = {
    "watershed": st.floats(0.0, 0.35),
    "region_growing": st.floats(0.0, 0.35),
    "hierarchical": st.floats(0.0, 0.7),
    "kmeans": st.integers(1, 6),
    "felzenszwalb": st.just(0.0) | st.floats(0.01, 500.0),
}


def random_graph(rng, count, pairs):
    """A random graph, which may fall into components and have isolated vertices; some of its pairs are links."""
    ends = np.unique(np.sort(rng.integers(0, count, (pairs, 2)), axis=1), axis=0)
    ends = ends[ends[:, 0] != ends[:, 1]]
    link = rng.random(len(ends)) < 0.2
    vertices = rng.random((count, 3))
    edges = ends[~link]
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    return SurfaceGraph(vertices, np.zeros((0, 3), np.int64), edges, lengths, ends[link], 1.0)


def random_field(rng, count, levels):
    """Values up to the cap, a few below 0, rounded to so many levels; 0 levels give a field without ties."""
    udf = rng.uniform(-0.05, 0.4, count)
    if levels:
        udf = np.round(udf / 0.45 * levels) * 0.45 / levels
    return np.minimum(udf, CAP if levels else 1.0)


def both(method, graph, udf, parameter):
    """Labels of the fast version and of the reference."""
    return METHODS[method](graph, udf, parameter), REFERENCES[method](prepare(graph, udf), parameter)


@pytest.mark.parametrize("method", [m for m in REFERENCES if m != "kmeans"])
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
def test_kmeans_and_its_reference_agree_where_no_vertex_is_equally_near_to_two_centres(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    graph = random_graph(rng, data.draw(st.integers(10, 200)), 0)
    udf = 3.0 * random_field(rng, len(graph), 0)  # beyond the height at which it is clipped
    assert same(*both("kmeans", graph, udf, data.draw(PARAMETERS["kmeans"])))


def test_kmeans_treats_all_distances_above_one_half_alike():
    rng = np.random.default_rng(0)
    graph = random_graph(rng, 100, 0)
    udf = rng.uniform(0.4, 0.6, 100)
    labels = METHODS["kmeans"](graph, udf, 3)
    assert same(labels, METHODS["kmeans"](graph, np.where(udf > 0.5, 10 * udf, udf), 3))
    assert not same(labels, METHODS["kmeans"](graph, np.where(udf > 0.5, udf, 0.1 * udf), 3))


@pytest.mark.parametrize("method", REFERENCES)
def test_fast_and_reference_agree_on_real_meshes(real, method):
    rng = np.random.default_rng(5)
    field = planes(real.vertices, rng, 2)
    rough = np.clip(planes(real.vertices, rng, 3) + 0.01 * rng.standard_normal(len(real)), 0.0, CAP)
    terraced = np.round(rough / 0.02) * 0.02
    for udf in (field, rough, terraced):
        fast, reference = both(method, real, udf, METHODS[method].default)
        assert same(fast, reference)
        assert 1 < len(np.unique(fast)) < len(real)


def test_an_unbroken_field_is_one_piece(real):
    whole = np.full(len(real) + len(real.edges), CAP)
    for method in ("watershed", "region_growing", "hierarchical", "felzenszwalb"):
        assert not METHODS[method](real, whole[: len(real)]).any()
    assert not midpoint_segmentation(real, whole).any()


def test_small_components_join_a_larger_one(real):
    rng = np.random.default_rng(6)
    labels = METHODS["felzenszwalb"](real, rng.random(len(real)))
    assert np.bincount(labels).min() >= 20
