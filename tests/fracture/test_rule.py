"""The breaking rule: which interfaces give way, when a body first falls apart, and what becomes of crumbs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.fracture.predictor import field_from_scores, minimax_scores
from fracsim.fracture.rule import BETA, KAPPA, Interfaces, components, load_ratios, merge_small_pieces, weakest_cut

PAIR = Interfaces(np.array([[0, 1]]), np.ones(1), np.array([[1.0, 0.0, 0.0]]), np.ones(1))
ROWS = np.array([[[0.0, 2.0]]])  # the second atom takes all the motion


@pytest.mark.parametrize(
    ("direction", "expected"),
    [((1, 0, 0), 2.0), ((-1, 0, 0), 2.0 * np.sqrt(KAPPA)), ((0, 1, 0), 2.0 * BETA)],
    ids=["pull", "push", "shear"],
)
def test_tension_shear_and_compression_count_as_the_rule_says(direction, expected):
    drive = load_ratios(ROWS, np.array([[direction]], dtype=float), np.ones((1, 1)), PAIR)
    assert drive[0, 0] == pytest.approx(expected)


def random_graph(rng, atoms=9, extra=8):
    chain = [(k, k + 1) for k in range(atoms - 1)]
    more = [tuple(sorted(rng.choice(atoms, 2, replace=False).tolist())) for _ in range(extra)]
    return np.unique(np.array(chain + more), axis=0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_body_falls_apart_exactly_from_its_weakest_cut_on(seed):
    rng = np.random.default_rng(seed)
    pairs = random_graph(rng)
    drive = rng.uniform(0.1, 5.0, (1, len(pairs)))
    critical = 1.0 / weakest_cut(drive, pairs, 9)[0]
    assert components(drive * critical * 0.999 < 1, pairs, 9).max() == 0
    assert components(drive * critical * 1.001 < 1, pairs, 9).max() > 0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_parting_scores_separate_the_same_atoms_as_the_scores_do(seed, threshold):
    rng = np.random.default_rng(seed)
    pairs = random_graph(rng)
    scores = rng.random(len(pairs))
    parted = minimax_scores(scores, pairs, 9) > threshold
    label = components((scores <= threshold)[None], pairs, 9)[0]
    np.testing.assert_array_equal(parted, label[pairs[:, 0]] != label[pairs[:, 1]])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.5))
def test_no_crumb_is_left_and_pieces_only_ever_merge(seed, floor):
    rng = np.random.default_rng(seed)
    pairs = random_graph(rng)
    volumes = rng.dirichlet(np.ones(9))
    interfaces = Interfaces(pairs, rng.random(len(pairs)), np.zeros((len(pairs), 3)), np.ones(len(pairs)))
    before = components(rng.random((1, len(pairs))) < 0.4, pairs, 9)[0]
    after = merge_small_pieces(before, volumes, interfaces, floor)
    assert np.bincount(after, volumes).min() >= floor or after.max() == 0
    assert len(np.unique(np.stack([before, after]), axis=1).T) == before.max() + 1  # a function of the piece


def test_a_sure_crack_stands_at_its_distance_and_an_unsure_one_further_off():
    distances = np.array([[0.0, 0.1, 0.2], [0.2, 0.1, 0.0]])
    sure = field_from_scores(np.array([1.0, 0.0]), distances, 0.3)
    np.testing.assert_allclose(sure, distances[0], atol=1e-6)
    unsure = field_from_scores(np.array([0.5, 0.0]), distances, 0.3)
    assert (unsure > sure).all()
    np.testing.assert_allclose(field_from_scores(np.zeros(2), distances, 0.3), 0.3)
