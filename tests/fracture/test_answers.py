"""The shipped assets answer as they did before: 500 impulses a mesh, and the labels that followed from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import fracsim

ANSWERS = Path(__file__).parent / "answers.npz"


def test_shipped_assets_answer_as_they_always_did(shipped):
    with np.load(ANSWERS) as answers:
        impulses, expected = answers[f"{shipped.name} impulses"], answers[f"{shipped.name} labels"]
    assert len(impulses) == len(expected) == 500
    assert (expected.max(axis=1) > 0).sum() > 100  # enough of them break it
    labels = np.array([shipped.fracture(fracsim.Impulse(row[:3], row[3:6], row[6])).labels for row in impulses])
    different = np.flatnonzero((labels != expected).any(axis=1))
    assert not len(different), f"{len(different)} of 500 impulses on the {shipped.name} differ: {different[:10]}"
