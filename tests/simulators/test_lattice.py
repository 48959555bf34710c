"""The lattice of rigid cells: as stiff as elasticity says, in balance, and the same whatever it is asked first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.simulators.base import Impacts
from fracsim.simulators.lattice import Lattice, Stiffness
from fracsim.simulators.lattice_build import lattice_of
from fracsim.simulators.lattice_faces import cell_faces
from fracsim.simulators.lattice_options import LatticeOptions, material_options
from fracsim.simulators.lattice_stress import principal
from fracsim.solids.surface import read_surface, refine
from fracsim.solids.voronoi import voronoi_solid

WIDTH = 0.2  # of the bar, whose length is 1


@pytest.fixture(scope="module")
def bar():
    """A bar of 1 x 0.2 x 0.2 along x."""
    return refine(read_surface(trimesh.creation.box((1.0, WIDTH, WIDTH))))


@pytest.fixture(scope="module")
def lattice(bar):
    cells = voronoi_solid(bar, 150, np.random.default_rng(0))
    return Lattice(cells, cell_faces(cells), 0.05)


def stiffness_matrix(lattice):
    """K, dense: what the system is without the mass term."""
    n = 6 * len(lattice)
    system = np.linalg.inv(lattice.intact.solve(np.eye(n)))
    return system - lattice.speed_number**2 * lattice.mass_matrix.toarray()


def pull(lattice, axis=0):
    """Forces that pull the two ends of the bar apart along an axis, of sum 1 each, over the end cells' volumes."""
    forces = np.zeros((len(lattice), 6))
    for end in (-1.0, 1.0):
        at = end * lattice.centroids[:, 0] > 0.42
        forces[at, axis] = end * lattice.cells.volumes[at] / lattice.cells.volumes[at].sum()
    return forces.ravel()


def test_a_body_that_moves_as_one_is_not_strained(lattice):
    motion = lattice.rigid_motions @ np.array([0.3, -1.0, 0.2, 0.5, 0.1, -0.7])
    assert np.abs(lattice.jumps(motion)).max() < 1e-12


def test_the_mass_matrix_is_that_of_the_bar(lattice):
    rigid = lattice.rigid_mass
    np.testing.assert_allclose(np.diag(rigid)[:3], WIDTH**2, rtol=1e-9)
    inertia = WIDTH**2 * np.array([2 * WIDTH**2, 1 + WIDTH**2, 1 + WIDTH**2]) / 12
    np.testing.assert_allclose(np.diag(rigid)[3:], inertia, rtol=1e-6)


def test_a_pulled_bar_carries_its_force_over_its_section_and_gives_way_as_hooke_says(lattice):
    response = lattice.intact.solve(pull(lattice))
    tension, cosine, pressure = lattice.tension(lattice.jumps(response), lattice.whole)
    middle = np.abs(lattice.faces.centroids[:, 0]) < 0.25
    across = middle & (np.abs(lattice.faces.normals[:, 0]) > 0.9)
    np.testing.assert_allclose(np.median((tension / cosine)[across]) * WIDTH**2, 1.0, rtol=0.08)
    assert not pressure[across].any()
    length = 2 * np.abs(lattice.centroids[np.abs(lattice.centroids[:, 0]) > 0.42, 0]).mean()
    _, compliance = lattice.answer(pull(lattice), response)
    np.testing.assert_allclose(compliance, length / WIDTH**2, rtol=0.1)


def test_a_bar_swings_at_the_frequency_of_a_free_beam(lattice):
    """Euler and Bernoulli give ω = 22.37 r / L² with r = b/√12; shear and turning take 10 % off a bar so short."""
    stiffness, mass = stiffness_matrix(lattice), lattice.mass_matrix.toarray()
    from scipy.linalg import eigh

    frequency = np.sqrt(eigh(stiffness, mass, eigvals_only=True, subset_by_index=[6, 6])[0])
    np.testing.assert_allclose(frequency, 0.90 * 22.373 * WIDTH / np.sqrt(12), rtol=0.06)


def test_the_force_of_a_contact_is_spread_without_a_change_of_its_resultant(lattice, bar):
    rng = np.random.default_rng(0)
    for vertex in rng.integers(len(bar.vertices), size=10).tolist():
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        point = bar.vertices[vertex]
        cell = int(lattice.cells.vertex_cells(len(bar.vertices))[vertex])
        resultant = lattice.rigid_motions.T @ lattice.force(cell, point, direction)
        np.testing.assert_allclose(resultant, np.concatenate([direction, np.cross(point, direction)]), atol=1e-12)


def test_the_mass_that_a_force_feels_is_that_of_the_rigid_body(lattice, bar):
    end = int(np.argmax(bar.vertices[:, 0] - np.abs(bar.vertices[:, 1:]).sum(axis=1)))
    cell = int(lattice.cells.vertex_cells(len(bar.vertices))[end])
    point = bar.vertices[end]
    force = lattice.force(cell, point, np.array([0.0, 0.0, 1.0]))
    turn = np.cross(point, [0.0, 0.0, 1.0])
    inertia = np.diag(lattice.rigid_mass)[3:]
    expected = 1.0 / (1.0 / WIDTH**2 + (turn**2 / inertia).sum())
    np.testing.assert_allclose(lattice.effective_mass(force), expected, rtol=1e-3)
    still = replace(lattice, speed_number=1e-3)
    moved, compliance = still.answer(force, still.intact.solve(force))
    np.testing.assert_allclose(1.0 / (1e-12 * moved), expected, rtol=1e-3)
    assert compliance > 0.0


