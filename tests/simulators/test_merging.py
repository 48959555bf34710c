"""Regions join while they are bound strongly, whatever their order, and small ones join anyway."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.simulators.merging import merge_bound

ROW = np.array([[0, 1], [1, 2], [2, 3]])


@pytest.mark.parametrize(
    ("bonds", "expected"),
    [
        ([1.0, 1.0, 1.0], [0, 0, 0, 0]),
        ([0.0, 1.0, 1.0], [0, 1, 1, 1]),
        ([1.0, 0.0, 1.0], [0, 0, 1, 1]),
        ([0.0, 0.0, 0.0], [0, 1, 2, 3]),
        ([0.5, 0.49, 0.5], [0, 0, 1, 1]),
    ],
)
def test_a_row_of_regions_parts_where_its_bonds_are_weak(bonds, expected):
    label = merge_bound(np.ones(4), ROW, np.ones(3), np.array(bonds), 0.5, 0.0)
    assert label.tolist() == expected


def test_a_crack_into_a_boundary_does_not_part_it_and_one_through_it_does():
    ring = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    into = merge_bound(np.ones(4), ring, np.ones(4), np.array([1.0, 0.0, 1.0, 1.0]), 0.4, 0.0)
    through = merge_bound(np.ones(4), ring, np.ones(4), np.array([1.0, 0.0, 1.0, 0.0]), 0.4, 0.0)
    assert into.tolist() == [0, 0, 0, 0]
    assert through.tolist() == [0, 0, 1, 1]


def test_a_sliver_joins_the_neighbour_that_holds_it_most():
    volumes = np.array([10.0, 0.1, 10.0])
    pairs = np.array([[0, 1], [1, 2]])
    label = merge_bound(volumes, pairs, np.array([5.0, 1.0]), np.array([0.01, 0.02]), 0.5, 1.0)
    assert label.tolist() == [0, 1, 1]


@st.composite
def bodies(draw):
    """A connected body: volumes, pairs, areas and bonds that are all different."""
    count = draw(st.integers(2, 9))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    pairs = {(int(rng.integers(k)), k) for k in range(1, count)}
    pairs |= {tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(count)}
    pairs = np.array(sorted(pairs))
    return rng.uniform(0.1, 1.0, count), pairs, rng.uniform(0.1, 1.0, len(pairs)), rng.random(len(pairs))


@given(bodies(), st.floats(0.05, 0.95), st.floats(0.0, 0.5), st.integers(0, 10**6))
@settings(deadline=None, max_examples=60)
def test_the_groups_depend_on_no_order_and_none_is_too_small(body, least_bond, least_volume, seed):
    volumes, pairs, areas, bonds = body
    label = merge_bound(volumes, pairs, areas, bonds, least_bond, least_volume)
    total = np.bincount(label, volumes)
    assert len(total) == 1 or total.min() >= least_volume
    rng = np.random.default_rng(seed)
    order, rows = rng.permutation(len(volumes)), rng.permutation(len(pairs))
    rank = np.argsort(order)  # region order[k] is called k now
    swapped = np.sort(rank[pairs], axis=1)[rows]
    again = merge_bound(volumes[order], swapped, areas[rows], bonds[rows], least_bond, least_volume)[rank]
    same = label[:, None] == label[None]
    np.testing.assert_array_equal(same, again[:, None] == again[None])


@given(bodies())
@settings(deadline=None, max_examples=40)
def test_weaker_bonds_never_join_more(body):
    volumes, pairs, areas, bonds = body
    counts = [merge_bound(volumes, pairs, areas, bonds, least, 0.0).max() for least in (0.1, 0.3, 0.6, 0.9)]
    assert counts == sorted(counts)
