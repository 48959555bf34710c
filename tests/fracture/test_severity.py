"""Severities: what impulses of known or unknown duration are to assets whose simulator counts forces, or impulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from force_assets import counting_forces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fracsim
from fracsim.common.contact import LOAD_DURATION, ContactLaw, effective_mass
from fracsim.simulators.diffusion import GAUGE


@pytest.fixture(scope="module")
def vase():
    return counting_forces("vase", 0.3, 2000.0)


def severity(asset, *impulses):
    return asset.fracture(impulses, skip_weak=False).severity


def along_normal(asset, vertex, magnitude, duration=None):
    inward = asset.center_of_mass - asset.vertices[vertex]
    return fracsim.Impulse(asset.vertices[vertex], inward, magnitude, duration)


def test_a_known_duration_is_a_known_force(vase):
    impulse = along_normal(vase, 7, 2.0, 1e-3)
    force = np.pi / 2 * 2.0 / 1e-3
    assert severity(vase, impulse) == pytest.approx(force / (vase.material.tensile_strength * 0.3**2))
    assert severity(vase, impulse, impulse) == pytest.approx(2.0 * severity(vase, impulse))


def test_a_force_counts_as_itself_whatever_the_size_of_the_body(vase):
    for scale in (0.1, 1.0, 10.0):
        asset = vase.scaled(scale)
        grip = fracsim.Impulse.from_force(asset.vertices[3], (0, 0, 1), 500.0)
        assert severity(asset, grip) * asset.material.tensile_strength * asset.size**2 == pytest.approx(500.0)


def test_an_unknown_duration_is_the_contact_law_s_with_the_bodys_own_mass_and_compliance(vase):
    impulse = along_normal(vase, 400, 1.5)
    arm = (vase.vertices[400] - vase.center_of_mass)[None]
    mass = effective_mass(vase.mass, vase.inertia, arm, impulse.direction[None])[0]
    material = vase.material
    compliance = vase.arrays.compliance[400] / (material.youngs_modulus * vase.size)
    law = ContactLaw.of(vase.size, material.youngs_modulus, material.poisson_ratio, compliance=compliance)
    force = float(law.peak_force(1.5**2 / (2.0 * mass)))
    assert severity(vase, impulse) == pytest.approx(force / (material.tensile_strength * vase.size**2))


def test_compliance_is_read_between_vertices_and_scales_with_size_and_stiffness(vase):
    middle = vase.vertices[vase.faces[10]].mean(axis=0)
    shape = vase.arrays.compliance[vase.faces[10]].mean()
    [got] = vase.compliance_at(middle[None])
    assert got == pytest.approx(shape / (vase.material.youngs_modulus * vase.size), rel=1e-6)
    stiffer = vase.scaled(2.0).with_material(replace(vase.material, youngs_modulus=5 * vase.material.youngs_modulus))
    assert stiffer.compliance_at(2.0 * middle[None])[0] == pytest.approx(got / 10.0)
    assert (fracsim.load("vase").compliance_at(middle[None]) == 0.0).all()


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(1e-4, 10.0), st.integers(0, 1499), st.integers(0, 1000))
def test_an_impulse_made_for_a_severity_has_it(vase, wanted, vertex, seed):
    direction = np.random.default_rng(seed).standard_normal(3)
    assert severity(vase, vase.impulse_of(wanted, vase.vertices[vertex], direction)) == pytest.approx(wanted)


def test_a_longer_contact_is_less_severe_to_both_kinds(vase):
    for asset in (vase, fracsim.load("vase")):
        impulse = asset.sample_impulses(1, 0)[0]
        values = [severity(asset, replace(impulse, duration=1e-3 * 2**k)) for k in range(6)]
        assert (np.diff(values) < 0.0).tolist()[1:] == [True] * 4
        assert values[0] >= values[1]


def test_an_impulse_counts_whole_to_a_simulator_of_impulses_unless_it_lasts(shipped):
    impulse = shipped.sample_impulses(1, 0)[0]
    unit = shipped.mass * GAUGE * shipped.material.critical_velocity
    whole = severity(shipped, impulse)
    assert whole == pytest.approx(impulse.magnitude / unit)
    assert severity(shipped, replace(impulse, duration=1e-3)) == whole
    soft = replace(impulse, duration=10e-3)
    assert severity(shipped, soft) == pytest.approx(soft.peak_force * LOAD_DURATION / unit)


def test_a_lasting_force_counts_as_what_it_gives_in_a_millisecond_to_a_simulator_of_impulses(shipped):
    unit = shipped.mass * GAUGE * shipped.material.critical_velocity
    grip = fracsim.Impulse.from_force(shipped.vertices[0], (0, 0, 1), 3000.0)
    assert severity(shipped, grip) == pytest.approx(3000.0 * LOAD_DURATION / unit)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 8), st.floats(0.01, 100.0), st.integers(0, 10_000))
def test_what_bounds_rule_out_never_reaches_the_least_severity(vase, count, speed, seed):
    rng = np.random.default_rng(seed)
    least = vase.baked_from.min_severity
    shares = rng.dirichlet(np.ones(count)) * 0.999 * vase.bearable_impulse
    vertices = rng.integers(0, vase.vertex_count, count)
    unknown = [along_normal(vase, vertex, share) for vertex, share in zip(vertices, shares, strict=True)]
    assert severity(vase, *unknown) < least
    stiff = ContactLaw.of(vase.size, vase.material.youngs_modulus, vase.material.poisson_ratio)
    hardest = stiff.peak_force(0.5 * shares * speed)  # of any partner that closes at this speed
    together = [replace(one, duration=np.pi / 2 * one.magnitude / f) for one, f in zip(unknown, hardest, strict=True)]
    assert severity(vase, *together) < least
    assert not vase.may_break(together)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2987), st.integers(0, 10_000))
def test_a_single_impulse_below_the_local_breaking_impulse_is_ruled_out(vase, face, seed):
    rng = np.random.default_rng(seed)
    corners = vase.faces[face % len(vase.faces)]
    weights = rng.dirichlet(np.ones(3))
    bound = vase.breaking_impulse[corners[np.argmax(weights)]]
    impulse = fracsim.Impulse(weights @ vase.vertices[corners], rng.standard_normal(3), 0.999 * bound)
    assert not vase.may_break(impulse)


def test_bounds_are_no_idle_ones(vase):
    impulses = [along_normal(vase, vertex, 1.0) for vertex in range(0, 1500, 100)]
    for impulse, bound in zip(impulses, vase.breaking_impulse[::100], strict=True):
        assert vase.may_break(impulse.times(3.0 * bound))
    grip = fracsim.Impulse.from_force(vase.vertices[0], (0, 0, 1), 1.001 * vase.bearable_force)
    assert vase.may_break(grip)
    assert not vase.may_break(fracsim.Impulse.from_force(vase.vertices[0], (0, 0, 1), 0.999 * vase.bearable_force))


def test_sampled_impulses_are_of_the_range_of_severities(vase):
    typical = vase.baked_from.typical_severity
    values = np.array([severity(vase, impulse) for impulse in vase.sample_impulses(60, 1)]) / typical
    assert 0.29 < values.min() < 0.6
    assert 3.0 < values.max() < 5.1


def test_a_piece_feels_a_force_as_the_whole_does_and_an_impulse_by_its_own_mass(vase):
    fracture = next(f for i in vase.sample_impulses(40, 2) if len((f := vase.fracture(i)).pieces) > 1)
    piece = vase.breakable_piece(min(fracture.pieces, key=lambda piece: piece.mass))
    grip = fracsim.Impulse.from_force(piece.center_of_mass, (0, 0, 1), 500.0)
    assert severity(piece, grip) == pytest.approx(severity(vase, grip))
    blow = fracsim.Impulse(piece.center_of_mass, (0, 0, 1), 1.0)
    assert severity(piece, blow) > severity(vase, blow)
    assert piece.bearable_force == vase.bearable_force


def test_the_file_keeps_the_kind_the_gauge_and_the_compliance(vase, tmp_path):
    vase.save(tmp_path / "vase.frac")
    again = fracsim.load(tmp_path / "vase.frac")
    assert again.severity_kind == "force"
    assert again.baked_from == vase.baked_from
    assert again.material == vase.material
    np.testing.assert_array_equal(again.arrays.compliance, vase.arrays.compliance)
    other = replace(vase, baked_from=replace(vase.baked_from, severity_kind="impulse", gauge=0.3))
    other.save(tmp_path / "other.frac")
    assert fracsim.load(tmp_path / "other.frac").baked_from.gauge == 0.3


def test_files_without_these_are_of_the_modal_simulator_and_of_a_preset(shipped):
    assert (shipped.severity_kind, shipped.baked_from.gauge) == ("impulse", GAUGE)
    assert shipped.arrays.compliance is None
    assert shipped.material.youngs_modulus == 70e9


@pytest.mark.parametrize("wrong", [np.ones(3), -np.ones(1500)])
def test_a_compliance_that_cannot_be_is_refused(vase, tmp_path, wrong):
    replace(vase, arrays=replace(vase.arrays, compliance=wrong)).save(tmp_path / "bent.frac")
    with pytest.raises(fracsim.AssetError, match=r"bent\.frac: the compliance does not fit"):
        fracsim.load(tmp_path / "bent.frac")
