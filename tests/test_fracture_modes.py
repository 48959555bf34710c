"""Modes, atoms and the impact field on shapes whose weak spot everybody can see."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from fracsim.fracture_modes import atoms, fracture_modes, impact_field, neighbours
from fracsim.mesh import read_surface
from fracsim.solid import cut_lattice, relabel, shared_faces


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


def test_objectives_never_increase_and_modes_are_orthonormal(bell):
    _, solid, modes = bell
    for energies in modes.objectives:
        assert all(b <= a * (1 + 1e-3) for a, b in itertools.pairwise(energies))
    mass = solid.volumes / solid.volumes.sum()
    np.testing.assert_allclose(modes.values * mass @ modes.values.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(modes.values @ mass, 0, atol=1e-6)


def test_the_impact_field_carries_exactly_the_momentum_and_is_largest_where_it_hits(bell):
    surface, solid, modes = bell
    label = atoms(solid, modes)
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
