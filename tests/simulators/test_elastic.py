"""Elastic impacts: bars with known answers, balance, reciprocity, and the simulator built on them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from skfem import MeshTet

from fracsim.common.errors import BakeError, MissingExtraError
from fracsim.fracture.rule import Interfaces, effective_opening
from fracsim.simulators.base import Impacts, interfaces_between
from fracsim.simulators.diffusion import PATCH_RADIUS
from fracsim.simulators.elastic import ElasticSimulator, single_impacts
from fracsim.simulators.elastic_fem import ElasticBody, locate, mesh_edge, rigid_motions
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.solid import Solid
from fracsim.solids.surface import Surface, read_surface

THICK = 0.1  # of the bar, whose length is 1
X = np.array([1.0, 0.0, 0.0])
Z = np.array([0.0, 0.0, 1.0])
SECTIONS = (0.4, 0.6, 0.8)  # distance from the struck end; well outside the contact patch
END = np.array([-0.5, 0.0, 0.0])


def bar_mesh(turn=None):
    across = np.linspace(-THICK / 2, THICK / 2, 4)
    mesh = MeshTet.init_tensor(np.linspace(-0.5, 0.5, 40), across, across)
    return mesh if turn is None else MeshTet(turn @ mesh.p, mesh.t)


def sections(bounds, turn=None):
    """Flat interfaces across the bar: each (x, z from, z to), its second part being the one at larger x."""
    points, triangles, sides = [], [], []
    for number, (x, low, high) in enumerate(bounds):
        y = np.linspace(-THICK / 2, THICK / 2, 9)
        z = np.linspace(low, high, 9)
        grid = np.array([(x, b, c) for b in y for c in z])
        corner = np.array(
            [(9 * j + k, 9 * j + k + 1, 9 * j + k + 10, 9 * j + k + 9) for j in range(8) for k in range(8)]
        )
        start = 81 * number
        # Wound with the normal along -x, so the part behind each triangle is the one at larger x.
        block = np.vstack([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]]) + start
        points.append(grid)
        triangles.append(block)
        sides.append(np.tile([2 * number + 1, 2 * number], (len(block), 1)))
    points = np.vstack(points) if turn is None else np.vstack(points) @ turn.T
    sides = np.vstack(sides)
    solid = Solid(
        points, np.vstack(triangles), sides, np.full(len(sides), -1), np.ones(2 * len(bounds)), np.zeros((1, 3))
    )
    return solid, interfaces_between(solid)


def bar(bounds, turn=None):
    solid, interfaces = sections(bounds, turn)
    box = trimesh.creation.box((1.0, THICK, THICK))
    surface = Surface(np.asarray(box.vertices), np.asarray(box.faces), 1.0, np.zeros(3), "bar")
    return ElasticBody(surface, solid, interfaces, bar_mesh(turn))


HALF = THICK / 2
BOUNDS = [(x - 0.5, -HALF, HALF) for x in SECTIONS] + [(0.3, -HALF, 0.0), (0.3, 0.0, HALF)]
BOUNDS += [(0.0, -HALF, 0.0), (0.0, 0.0, HALF), (0.3, -HALF, HALF)]


@pytest.fixture(scope="module")
def whole():
    return bar(BOUNDS)


def test_the_bars_normals_point_from_the_first_part_to_the_second(whole):
    np.testing.assert_allclose(whole.interfaces.normals, np.tile(X, (len(BOUNDS), 1)), atol=1e-12)


def test_a_bar_struck_at_its_end_is_compressed_by_what_has_still_to_be_pushed(whole):
    traction = whole.tractions(END[None])[0] @ X
    expected = -(1.0 - np.array(SECTIONS)) / THICK**2
    np.testing.assert_allclose(traction[:3, 0], expected, rtol=0.01)
    np.testing.assert_allclose(traction[:3, 1:], 0.0, atol=0.01 * abs(expected).max())


def test_a_bar_pulled_at_its_end_is_in_tension(whole):
    traction = whole.tractions(END[None])[0] @ -X
    assert (np.einsum("ik,ik->i", traction, whole.interfaces.normals)[:3] > 0).all()


def test_a_bar_struck_sideways_in_the_middle_bends_like_a_free_beam(whole):
    traction = whole.tractions(np.array([[0.0, 0.0, HALF]]))[0] @ -Z
    below, above = traction[3:5, 0]
    # M(x) = F (L/2 - x)² / 2L of a free beam; over half of a square section the mean stress is 3 M / h³.
    expected = 3 * (0.2**2 / 2) / THICK**3
    assert below == pytest.approx(expected, rel=0.03)
    assert above == pytest.approx(-expected, rel=0.03)
    # The beam's shear force, upward on the part at smaller x, is shared by the two halves.
    assert traction[3:5, 2].mean() == pytest.approx((0.5 - 0.3) / THICK**2, rel=0.03)


def test_the_far_side_of_an_impact_is_in_tension_and_the_near_side_compressed(whole):
    traction = whole.tractions(np.array([[0.0, 0.0, HALF]]))[0] @ -Z
    # The patch takes F σ/√(2π) off the moment F L/8 of a point load.
    expected = 3 * (1 / 8 - PATCH_RADIUS / np.sqrt(2 * np.pi)) / THICK**3
    assert traction[5, 0] == pytest.approx(expected, rel=0.1)
    assert traction[6, 0] == pytest.approx(-expected, rel=0.1)


def test_what_a_section_carries_balances_the_rigid_motion_of_the_part_behind_it(whole):
    point, direction = np.array([-0.1, 0.03, HALF]), np.array([0.6, 0.0, -0.8])
    count = (400, 40, 40)
    grid = [(np.arange(n) + 0.5) / n * size - size / 2 for n, size in zip(count, (1, THICK, THICK), strict=True)]
    x = np.stack(np.meshgrid(*grid, indexing="ij"), -1).reshape(-1, 3)
    volume = THICK**2 / len(x)
    patch = np.exp(-((x - point) ** 2).sum(axis=1) / (2 * PATCH_RADIUS**2))
    patch /= patch.sum() * volume
    inertia = volume * (np.eye(3) * (x**2).sum() - x.T @ x)
    spin = np.linalg.solve(inertia, volume * np.cross(x, patch[:, None] * direction).sum(axis=0))
    force = patch[:, None] * direction - direction / THICK**2 - np.cross(spin, x)
    traction = whole.tractions(point[None])[0] @ direction
    for k, section in enumerate(SECTIONS):
        behind = volume * force[x[:, 0] < section - 0.5].sum(axis=0)
        carried = traction[k] * whole.interfaces.areas[k]
        np.testing.assert_allclose(carried + behind, 0.0, atol=0.02)


def test_a_load_has_no_net_force_and_no_net_torque(whole):
    points = np.array([END, [0.2, HALF, 0.01], [0.4, 0.02, -HALF]])
    loads = whole.loads(points, np.array([X, [0.0, -0.6, 0.8], Z]))
    size = np.abs(loads).sum(axis=0)
    assert (np.abs(rigid_motions(whole.nodes).T @ loads) < 1e-12 * size).all()


def test_asking_the_interfaces_gives_what_solving_for_the_impact_gives(whole):
    points = np.array([END, [0.21, HALF, 0.01]])
    directions = np.array([[0.8, 0.0, 0.6], [0.0, -1.0, 0.0]])
    forward = whole.tractions_of(whole.displacements(points, directions))
    backward = np.einsum("nikj,nj->nik", whole.tractions(points), directions)
    np.testing.assert_allclose(backward, forward, atol=1e-8 * np.abs(forward).max())


def test_a_turned_bar_answers_a_turned_impact_with_turned_tractions(whole):
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
    point = np.array([[0.1, 0.0, HALF]])
    turned = bar(BOUNDS, turn).tractions(point @ turn.T)[0]
    expected = turn @ whole.tractions(point)[0] @ turn.T
    # Not exact: a sample on the facet of two tetrahedra takes the stress of one or the other.
    np.testing.assert_allclose(turned, expected, atol=5e-3 * np.abs(expected).max())


def test_the_mean_over_a_section_hides_bending_and_the_root_mean_square_shows_it(whole):
    displacement = whole.displacements(np.array([[0.0, 0.0, HALF]]), -Z[None])
    mean = effective_opening(whole.tractions_of(displacement), whole.interfaces.normals)[0, -1]
    shown = whole.root_mean_square_loads(displacement)[0, -1]
    moment, shear = 0.2**2 / 2, 0.2
    assert mean == pytest.approx(shear / THICK**2, rel=0.05)
    # Half of the section pulls with a root mean square of √12 M / h³.
    bending = np.sqrt(12 * moment**2 / THICK**6 * (1 + 0.01) / 2)
    assert shown == pytest.approx(np.hypot(bending, shear / THICK**2), rel=0.05)


def test_points_are_found_in_the_mesh_and_those_just_outside_moved_to_it():
    mesh = bar_mesh()
    rng = np.random.default_rng(0)
    inside = rng.uniform(-0.5, 0.5, (200, 3)) * [1.0, THICK, THICK]
    outside = np.array([[0.0, 0.0, HALF + 1e-4]])
    tets, local = locate(mesh, np.vstack([inside, outside]))
    corner = mesh.p.T[mesh.t.T[tets]]
    back = corner[:, 0] + np.einsum("nk,nki->ni", local, corner[:, 1:] - corner[:, :1])
    np.testing.assert_allclose(back[:-1], inside, atol=1e-12)
    np.testing.assert_allclose(back[-1], outside[0], atol=1e-3)


def test_tension_shear_and_compression_count_as_in_the_breaking_rule():
    tractions = 2.0 * np.array([[X, -X, Z]])
    np.testing.assert_allclose(effective_opening(tractions, np.tile(X, (3, 1)))[0], [2.0, 0.2, 2.0])


@pytest.fixture(scope="module")
def modal():
    box = trimesh.creation.box((1.0, 0.4, 0.2)).subdivide().subdivide().subdivide()
    return ModalSimulator.build(read_surface(box), SimulatorOptions(cells=400, modes=5), np.random.default_rng(0))


@pytest.fixture(scope="module")
def elastic(modal):
    axes = [np.linspace(-size / 2, size / 2, n) for size, n in ((1.0, 11), (0.4, 5), (0.2, 4))]
    return ElasticSimulator.from_modal(modal, MeshTet.init_tensor(*axes))


def test_the_gauge_makes_the_median_thresholds_agree(modal, elastic):
    impacts = single_impacts(modal.surface, 2000, np.random.default_rng(0))
    assert np.median(elastic.thresholds(impacts)) == pytest.approx(np.median(modal.thresholds(impacts)))


def test_an_impact_parts_the_elastic_body_from_its_threshold_on(elastic):
    impacts = single_impacts(elastic.surface, 50, np.random.default_rng(1))
    critical = elastic.thresholds(impacts)
    assert (elastic.fracture(impacts.times(0.999 * critical)).labels == 0).all()
    above = elastic.fracture(impacts.times(1.001 * critical))
    assert above.broken.any(axis=1).all()
    assert elastic.load_ratios(impacts.times(critical)).max(axis=1) == pytest.approx(
        critical * elastic.load_ratios(impacts).max(1)
    )


def test_contacts_lie_between_vertices_and_add_up(elastic):
    normal, faces = elastic.interfaces.normals, elastic.surface.faces
    share, push = np.array([0.2, 0.3, 0.5]), np.array([[0.0, 0.6, -0.8], [1.0, 0.0, 0.0]])
    impact = Impacts(np.array([[7, 40]]), np.tile(share, (1, 2, 1)), push[None], np.array([[2.0, 0.5]]))
    expected = sum(
        strength * np.einsum("c,cjik,j->ik", share, elastic.unit_tractions[faces[face]], d)
        for face, d, strength in zip((7, 40), push, (2.0, 0.5), strict=True)
    )
    np.testing.assert_allclose(elastic.tractions(impact)[0], expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(elastic.load_ratios(impact), effective_opening(expected[None], normal))


def test_thin_bodies_get_smaller_tetrahedra(modal):
    assert mesh_edge(modal.surface) == 0.05
    thin = read_surface(trimesh.creation.box((1.0, 1.0, 0.02)))
    assert mesh_edge(thin) == pytest.approx(2 * 0.02 / 2.08)


def test_interfaces_of_other_parts_are_refused():
    solid, _ = sections(BOUNDS)
    other = Interfaces(np.array([[0, 2]]), np.ones(1), X[None], np.ones(1))
    with pytest.raises(BakeError, match="not those between the cells"):
        ElasticBody(None, solid, other, bar_mesh())


def test_without_wildmeshing_the_extra_that_brings_it_is_named(modal, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"wildmeshing is not installed.*elastic") as caught:
        ElasticSimulator.from_modal(modal)
    assert caught.value.extra == "elastic"


def test_a_restored_elastic_simulator_answers_with_the_same_bits(elastic):
    arrays, numbers = elastic.state()
    again = ElasticSimulator.restore(elastic.surface, elastic.cells, elastic.interfaces, arrays, numbers)
    impacts = single_impacts(elastic.surface, 100, np.random.default_rng(2))
    np.testing.assert_array_equal(again.thresholds(impacts), elastic.thresholds(impacts))
    np.testing.assert_array_equal(again.fine_to_cell, elastic.fine_to_cell)
