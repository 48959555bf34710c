"""The contact law: the force balances the energy, softer things press less, and known limits are met."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fracsim.common.contact import (
    ContactLaw,
    effective_mass,
    hertz_stiffness,
    pair_modulus,
    pulse_duration,
    pulse_force,
    speed_number,
)
from fracsim.common.material import CONTACT_PRESETS

energies = st.floats(1e-9, 1e6)  # J
stiffnesses = st.floats(1e2, 1e13)  # N/m^1.5
compliances = st.floats(1e-12, 1e-1)  # m/N


@given(energies, stiffnesses, compliances)
def test_the_force_balances_the_energy(energy, stiffness, compliance):
    law = ContactLaw(stiffness, compliance)
    force = float(law.peak_force(energy))
    balance = 0.4 * force ** (5 / 3) * stiffness ** (-2 / 3) + 0.5 * compliance * force**2
    assert balance == pytest.approx(energy, rel=1e-9)
    assert float(law.energy(force)) == pytest.approx(energy, rel=1e-9)


@given(energies, stiffnesses, compliances)
def test_the_limits_are_hertz_and_a_spring(energy, stiffness, compliance):
    hertz = stiffness**0.4 * (2.5 * energy) ** 0.6
    assert float(ContactLaw(stiffness).peak_force(energy)) == pytest.approx(hertz, rel=1e-12)
    spring = (2.0 * energy / compliance) ** 0.5
    assert float(ContactLaw(np.inf, compliance).peak_force(energy)) == pytest.approx(spring, rel=1e-12)
    assert float(ContactLaw(stiffness, compliance).peak_force(energy)) <= min(hertz, spring) * (1.0 + 1e-12)


@given(st.lists(energies, min_size=2, max_size=20), stiffnesses, compliances, st.floats(1e-3, 1e6))
def test_more_energy_is_more_force_through_the_bottom_of_a_layer_too(energies, stiffness, compliance, bottom):
    work = np.sort(energies)
    for law in (ContactLaw(stiffness, compliance), ContactLaw(stiffness, compliance, bottom, 10.0 * stiffness)):
        force = law.peak_force(work)
        assert (np.diff(force)[np.diff(work) > 1e-9 * work[1:]] > 0.0).all()
        np.testing.assert_allclose(law.energy(force), work, rtol=1e-9)


@given(energies, st.floats(1e5, 1e12), st.floats(1.0, 1e4), compliances, st.floats(1.0, 100.0))
def test_a_softer_partner_never_presses_more(energy, modulus, softer, compliance, more):
    hard = ContactLaw.of(0.1, 70e9, 0.2, modulus, 0.3, compliance=compliance).peak_force(energy)
    soft = ContactLaw.of(0.1, 70e9, 0.2, modulus / softer, 0.3, compliance=compliance * more).peak_force(energy)
    assert soft <= hard * (1.0 + 1e-12)


@given(energies, compliances)
def test_no_partner_presses_more_than_a_hard_one(energy, compliance):
    hard = ContactLaw.of(0.1, 70e9, 0.2, compliance=compliance).peak_force(energy)
    for other in CONTACT_PRESETS.values():
        law = ContactLaw.of(0.1, 70e9, 0.2, other.youngs_modulus, other.poisson_ratio, other.travel, compliance)
        assert law.peak_force(energy) <= hard * (1.0 + 1e-9)


def test_nothing_makes_no_force_and_what_does_not_give_way_makes_any():
    assert ContactLaw(1e9, 1e-6).peak_force(0.0) == 0.0
    assert ContactLaw(np.inf).peak_force([0.0, 1.0]).tolist() == [0.0, np.inf]


def test_compliances_of_many_places_are_taken_at_once():
    law = ContactLaw(1e9, np.array([0.0, 1e-7, 1e-5]))
    alone = [float(ContactLaw(1e9, c).peak_force(2.0)) for c in (0.0, 1e-7, 1e-5)]
    np.testing.assert_allclose(law.peak_force(2.0), alone, rtol=1e-12)


def test_a_layer_bottoms_out_where_its_own_indentation_reaches_its_travel():
    law = ContactLaw.of(0.1, 70e9, 0.2, 0.5e6, 0.0, 0.016)
    indentation = (law.bottom_force / law.stiffness) ** (2 / 3)
    assert indentation == pytest.approx(0.016, rel=1e-4)  # the ceramic takes a hundred-thousandth of it
    assert law.bottom_stiffness == hertz_stiffness(pair_modulus(70e9, 0.2), 0.1)


def test_moduli_in_series():
    assert pair_modulus(70e9, 0.2) == pytest.approx(70e9 / 0.96)
    assert pair_modulus(2.0, 0.0, 2.0, 0.0) == 1.0
    assert pair_modulus(np.inf, 0.2) == np.inf
    assert hertz_stiffness(3.0, 0.2) == pytest.approx(4.0 * 0.1)


@given(st.floats(1e-6, 1e3), st.floats(1e-3, 1e6))
def test_a_pulse_of_a_force_has_that_force(impulse, force):
    assert float(pulse_force(impulse, pulse_duration(impulse, force))) == pytest.approx(force, rel=1e-12)


def test_a_rod_hit_at_its_end_weighs_a_quarter():
    mass, length = 3.0, 2.0
    inertia = np.diag([mass * length**2 / 12.0, mass * length**2 / 12.0, 1e-9])
    arms = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    directions = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(effective_mass(mass, inertia, arms, directions), [mass / 4.0, mass])


def test_the_speed_number_is_half_the_time_that_a_wave_takes_there_and_back_over_the_duration():
    assert float(speed_number(0.1 / 5000.0, 0.1, 5000.0)) == pytest.approx(np.pi)
