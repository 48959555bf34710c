"""Modes, atoms and the impact field on shapes whose weak spot everybody can see."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from fracsim.common.errors import BakeError
from fracsim.simulators.diffusion import impact_field
from fracsim.simulators.fracture_modes import atoms_from_modes, fracture_modes
from fracsim.solids.cut import cut_lattice
from fracsim.solids.solid import relabel, shared_faces
from fracsim.solids.spectrum import laplacian, neighbours
from fracsim.solids.surface import read_surface


def bar_bell():
    """Two cubes of 1 joined by a bar of 0.3 x 0.3 x 0.6."""
    parts = [trimesh.creation.box((1, 1, 1)) for _ in range(2)] + [trimesh.creation.box((1.0, 0.3, 0.3))]
    parts[0].apply_translation((-0.8, 0, 0))
    parts[1].apply_translation((0.8, 0, 0))
    return trimesh.boolean.union(parts, engine="manifold")


@pytest.fixture(scope="module")
def bell():
    surface = read_surface(bar_bell())
    solid = cut_lattice(surface, 1500, np.random.default_rng(0))
    return surface, solid, fracture_modes(solid, 3)


def test_the_first_mode_of_two_cubes_on_a_bar_cuts_the_bar(bell):
    surface, solid, modes = bell
    first = modes.values[0] > modes.values[0].mean()
    joined = relabel(solid, first.astype(np.int64))
    _, _, vectors = shared_faces(joined.triangles, joined.sides, joined.points)
    bar = (0.3 / surface.scale) ** 2
    assert np.linalg.norm(vectors[0]) == pytest.approx(bar, rel=0.1)
    assert joined.volumes.min() / joined.volumes.sum() > 0.4


def dumbbell():
    """Two balls of radius 1 on a waisted rod whose neck has radius 0.3."""
    profile = [[0.0, -2.2]]
    angle = np.linspace(-np.pi / 2, 0, 8)[1:]
    profile += [[np.cos(a), -1.2 + np.sin(a)] for a in angle]
    height = np.linspace(-1.0, 1.0, 17)
    profile += [[0.3 + 0.4 * z**2 + 0.2 * z**4, z] for z in height]
    profile += [[np.cos(a), 1.2 + np.sin(a)] for a in np.linspace(0, np.pi / 2, 8)[:-1]]
    profile += [[0.0, 2.2]]
    return trimesh.creation.revolve(np.array(profile), sections=32)


def first_cut(mesh, cells):
    """The area of the first mode's cut, projected on its mean normal, in the mesh's units, and the smaller share."""
    surface = read_surface(mesh)
    solid = cut_lattice(surface, cells, np.random.default_rng(1))
    mode = fracture_modes(solid, 1).values[0]
    joined = relabel(solid, (mode > mode.mean()).astype(np.int64))
    pairs, _, vectors = shared_faces(joined.triangles, joined.sides, joined.points)
    assert len(pairs) == 1
    return np.linalg.norm(vectors[0]) * surface.scale**2, joined.volumes.min() / joined.volumes.sum(), vectors[0]


def test_a_dumbbell_parts_at_its_neck():
    # A waist is found no better than the cells are small; fewer would not do.
    area, share, normal = first_cut(dumbbell(), 8000)
    neck = 16 * np.sin(np.pi / 16) * 0.3**2  # of a prism of 32 sides
    assert area == pytest.approx(neck, rel=0.1)
    assert share > 0.4
    assert abs(normal[2]) / np.linalg.norm(normal) > 0.95


def test_a_box_parts_in_halves_across_its_length():
    area, share, normal = first_cut(trimesh.creation.box((1.0, 0.5, 0.4)), 1500)
    assert area == pytest.approx(0.5 * 0.4, rel=0.1)
    assert share > 0.4
    assert abs(normal[0]) / np.linalg.norm(normal) > 0.9


def test_the_two_solvers_agree_and_known_modes_are_gone_on_from(bell):
    _, solid, modes = bell
    exact = fracture_modes(solid, 3, solver="interior-point")
    for quick, slow in zip(modes.objectives, exact.objectives, strict=True):
        assert quick[-1] == pytest.approx(slow[-1], rel=0.01)
    third = fracture_modes(solid, 1, known=modes.values[:2])
    np.testing.assert_allclose(np.abs(third.values[0]), np.abs(modes.values[2]), atol=1e-6)


def test_a_start_among_the_modes_found_is_replaced(bell):
    _, solid, _ = bell
    # The first eigenvectors are all taken, so the next mode has to start from elsewhere.
    pairs, _, conductance = neighbours(solid)
    share = solid.volumes / solid.volumes.sum()
    root = 1 / np.sqrt(share)
    graph = laplacian(pairs, conductance, len(share)).toarray()
    _, vectors = np.linalg.eigh(root[:, None] * graph * root)
    taken = (root[:, None] * vectors[:, 1:4]).T
    more = fracture_modes(solid, 1, known=taken[[1, 2, 0]])
    assert more.restarts == 0  # the fourth eigenvector is free
    again = fracture_modes(solid, 1, known=(root[:, None] * vectors[:, 2:5]).T)
    assert again.restarts == 1  # the fourth is taken
    np.testing.assert_allclose(again.values * share @ (root[:, None] * vectors[:, 2:5]), 0, atol=1e-6)


def test_an_unknown_solver_is_refused(bell):
    with pytest.raises(BakeError, match="unknown solver 'magic'"):
        fracture_modes(bell[1], 1, solver="magic")


def test_objectives_never_increase_and_modes_are_orthonormal(bell):
    _, solid, modes = bell
    for energies in modes.objectives:
        assert all(b <= a for a, b in itertools.pairwise(energies))
    mass = solid.volumes / solid.volumes.sum()
    np.testing.assert_allclose(modes.values * mass @ modes.values.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(modes.values @ mass, 0, atol=1e-6)


def test_the_impact_field_carries_exactly_the_momentum_and_is_largest_where_it_hits(bell):
    surface, solid, modes = bell
    label = atoms_from_modes(solid, modes)
    joined = relabel(solid, label)
    rows = impact_field(solid, label, surface.vertices)
    share = joined.volumes / joined.volumes.sum()
    np.testing.assert_allclose(rows @ share, 1.0, atol=1e-10)
    assert (rows >= 0).all()
    left = surface.vertices[:, 0] < 0
    right_atoms = joined.centroids[:, 0] > 0.2
    assert rows[left][:, right_atoms].mean() < rows[~left][:, right_atoms].mean()


def test_neighbours_conduct_in_proportion_to_what_they_share(bell):
    _, solid, _ = bell
    pairs, areas, conductance = neighbours(solid)
    distance = np.linalg.norm(np.diff(solid.centroids[pairs], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(conductance * distance, areas)
