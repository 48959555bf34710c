"""The faces between cells: what is known of a box that is cut in a known way, and what holds of every solid."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from fracsim.simulators.base import interfaces_between
from fracsim.simulators.lattice_faces import CORNERS, cell_faces
from fracsim.solids.cut import cut_lattice, measure_cells
from fracsim.solids.solid import relabel
from fracsim.solids.surface import read_surface
from fracsim.solids.voronoi import voronoi_solid


def split_box(parts_of):
    """A box of 1 x 0.5 x 0.2 in two by two blocks along x and y, ``parts_of`` which cells they are."""
    x, y, z = np.array([0.0, 0.4, 1.0]), np.array([0.0, 0.2, 0.5]), np.array([0.0, 0.2])
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
    triangles, sides = [], []

    def index(i, j, k):
        return (i * 3 + j) * 2 + k

    def quad(a, b, c, d, behind, before):
        triangles.extend([[a, b, c], [a, c, d]])
        sides.extend([[behind, before]] * 2)

    def block(i, j):
        return parts_of[i, j] if 0 <= i < 2 and 0 <= j < 2 else -1

    def add(corners, behind, before):
        if behind < 0:
            corners, behind, before = corners[::-1], before, behind
        if behind != before:
            quad(*corners, behind, before)

    for i in range(3):
        for j in range(2):
            corners = [index(i, j, 0), index(i, j + 1, 0), index(i, j + 1, 1), index(i, j, 1)]
            add(corners, block(i - 1, j), block(i, j))
    for i in range(2):
        for j in range(3):
            corners = [index(i, j, 0), index(i, j, 1), index(i + 1, j, 1), index(i + 1, j, 0)]
            add(corners, block(i, j - 1), block(i, j))
        for j in range(2):
            bottom = [index(i, j, 0), index(i, j + 1, 0), index(i + 1, j + 1, 0), index(i + 1, j, 0)]
            add(bottom, block(i, j), -1)
            top = [index(i, j, 1), index(i + 1, j, 1), index(i + 1, j + 1, 1), index(i, j + 1, 1)]
            add(top, block(i, j), -1)
    triangles, sides = np.array(triangles), np.array(sides)
    return measure_cells(points, triangles, sides, np.where(sides[:, 1] < 0, 0, -1))


def test_four_blocks_meet_in_rectangles_of_known_areas_and_moments():
    solid = split_box(np.array([[0, 1], [2, 3]]))
    assert solid.volumes == pytest.approx([0.4 * 0.2 * 0.2, 0.4 * 0.3 * 0.2, 0.6 * 0.2 * 0.2, 0.6 * 0.3 * 0.2])
    faces = cell_faces(solid)
    assert faces.pairs.tolist() == [[0, 1], [0, 2], [1, 3], [2, 3]]
    assert faces.areas == pytest.approx([0.4 * 0.2, 0.2 * 0.2, 0.3 * 0.2, 0.6 * 0.2])
    np.testing.assert_allclose(
        faces.centroids, [[0.2, 0.2, 0.1], [0.4, 0.1, 0.1], [0.4, 0.35, 0.1], [0.7, 0.2, 0.1]], atol=1e-12
    )
    np.testing.assert_allclose(faces.normals, [[0, 1, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    # A rectangle of sides a and b: a^3 b / 12 along a.
    expected = [
        np.diag([0.4**3 * 0.2, 0, 0.4 * 0.2**3]),
        np.diag([0, 0.2**3 * 0.2, 0.2 * 0.2**3]),
        np.diag([0, 0.3**3 * 0.2, 0.3 * 0.2**3]),
        np.diag([0.6**3 * 0.2, 0, 0.6 * 0.2**3]),
    ]
    np.testing.assert_allclose(faces.second_moments, np.array(expected) / 12, atol=1e-15)
    assert faces.spring_lengths == pytest.approx([0.25, 0.5, 0.5, 0.25])
    assert faces.corner_counts.tolist() == [4] * 4
    assert len(faces.fronts) == 0  # four cells lie around the inner edge
    corner = faces.corners[1] + faces.centroids[1]
    assert sorted(map(tuple, corner.round(9))) == [(0.4, 0, 0), (0.4, 0, 0.2), (0.4, 0.2, 0), (0.4, 0.2, 0.2)]


def test_three_blocks_around_an_edge_are_a_front():
    faces = cell_faces(split_box(np.array([[0, 0], [1, 2]])))
    assert faces.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert faces.fronts.tolist() == [[0, 1, 2]]


SOLIDS = {
    "box": lambda: voronoi_solid(read_surface(trimesh.creation.box((1.0, 0.6, 0.3))), 40, np.random.default_rng(0)),
    "ring": lambda: voronoi_solid(
        read_surface(trimesh.creation.annulus(0.4, 0.5, 0.3, sections=24)), 60, np.random.default_rng(0)
    ),
    "joined lattice": lambda: relabel(
        (cells := cut_lattice(read_surface(trimesh.creation.icosphere(2)), 300, np.random.default_rng(0))),
        np.arange(cells.count) // 3,
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_what_holds_of_every_solid(name):
    solid = SOLIDS[name]()
    faces, interfaces = cell_faces(solid), interfaces_between(solid)
    np.testing.assert_array_equal(faces.pairs, interfaces.pairs)
    np.testing.assert_allclose(faces.areas, interfaces.areas)
    assert (faces.spring_lengths > 0).all()
    assert (np.linalg.eigvalsh(faces.second_moments) > -1e-15).all()
    # Springs know a face by its shape seen along its normal, also where it is not planar.
    across = np.einsum("fij,fj->fi", faces.second_moments, faces.normals)
    assert np.abs(across).max() < 1e-12
    assert faces.corners.shape[1] <= CORNERS
    assert (faces.corner_counts >= 3).all()
    if name != "joined lattice":  # whose faces are not planar
        assert np.abs(np.einsum("fki,fi->fk", faces.corners, faces.normals)).max() < 1e-9
        # The farthest corner is about where the area's second moment says.
        radius = np.linalg.norm(faces.corners, axis=2).max(axis=1)
        assert (np.trace(faces.second_moments, axis1=1, axis2=2) < faces.areas * radius**2).all()
    # Each front is three faces between three cells.
    assert len(faces.fronts)
    for triple in faces.fronts:
        assert len(set(triple.tolist())) == 3
        assert len(np.unique(faces.pairs[triple])) == 3
        assert len(np.unique(np.sort(faces.pairs[triple], axis=1), axis=0)) == 3


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.tuples(st.floats(0.1, 1.0), st.floats(0.1, 1.0)),
    st.integers(12, 40),
)
def test_the_area_vectors_of_a_closed_cell_cancel(seed, sizes, cells):
    surface = read_surface(trimesh.creation.box((1.0, *sizes)))
    solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
    faces = cell_faces(solid)
    total = np.zeros((solid.count, 3))
    vectors = faces.areas[:, None] * faces.normals
    planar = interfaces_between(solid).projected > (1 - 1e-9) * faces.areas
    np.add.at(total, faces.pairs[:, 0], vectors)
    np.add.at(total, faces.pairs[:, 1], -vectors)
    outer = solid.sides[:, 1] < 0
    corner = solid.points[solid.triangles[outer]]
    area = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.add.at(total, solid.sides[outer, 0], area)
    folded = np.unique(faces.pairs[~planar])
    assert np.abs(np.delete(total, folded, axis=0)).max(initial=0.0) < 1e-9