@given(st.integers(0, 10**6))
@settings(deadline=None, max_examples=10)
def test_answers_are_mutual_and_in_proportion(lattice, seed):
    rng = np.random.default_rng(seed)
    first, second = rng.standard_normal((2, 6 * len(lattice)))
    left = rng.uniform(0.01, 1.0, len(lattice.faces))
    factor = lattice.factorise(Stiffness(left, rng.random(len(left)) < 0.3))
    a, b = factor.solve(np.stack([first, second], axis=1)).T
    np.testing.assert_allclose(second @ a, first @ b, rtol=1e-8)  # Betti
    np.testing.assert_allclose(factor.solve(2.5 * first), 2.5 * a, rtol=1e-9)


def test_less_stiffness_never_gives_less_way(lattice):
    rng = np.random.default_rng(1)
    forces = pull(lattice)
    whole = lattice.answer(forces, lattice.intact.solve(forces))[1]
    weaker = Stiffness(rng.uniform(0.1, 1.0, len(lattice.faces)), np.zeros(len(lattice.faces), dtype=bool))
    assert lattice.answer(forces, lattice.factorise(weaker).solve(forces))[1] > whole
    shut = replace(weaker, closed=np.ones(len(lattice.faces), dtype=bool))
    assert lattice.answer(forces, lattice.factorise(shut).solve(forces))[1] > whole


def test_a_cut_bar_parts_and_a_pressed_cut_carries_on(lattice):
    through = (lattice.centroids[lattice.faces.pairs, 0] > 0.0).sum(axis=1) == 1
    left = np.where(through, 1e-6, 1.0)
    forces = pull(lattice)
    for closed, largest in ((False, np.inf), (True, 2.0)):
        cut = Stiffness(left, np.full(len(left), closed))
        way = lattice.answer(forces, lattice.factorise(cut).solve(forces))[1]
        whole = lattice.answer(forces, lattice.intact.solve(forces))[1]
        assert whole < way <= largest * whole if closed else way > 10 * whole


def test_impacts_of_several_contacts_are_the_sum_of_their_contacts(lattice, bar):
    rng = np.random.default_rng(2)
    faces = rng.integers(len(bar.faces), size=(1, 3))
    bary = rng.dirichlet(np.ones(3), size=(1, 3))
    directions = rng.standard_normal((1, 3, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    impact = Impacts(faces, bary, directions, np.array([[1.0, 0.5, 0.0]]))
    points = np.einsum("nkc,nkci->nki", bary, bar.vertices[bar.faces[faces]])
    alone = [
        lattice.force(lattice.cell_at(int(faces[0, k]), points[0, k]), points[0, k], directions[0, k]) for k in (0, 1)
    ]
    np.testing.assert_allclose(lattice.forces(impact, points)[0], alone[0] + 0.5 * alone[1], atol=1e-12)


@given(st.integers(0, 10**6))
@settings(deadline=None, max_examples=20)
def test_principal_stresses_are_lapacks(seed):
    rng = np.random.default_rng(seed)
    stress = rng.standard_normal((30, 3, 3)) * 10.0 ** rng.uniform(-3, 3, (30, 1, 1))
    stress = stress + np.swapaxes(stress, 1, 2)
    index = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
    value, direction = principal(*(stress[:, i, j] for i, j in index))
    size = np.abs(stress).max(axis=(1, 2))
    np.testing.assert_allclose(value / size, np.linalg.eigvalsh(stress)[:, 2] / size, atol=1e-7)
    residual = np.einsum("nij,nj->ni", stress, direction) - value[:, None] * direction
    assert (np.linalg.norm(residual, axis=1) < 1e-4 * size).all()


def test_a_harder_faster_material_has_a_larger_speed_number_only_by_its_contact(bar):
    cells = voronoi_solid(bar, 60, np.random.default_rng(3))
    slow, fast = (lattice_of(bar, cells, LatticeOptions(approach_speed=v)).speed_number for v in (1e-4, 1e-2))
    assert slow < fast < 100 ** (1 / 5) * 1.3 * slow  # Hertz: t falls with the fifth root of the speed
    assert lattice_of(bar, cells, LatticeOptions(speed_number=0.3)).speed_number == 0.3


def test_options_follow_from_material_and_size():
    from fracsim.common.material import PRESETS

    glass = PRESETS["glass"]
    options = material_options(glass, 0.2)
    assert options["brittleness"] == pytest.approx(
        glass.youngs_modulus * glass.fracture_energy / glass.tensile_strength**2 / 0.2
    )
    assert options["strain"] == pytest.approx(glass.tensile_strength / glass.youngs_modulus)
    assert 2.0 * material_options(glass, 0.4)["brittleness"] == pytest.approx(options["brittleness"])
