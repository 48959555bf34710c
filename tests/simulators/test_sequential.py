"""The reference simulator: textbook bodies break where and when they should, and its bookkeeping is exact."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.common.errors import BakeError
from fracsim.simulators import simulator_class
from fracsim.simulators.base import Impacts, interfaces_between
from fracsim.simulators.lattice import Lattice, Stiffness
from fracsim.simulators.lattice_faces import cell_faces
from fracsim.simulators.lattice_options import LatticeOptions
from fracsim.simulators.sequential import SequentialSimulator
from fracsim.simulators.sequential_cracks import OPEN, PRESSED, Cracks, IntactBody, crack_ramp
from fracsim.solids.surface import read_surface
from fracsim.solids.voronoi import voronoi_solid

ROD = Path(__file__).parent.parent.parent / "meshes" / "rod.obj"
SIDE = 0.1
GLASS = 1e-4  # a brittleness so small that strength alone decides where a crack begins
TOUGH = 0.5  # one so large that toughness decides


@cache
def bar(cells=100, speed_number=0.01):
    solid = voronoi_solid(read_surface(trimesh.creation.box((1.0, SIDE, SIDE))), cells, np.random.default_rng(0))
    return IntactBody(Lattice(solid, cell_faces(solid), speed_number))


@cache
def block():
    solid = voronoi_solid(read_surface(trimesh.creation.box((1.0, 0.8, 0.6))), 50, np.random.default_rng(1))
    return IntactBody(Lattice(solid, cell_faces(solid), 0.7))


@cache
def rod():
    return SequentialSimulator.build(read_surface(ROD), LatticeOptions(cells=150), np.random.default_rng(0))


def pulled_apart(lattice):
    """Forces of a total of 1 on the outer eighths of a bar along x, by volume."""
    x, volumes = lattice.centroids[:, 0], lattice.cells.volumes
    forces = np.zeros((len(lattice), 6))
    for side in (-1.0, 1.0):
        grip = np.where(side * x > 0.375, volumes, 0.0)
        forces[:, 0] += side * grip / grip.sum()
        middle = (grip / grip.sum()) @ lattice.centroids
        turn = -side * np.cross(middle, [1.0, 0.0, 0.0])
        forces[:, 3:] += (grip / grip.sum())[:, None] * turn
    return forces.ravel()


def struck(simulator, points, directions):
    """One impact of contacts of severity 1 at the vertices nearest to points."""
    surface = simulator.surface
    vertices = [int(np.argmin(((surface.vertices - point) ** 2).sum(axis=1))) for point in points]
    faces = np.array([[np.flatnonzero((surface.faces == vertex).any(axis=1))[0] for vertex in vertices]])
    corners = (surface.faces[faces] == np.array(vertices)[None, :, None]).astype(float)
    directions = np.asarray(directions, dtype=float)
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    return Impacts(faces, corners, directions[None], np.ones(faces.shape))


def shares(simulator, labels):
    volume = np.bincount(labels, simulator.cells.volumes)
    return np.sort(volume / volume.sum())[::-1]


def middle_and_axis(simulator):
    """The axis the rod lies along, and a point on its outside half way, square to it."""
    axis = int(np.argmax(np.ptp(simulator.surface.vertices, axis=0)))
    across = np.eye(3)[(axis + 1) % 3]
    return axis, across


# Textbook bodies


def test_a_bar_in_tension_breaks_in_two_at_its_strength_times_its_area():
    body = bar()
    path = crack_ramp(body, pulled_apart(body.lattice), GLASS, smallest=0.01)
    assert path.separation == pytest.approx(SIDE**2, rel=0.1)
    assert path.first == path.separation  # what begins goes through
    assert path.labels.max() == 1
    assert not path.at_front[0]
    assert path.at_front[1:].any()
    assert np.all(np.diff(path.factors) >= 0.0)


def test_toughness_lets_small_cells_bear_more_than_their_strength():
    body = bar()
    forces = pulled_apart(body.lattice)
    assert crack_ramp(body, forces, TOUGH).first > 2.0 * crack_ramp(body, forces, GLASS).first


def test_a_crack_that_is_there_makes_a_bar_weaker_by_the_root_of_its_toughness():
    body = bar()
    faces = body.lattice.faces
    forces = pulled_apart(body.lattice)
    notch = (np.sign(body.lattice.centroids[faces.pairs, 0]).prod(axis=1) < 0) & (faces.centroids[:, 1] < -0.01)
    brittle, four = (crack_ramp(body, forces, b, notch, smallest=0.01) for b in (GLASS, 4.0 * GLASS))
    assert brittle.at_front[0]
    assert brittle.separation < 0.5 * SIDE**2
    assert four.first == pytest.approx(2.0 * brittle.first)


def test_a_ramp_ends_at_its_largest_load_and_at_its_number_of_faces():
    body = bar()
    forces = pulled_apart(body.lattice)
    below = crack_ramp(body, forces, GLASS, largest=0.5 * SIDE**2)
    assert (below.first, below.separation, len(below.faces)) == (np.inf, np.inf, 0)
    assert not below.labels.any()
    assert len(crack_ramp(body, forces, GLASS, breaks=3).faces) == 3


def test_a_free_rod_hit_in_its_middle_snaps_in_two_about_the_middle():
    simulator = rod()
    axis, across = middle_and_axis(simulator)
    impact = struck(simulator, [0.04 * across], [-across])
    threshold = simulator.thresholds(impact)
    large = shares(simulator, simulator.fracture(impact.times(1.1 * threshold)).labels[0])
    assert len(large) == 2
    assert large[1] > 0.4
    place = simulator.lattice.faces.centroids[simulator.breaks(impact, 0, 1.001 * float(threshold[0])).faces, axis]
    assert np.abs(place).max() < 0.15
    for factor in (2.0, 4.0):
        assert len(shares(simulator, simulator.fracture(impact.times(factor * threshold)).labels[0])) >= 2


# What holds of every impact


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 1000), contacts=st.integers(1, 3))
def test_more_severity_breaks_what_less_breaks_and_nothing_breaks_below_the_threshold(seed, contacts):
    simulator, rng = rod(), np.random.default_rng(seed)
    points = simulator.surface.vertices[rng.choice(len(simulator.surface.vertices), contacts)]
    impact = struck(simulator, points, -points + 0.01 * rng.standard_normal((contacts, 3)))
    first, threshold = simulator.first_crack(impact), simulator.thresholds(impact)
    assert 0.0 < first[0] <= threshold[0] * (1.0 + 1e-9)
    assert not simulator.fracture(impact.times(0.999 * first)).broken.any()
    if not np.isfinite(threshold[0]):
        return
    assert not simulator.fracture(impact.times(0.999 * threshold)).labels.any()
    before = np.zeros(len(simulator.interfaces), dtype=bool)
    for factor in (1.0, 1.5, 3.0):
        response = simulator.fracture(impact.times(factor * threshold))
        labels, broken = response.labels[0], response.broken[0]
        assert labels.max() >= 1
        assert np.bincount(labels, simulator.cells.volumes).min() >= 0.01 * simulator.cells.volumes.sum()
        pairs = simulator.interfaces.pairs
        assert broken[labels[pairs[:, 0]] != labels[pairs[:, 1]]].any()
        assert not (before & ~broken).any()
        before = broken


def test_contacts_that_share_a_force_and_none_at_all():
    simulator = rod()
    axis, across = middle_and_axis(simulator)
    along = np.eye(3)[axis]
    bent = struck(simulator, [0.04 * across + place * along for place in (-0.45, 0.45)], [-across, -across])
    assert simulator.fracture(bent.times(1.01 * simulator.thresholds(bent))).labels.max() >= 1
    squeezed = struck(simulator, [0.04 * across, -0.04 * across], [-across, across])
    assert simulator.first_crack(squeezed)[0] > simulator.first_crack(bent)[0]  # nothing bends
    nothing = bent.times(np.zeros(1))
    assert not simulator.fracture(nothing).labels.any()
    assert simulator.thresholds(nothing)[0] == np.inf


def test_two_runs_and_a_simulator_made_again_give_the_same_bits():
    simulator = rod()
    axis, across = middle_and_axis(simulator)
    impact = struck(simulator, [0.04 * across + 0.2 * np.eye(3)[axis]], [-across]).times(np.array([0.1]))
    arrays, numbers = simulator.state()
    cells = simulator.cells
    again = SequentialSimulator.restore(simulator.surface, cells, interfaces_between(cells), arrays, numbers)
    built = SequentialSimulator.build(simulator.surface, LatticeOptions(cells=150), np.random.default_rng(0))
    for other in (again, built):
        assert np.array_equal(other.thresholds(impact), simulator.thresholds(impact))
        assert np.array_equal(other.fracture(impact).labels, simulator.fracture(impact).labels)
        assert np.array_equal(other.compliance, simulator.compliance)


def test_what_the_class_says_of_itself():
    assert simulator_class("sequential") is SequentialSimulator
    assert SequentialSimulator.severity_kind == "force"
    compliance = rod().compliance
    assert compliance.shape == (len(rod().surface.vertices),)
    assert (compliance > 0.0).all()
    with pytest.raises(BakeError, match="brittleness"):
        LatticeOptions(brittleness=0.0)


# The bookkeeping


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 12))
def test_the_energy_released_is_that_of_the_body_with_the_face_taken_out(seed, count):
    body, rng = block(), np.random.default_rng(seed)
    lattice = body.lattice
    forces = rng.standard_normal(6 * len(lattice))
    cracks = Cracks(body, 1.0, forces)
    chosen = rng.permutation(len(lattice.faces))
    for face in chosen[:count].tolist():
        cracks.release(face, bool(rng.random() < 0.5))
    reference = lattice.factorise(cracks.stiffness).solve(forces)
    assert cracks.motions == pytest.approx(reference, rel=1e-6, abs=1e-7 * np.abs(reference).max())
    for pressed in (False, True):
        face = int(chosen[count])
        left, closed = cracks.whole.astype(float), cracks.state == PRESSED
        left[face], closed[face] = 0.0, pressed
        after = lattice.factorise(Stiffness(left, closed)).solve(forces)
        released = cracks.released(np.array([face]), cracks.jumps(), np.array([pressed]))
        assert released[0] == pytest.approx(0.5 * forces @ (after - cracks.motions), rel=1e-5)


def test_a_pressed_crack_lets_go_when_it_is_pulled():
    body = bar()
    lattice = body.lattice
    forces = pulled_apart(lattice)
    faces = lattice.faces
    across = np.flatnonzero(np.sign(lattice.centroids[faces.pairs, 0]).prod(axis=1) < 0)
    cracks = Cracks(body, GLASS, -forces)
    for face in across.tolist():
        cracks.release(face, pressed=True)
    assert (cracks.state[across] == PRESSED).all()
    shortened = float(cracks.forces @ cracks.motions)
    assert shortened == pytest.approx(float(forces @ lattice.intact.solve(forces)), rel=0.2)  # carries pressure
    cracks.push(forces)
    while cracks.open_cracks(cracks.jumps()):
        pass
    assert (cracks.state[across] == OPEN).any()
    assert float(forces @ cracks.motions) > 10.0 * shortened
