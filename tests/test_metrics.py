"""The measures, compared with the thesis's definitions by brute force, and the errors for wrong input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from fracsim import metrics
from fracsim.common.errors import FieldError

LINE = np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], axis=1)
CHAIN = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])


def brute_chamfer(a, b):
    apart = cdist(a, b)
    return apart.min(axis=1).mean() / 2 + apart.min(axis=0).mean() / 2


def brute_region_chamfer(points, truth, predicted):
    return sum(
        min(brute_chamfer(points[truth == i], points[predicted == j]) for j in np.unique(predicted))
        for i in np.unique(truth)
    )


@st.composite
def partitions(draw):
    """Points, some on top of one another, and two labellings of them with names of any kind."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 60))
    points = rng.random((count, 3))
    if draw(st.booleans()):
        points = np.round(points, 1)
    names = rng.permutation(200)[:count] - 100
    truth = names[rng.integers(0, draw(st.integers(1, count)), count)]
    guess = names[rng.integers(0, draw(st.integers(1, count)), count)]
    if draw(st.booleans()):
        guess = np.where(rng.random(count) < 0.9, truth, guess)
    return points, truth, guess


@given(partitions(), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_a_cell_counts_by_its_volume(case, seed):
    _, truth, guess = case
    volumes = np.random.default_rng(seed).integers(0, 5, len(truth))
    volumes[0] += 1
    score = metrics.volume_ari(truth, guess, volumes)
    # As many points in every cell as its volume: for ever more of them the plain index comes to the same.
    many = 3000 * volumes
    assert score == pytest.approx(metrics.ari(np.repeat(truth, many), np.repeat(guess, many)), abs=2e-2)
    assert score == pytest.approx(metrics.volume_ari(guess, truth, 7.5 * volumes))
    assert metrics.volume_ari(truth, truth, volumes) == pytest.approx(1.0)


def test_volumes_that_are_none_are_refused():
    for wrong in ([1.0], [0.0, 0.0], [1.0, -1.0], [np.nan, 1.0]):
        with pytest.raises(FieldError, match="each label needs a volume"):
            metrics.volume_ari([0, 1], [0, 1], wrong)


# Fields


def test_field_errors_and_acceptance_follow_the_formulas_of_the_thesis():
    truth, guess = np.array([0.0, 0.1, 0.3]), np.array([0.1, 0.1, 0.2])
    assert metrics.mse(truth, guess) == pytest.approx(0.02 / 3)
    assert metrics.amae(truth, guess) == pytest.approx((0.1 + 0 + 0.1 / 4) / 3)
    assert metrics.ari([0, 0, 1, 1], [5, 5, 2, 2]) == 1.0
    assert metrics.accepted([0, 0, 1, 1], [5, 5, 2, 2])
    assert not metrics.accepted([0, 0, 1, 1], [0, 1, 0, 1])


# Boundaries


def test_boundary_vertices_are_those_with_a_neighbour_of_another_label():
    assert metrics.boundary_vertices([0, 0, 7, 7, 7], CHAIN).tolist() == [1, 2]
    assert metrics.boundary_vertices([0, 1, 0, 1, 0], CHAIN).tolist() == [0, 1, 2, 3, 4]
    assert metrics.boundary_vertices([3] * 5, CHAIN).tolist() == []
    assert metrics.boundary_vertices([0, 1], np.zeros((0, 2), dtype=int)).tolist() == []


def test_a_boundary_that_is_one_step_off_is_one_step_off():
    # Boundary vertices 1 and 2 against 2 and 3: on either side one at distance 1 and one at 0.
    assert metrics.boundary_chamfer(LINE, CHAIN, [0, 0, 1, 1, 1], [0, 0, 0, 1, 1]) == pytest.approx(0.5)
    assert metrics.boundary_chamfer(LINE, CHAIN, [0, 0, 1, 1, 1], [4, 4, 2, 2, 2]) == 0.0


def test_a_missing_boundary_costs_the_largest_extent_and_two_missing_ones_nothing():
    whole, halves = [0] * 5, [0, 0, 1, 1, 1]
    assert metrics.boundary_chamfer(LINE, CHAIN, whole, [1] * 5) == 0.0
    assert metrics.boundary_chamfer(LINE, CHAIN, halves, whole) == 4.0
    assert metrics.boundary_chamfer(LINE, CHAIN, whole, halves) == 4.0


@settings(max_examples=60, deadline=None)
@given(partitions())
def test_boundary_chamfer_is_what_the_thesis_defines(case):
    points, truth, guess = case
    rng = np.random.default_rng(len(points))
    edges = rng.integers(0, len(points), (2 * len(points), 2))
    found = []
    for labels in (truth, guess):
        ends = {int(v) for a, b in edges if labels[a] != labels[b] for v in (a, b)}
        assert set(metrics.boundary_vertices(labels, edges).tolist()) == ends
        found.append(points[sorted(ends)])
    got = metrics.boundary_chamfer(points, edges, truth, guess)
    assert got == metrics.boundary_chamfer(points, edges, guess, truth)
    if len(found[0]) and len(found[1]):
        assert got == pytest.approx(brute_chamfer(*found))
        assert got <= math.sqrt(3)
    elif len(found[0]) == len(found[1]):
        assert got == 0
    else:
        assert got == np.ptp(points, axis=0).max()


# Point sets and regions


def test_chamfer_weighs_either_side_by_its_own_number_of_points():
    one, three = [[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [6.0, 0.0, 0.0]]
    assert metrics.chamfer(one, three) == pytest.approx(1 / 2 + (1 + 2 + 6) / 6)
    assert metrics.chamfer(three, one) == metrics.chamfer(one, three)


@settings(max_examples=150, deadline=None)
@given(partitions())
def test_region_chamfer_is_exact_although_it_leaves_pairs_out(case):
    points, truth, guess = case
    got = metrics.region_chamfer(points, truth, guess)
    assert got == pytest.approx(brute_region_chamfer(points, truth, guess), abs=1e-12)
    assert metrics.region_chamfer(points, truth, truth) == 0


def with_small_pieces(rng, count, pieces, small):
    """Points on a sphere in ``pieces`` true regions, and a guess with ``small`` tiny regions along their borders."""
    points = rng.standard_normal((count, 3))
    points /= 2 * np.linalg.norm(points, axis=1)[:, None]
    nearest = np.sort(cdist(points, points[:pieces]), axis=1)
    truth = cdist(points, points[:pieces]).argmin(axis=1)
    border = np.argsort(nearest[:, 1] - nearest[:, 0])[: 2 * small]
    guess = truth.copy()
    guess[border] = pieces + np.arange(2 * small) // 2
    return points, truth, guess


def test_region_chamfer_of_many_small_pieces_computes_a_few_percent_of_all_pairs(monkeypatch):
    points, truth, guess = with_small_pieces(np.random.default_rng(0), 3000, 30, 500)
    groups = [points[guess == j] for j in np.unique(guess)]
    expected = sum(min(metrics.chamfer(points[truth == i], group) for group in groups) for i in range(30))
    built = []

    def counted(tree_points):
        built.append(len(tree_points))
        return cKDTree(tree_points)

    monkeypatch.setattr(metrics, "cKDTree", counted)
    got = metrics.region_chamfer(points, truth, guess)
    assert got == pytest.approx(expected)
    assert got > 0
    assert len(built) < 0.02 * 30 * len(groups)  # one tree for each true piece, and one for each piece compared with


# Partitions, whole or in pieces


def test_ari_ami_and_acceptance_see_partitions_and_not_names():
    truth, same, other = [0, 0, 1, 1, 2, 2], [5, 5, 9, 9, 7, 7], [0, 1, 0, 1, 0, 1]
    for score in (metrics.ari, metrics.ami):
        assert score(truth, same) == pytest.approx(1.0)
        assert score(truth, other) < 0.1
    assert metrics.accepted(truth, same)
    assert not metrics.accepted(truth, other)


@pytest.mark.parametrize(
    ("truth", "predicted", "expected"),
    [
        ([1, 1, 1, 0], [1, 1, 1, 0], 1.0),
        ([1, 1, 1, 0], [1, 1, 1, 1], 0.5),
        ([1, 1, 1, 0], [0, 0, 1, 0], 2 / 3),
        ([1, 0], [0, 1], 0.0),
    ],
)
def test_balanced_accuracy_is_the_mean_of_both_kinds(truth, predicted, expected):
    assert metrics.balanced_accuracy(np.array(truth, bool), np.array(predicted, bool)) == pytest.approx(expected)


@pytest.mark.parametrize("value", [True, False])
def test_balanced_accuracy_of_one_kind_is_not_a_number(value):
    assert math.isnan(metrics.balanced_accuracy(np.full(3, value), np.array([True, False, True])))


def test_the_break_curve_of_the_truth_is_a_step_at_one():
    rng = np.random.default_rng(0)
    ratio = np.exp(rng.uniform(np.log(0.3), np.log(5.0), 500))
    bins = np.geomspace(0.3, 5.0, 9)
    bins[np.abs(bins - 1.0).argmin()] = 1.0
    curve = metrics.break_curve(ratio, ratio >= 1, bins)
    np.testing.assert_array_equal(curve, bins[:-1] >= 1)
    late = metrics.break_curve(ratio, ratio >= 2, bins)
    assert np.all(late <= curve)
    assert np.any(late < curve)


def test_an_empty_bin_of_the_break_curve_is_not_a_number():
    curve = metrics.break_curve([0.5, 0.6, 3.0], np.array([False, True, True]), [0.3, 1.0, 2.0, 5.0])
    np.testing.assert_array_equal(curve, [0.5, np.nan, 1.0])


# Faults

GOOD = np.array([0, 0, 1, 1, 1])
NAN = np.full((5, 3), np.nan)


@pytest.mark.parametrize(
    ("call", "fault"),
    [
        (lambda: metrics.mse([1.0], [1.0, 2.0]), "one shape"),
        (lambda: metrics.amae([], []), "not be empty"),
        (lambda: metrics.amae([1.0, np.inf], [1.0, 2.0]), "finite"),
        (lambda: metrics.ari(GOOD, GOOD[:-1]), "one length"),
        (lambda: metrics.ami([], []), "not be empty"),
        (lambda: metrics.ari([0.0, np.nan], [0, 1]), "whole numbers"),
        (lambda: metrics.chamfer(np.zeros((0, 3)), LINE), "no points"),
        (lambda: metrics.chamfer(LINE[:, :2], LINE), r"shape \(n, 3\)"),
        (lambda: metrics.chamfer(LINE, NAN), "finite"),
        (lambda: metrics.boundary_vertices(GOOD, CHAIN + 1), "from 0 to 4"),
        (lambda: metrics.boundary_vertices(GOOD, CHAIN - 1), "from 0 to 4"),
        (lambda: metrics.boundary_vertices(GOOD, CHAIN + 0.5), "whole numbers"),
        (lambda: metrics.boundary_vertices(GOOD, CHAIN.T[:1]), r"\(E, 2\)"),
        (lambda: metrics.boundary_chamfer(LINE[:4], CHAIN, GOOD, GOOD), "label for each of 4 vertices"),
        (lambda: metrics.boundary_chamfer(NAN, CHAIN, GOOD, GOOD), "finite"),
        (lambda: metrics.region_chamfer(LINE, GOOD[:4], GOOD[:4]), "label for each of 5 vertices"),
        (lambda: metrics.region_chamfer(LINE, GOOD, GOOD.astype(float)), "whole numbers"),
        (lambda: metrics.balanced_accuracy(GOOD, GOOD), "booleans"),
        (lambda: metrics.balanced_accuracy(GOOD > 0, GOOD[1:] > 0), "one length"),
        (lambda: metrics.break_curve([1.0, 2.0], np.array([True]), [0.3, 5.0]), "one length"),
        (lambda: metrics.break_curve([np.nan], np.array([True]), [0.3, 5.0]), "finite"),
        (lambda: metrics.break_curve([1.0], np.array([True]), [5.0, 0.3]), "rise"),
    ],
)
def test_what_cannot_be_compared_is_a_typed_error(call, fault):
    with pytest.raises(FieldError, match=fault):
        call()
