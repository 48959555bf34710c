"""Impulses: finite, of unit direction, and refused with a message otherwise."""

from __future__ import annotations

import numpy as np
import pytest

import fracsim
from fracsim.common.checks import at_least, finite_vector, vector_of
from fracsim.common.contact import LOAD_DURATION
from fracsim.common.impulse import as_impulses


@pytest.mark.parametrize(
    ("point", "direction", "magnitude", "fault"),
    [
        ((0, 0), (0, 0, 1), 1.0, "impulse point must be 3 finite numbers"),
        ("abc", (0, 0, 1), 1.0, "impulse point must be 3 finite numbers"),
        ((0, 0, np.nan), (0, 0, 1), 1.0, "impulse point must be 3 finite numbers"),
        ((0, 0, 0), (0, np.inf, 1), 1.0, "impulse direction must be 3 finite numbers"),
        ((0, 0, 0), (0, 0, 0), 1.0, "impulse direction is zero"),
        ((0, 0, 0), (0, 0, 1), -1.0, "impulse magnitude must be finite and at least 0"),
        ((0, 0, 0), (0, 0, 1), np.nan, "impulse magnitude must be finite and at least 0"),
        ((0, 0, 0), (0, 0, 1), "hard", "impulse magnitude must be finite and at least 0"),
    ],
)
def test_an_impulse_that_makes_no_sense_is_refused(point, direction, magnitude, fault):
    with pytest.raises(fracsim.ImpulseError, match=fault):
        fracsim.Impulse(point, direction, magnitude)


def test_an_impulse_keeps_copies_that_cannot_be_written_to():
    point = np.zeros(3)
    impulse = fracsim.Impulse(point, (0, 3, 4), 1)
    point[0] = 7.0
    assert impulse.point.tolist() == [0, 0, 0]
    np.testing.assert_allclose(impulse.direction, (0, 0.6, 0.8))
    with pytest.raises(ValueError, match="read-only"):
        impulse.point[0] = 1.0


def test_impulses_are_one_or_several_but_not_none():
    impulse = fracsim.Impulse((0, 0, 0), (0, 0, 1), 1.0)
    assert as_impulses(impulse) == (impulse,)
    assert as_impulses([impulse, impulse]) == (impulse, impulse)
    with pytest.raises(fracsim.ImpulseError, match="no impulse given"):
        as_impulses([])
    with pytest.raises(fracsim.ImpulseError, match="got str"):
        as_impulses(["hard"])


def test_checks_raise_the_error_that_the_caller_names():
    with pytest.raises(fracsim.BakeError, match="cells must be a number of at least 50, got 3"):
        at_least(3, 50, "cells", fracsim.BakeError)
    with pytest.raises(fracsim.PhysicsError, match="position must be 3 finite numbers"):
        finite_vector([1, 2], "position")
    assert vector_of([1, np.nan], 2) is not None
    assert vector_of([1, 2], 3) is None


@pytest.mark.parametrize("duration", [0.0, -1e-3, np.inf, np.nan, "long"])
def test_a_duration_is_above_zero(duration):
    with pytest.raises(fracsim.ImpulseError, match="impulse duration must be finite and above 0 s, or None"):
        fracsim.Impulse((0, 0, 0), (0, 0, 1), 1.0, duration)


def test_a_force_is_an_impulse_of_that_peak_force():
    grip = fracsim.Impulse.from_force((1, 2, 3), (0, 0, 2), 250.0)
    assert grip.peak_force == pytest.approx(250.0)
    assert grip.magnitude == 250.0 * LOAD_DURATION
    assert grip.point.tolist() == [1, 2, 3]
    assert fracsim.Impulse((0, 0, 0), (0, 0, 1), 1.0).peak_force is None


def test_a_stronger_impulse_lasts_as_long():
    impulse = fracsim.Impulse((0, 0, 0), (0, 0, 1), 2.0, 1e-3).times(3.0)
    assert (impulse.magnitude, impulse.duration) == (6.0, 1e-3)
    assert impulse.peak_force == pytest.approx(np.pi / 2 * 6.0 / 1e-3)
