"""Distances to the cracks: exact beside them, right where the surface unrolls, and the same however it is numbered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fracsim.simulators.base import interfaces_between
from fracsim.solids.cut import cut_lattice
from fracsim.solids.geodesics import (
    CAP,
    VERTICES_PER_INTERFACE,
    CurveDistances,
    crack_segments,
    interface_distances,
    split_in_four,
)
from fracsim.solids.polygons import coarsen
from fracsim.solids.solid import merge_small_regions, relabel, shared_faces
from fracsim.solids.surface import Surface, read_surface, refine


def two_parts(surface, normal, offset=0.0, cells=300):
    """The surface's solid in two parts; the crack follows the lattice's facets along a plane."""
    solid = cut_lattice(surface, cells, np.random.default_rng(0))
    label = (solid.centroids @ np.asarray(normal) > offset).astype(np.int64)
    return coarsen(relabel(solid, label), surface)


def to_segments(points, start, end):
    """Straight distances (N, S) from points to segments of a plane or of space."""
    along = end - start
    arm = points[:, None] - start
    t = np.clip((arm * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    return np.linalg.norm(arm - t[:, :, None] * along, axis=2)


@pytest.fixture(scope="module")
def slab():
    surface = read_surface(trimesh.creation.box((1.0, 0.8, 0.2)).subdivide().subdivide().subdivide().subdivide())
    solid = two_parts(surface, (0.9, 0.4, 0.1))
    return surface, solid, CurveDistances(solid, surface)


@pytest.fixture(scope="module")
def rod():
    """A tall prism over a regular 16-gon, whose side unrolls."""
    surface = refine(read_surface(trimesh.creation.cylinder(0.2, 1.0, sections=16)), 0.05)
    return surface, two_parts(surface, (0.2, 0.1, 1.0))


@pytest.fixture(scope="module")
def divided():
    """A ball in a dozen parts or so."""
    surface = read_surface(trimesh.creation.icosphere(3))
    cells = cut_lattice(surface, 200, np.random.default_rng(0))
    pairs, areas, _ = shared_faces(cells.triangles, cells.sides, cells.points)
    solid = coarsen(
        relabel(cells, merge_small_regions(cells.volumes, pairs, areas, 0.04 * cells.volumes.sum())), surface
    )
    return surface, solid, CurveDistances(solid, surface)


def test_on_a_flat_side_distances_are_the_straight_ones(slab):
    surface, solid, curves = slab
    distance = curves.between(np.array([0, 1]))
    top = surface.vertices[:, 2].max()
    half = surface.vertices.max(axis=0)
    here = np.flatnonzero(np.abs(curves.nodes[:, 2] - top) < 1e-9)
    flat = (np.abs(solid.points[curves.segments][:, :, 2] - top) < 1e-9).all(axis=1)
    ends = solid.points[curves.segments[flat]]
    exact = to_segments(curves.nodes[here], ends[:, 0], ends[:, 1]).min(axis=1)
    rim = (half[:2] - np.abs(curves.nodes[here, :2])).min(axis=1)
    known = exact < rim  # no way over the rim can be shorter
    assert known.sum() > 300
    error = np.abs(distance[here[known]] - np.minimum(exact[known], CAP))
    assert error.mean() < 1e-3
    assert error.max() < 0.02
    # Exact to rounding where a node's within_face faces hold the nearest stretch of the crack.
    beside = np.full(len(curves.nodes), np.inf)
    np.minimum.at(beside, curves.corners.ravel(), curves.beside.ravel())
    within_face = known & (beside[here] <= exact + 1e-12)
    assert within_face.sum() > 50
    np.testing.assert_allclose(distance[here[within_face]], exact[within_face], rtol=0, atol=1e-12)


def test_around_a_prism_distances_are_those_of_its_unrolled_side(rod):
    surface, solid = rod
    curves = CurveDistances(solid, surface)
    distance = curves.between(np.array([0, 1]))
    normals = surface.trimesh.face_normals
    side = np.abs(normals[:, 2]) < 0.5
    assert side[curves.faces].all()
    # Unroll: which of the 16 flat strips, and how far along it.
    angle = 2 * np.pi / 16
    mean = np.arctan2(normals[:, 1], normals[:, 0])
    first = mean[side][0]
    strip = np.round((mean - first) / angle)
    width = 2 * np.tan(angle / 2) * (surface.vertices[surface.faces[side][0]] @ normals[side][0]).mean()

    def unroll(points, strips):
        turn = first + angle * strips
        return np.stack([strips * width + points[:, 1] * np.cos(turn) - points[:, 0] * np.sin(turn), points[:, 2]], 1)

    _, _, _, face_edges = split_in_four(surface)
    node_strip = np.zeros(len(curves.nodes))
    on_side = np.zeros(len(curves.nodes), dtype=bool)
    for corners in (surface.faces, face_edges + len(surface.vertices)):
        node_strip[corners[side]] = strip[side, None]
        on_side[corners[side]] = True
    flat = unroll(curves.nodes, node_strip)[on_side]
    start, end = (unroll(solid.points[curves.segments[:, k]], strip[curves.faces]) for k in (0, 1))
    around = [np.array([turn * 16 * width, 0.0]) for turn in (-1, 0, 1)]
    exact = np.min([to_segments(flat, start + shift, end + shift).min(axis=1) for shift in around], axis=0)
    error = np.abs(distance[on_side] - np.minimum(exact, CAP))
    assert error.mean() < 2e-3
    assert error.max() < 0.02
    assert (exact[distance[on_side] == CAP] > CAP - 0.02).all()
    # Where the crack runs through a node's faces the value is exact, round the corner of the strip as well.
    crossed = np.isin(np.flatnonzero(on_side), curves.corners)
    assert error[crossed].max() < 2e-3
    assert np.median(error[crossed]) < 1e-12


def test_on_a_ball_distances_are_arcs():
    surface = read_surface(trimesh.creation.icosphere(4))
    solid = two_parts(surface, (0.0, 0.0, 1.0))
    curves = CurveDistances(solid, surface)
    t = np.linspace(0, 1, 8)[:, None, None]
    ends = solid.points[curves.segments]
    points = ((1 - t) * ends[:, 0] + t * ends[:, 1]).reshape(-1, 3)
    unit, nodes = (x / np.linalg.norm(x, axis=1)[:, None] for x in (points, curves.nodes))
    exact = 0.5 * np.arccos(np.clip((nodes @ unit.T).max(axis=1), -1, 1))
    error = np.abs(curves.between(np.array([0, 1])) - np.minimum(exact, CAP))
    assert error.mean() < 2e-3
    assert error.max() < 0.02


def test_distances_end_at_the_cap(slab):
    _, _, curves = slab
    distance = curves.between(np.array([0, 1]))
    assert distance.min() >= 0.0
    assert distance.max() == CAP
    assert (distance == CAP).mean() > 0.1


def test_where_nothing_parts_everything_is_at_the_cap(slab):
    _, _, curves = slab
    assert (curves.between(np.array([0, 0])) == CAP).all()
    distance, seeds = curves.to(np.zeros(0, dtype=np.int64))
    assert (distance == CAP).all()
    assert len(seeds) == 0


def test_the_numbering_of_vertices_faces_and_parts_does_not_matter(divided):
    surface, solid, curves = divided
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 3, len(solid.volumes))
    expected = curves.between(labels)
    count = len(surface.vertices)
    vertex, face, part = rng.permutation(count), rng.permutation(len(surface.faces)), rng.permutation(len(labels))
    new_vertex = np.argsort(vertex)
    shuffled = replace(surface, vertices=surface.vertices[vertex], faces=new_vertex[surface.faces[face]])
    point = np.concatenate([new_vertex, np.arange(count, len(solid.points))])
    renamed = replace(
        solid,
        points=np.vstack([surface.vertices[vertex], solid.points[count:]]),
        triangles=point[solid.triangles],
        sides=np.where(solid.sides >= 0, np.argsort(part)[solid.sides], -1),
        source=np.where(solid.source >= 0, np.argsort(face)[solid.source], -1),
    )
    again = CurveDistances(renamed, shuffled)
    distance = again.between(labels[part])
    np.testing.assert_allclose(distance[:count], expected[:count][vertex], atol=1e-9)
    _, _, edges, _ = split_in_four(surface)
    _, _, new_edges, _ = split_in_four(shuffled)
    where = {tuple(edge): k for k, edge in enumerate(edges.tolist())}
    old = [where[tuple(edge)] for edge in np.sort(vertex[new_edges], axis=1).tolist()]
    np.testing.assert_allclose(distance[count:], expected[count:][old], atol=1e-9)
    # Names of pieces are but names.
    np.testing.assert_array_equal(curves.between(np.array([7, 3, 5])[labels]), expected)


def test_the_smallest_distance_to_the_broken_interfaces_is_the_distance_to_the_cracks(divided):
    surface, solid, curves = divided
    pairs = interfaces_between(solid).pairs
    distances, interface_vertices = interface_distances(curves, pairs)
    assert distances.shape == (len(pairs), len(curves.nodes))
    for seed in range(5):
        labels = np.random.default_rng(seed).integers(0, 3, len(solid.volumes))
        parting = labels[pairs[:, 0]] != labels[pairs[:, 1]]
        gap = np.abs(distances[parting].min(axis=0) - curves.between(labels))
        for where in (slice(None, curves.vertices), slice(curves.vertices, None)):  # vertices, midpoints
            assert gap[where].mean() < 1e-3
            assert gap[where].max() < 0.01
        assert (curves.between(labels) - distances[parting].min(axis=0)).max() < 2e-3  # more cracks are no further
    # They are vertices of the faces that the interface's curve crosses; none where it stays inside.
    for pair, row in zip(pairs, interface_vertices, strict=True):
        crossed = curves.faces[(curves.cells == pair).all(axis=1)]
        assert len(row) == VERTICES_PER_INTERFACE
        assert np.isin(row, surface.faces[crossed]).all() if len(crossed) else (row == -1).all()


def test_cracks_run_between_parts_along_the_faces_that_they_name(divided):
    surface, solid, _ = divided
    segments, parts, faces = crack_segments(solid)
    assert (parts[:, 0] < parts[:, 1]).all()
    corner = surface.vertices[surface.faces[faces]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = np.einsum("sni,si->sn", solid.points[segments] - corner[:, :1], normal)
    assert np.abs(height).max() < 1e-12
    # Every edge of the surface whose ends lie on different parts is crossed.
    part = solid.vertex_cells(len(surface.vertices))
    _, _, edges, face_edges = split_in_four(surface)
    crossed = np.flatnonzero(part[edges[:, 0]] != part[edges[:, 1]])
    assert np.isin(crossed, face_edges[faces]).all()


def test_both_sides_of_a_thin_wall_are_on_one_part_but_for_a_wall_s_thickness_about_the_cracks():
    wall = 0.03
    shell = refine(read_surface(trimesh.creation.annulus(0.5 - wall, 0.5, 0.8, sections=32)), 0.1)
    cells = cut_lattice(shell, 300, np.random.default_rng(0))
    pairs, areas, _ = shared_faces(cells.triangles, cells.sides, cells.points)
    solid = relabel(cells, merge_small_regions(cells.volumes, pairs, areas, 0.05 * cells.volumes.sum()))
    assert len(solid.volumes) > 5
    part = solid.vertex_cells(len(shell.vertices))
    radius = np.linalg.norm(shell.vertices[:, :2], axis=1)
    outside = np.flatnonzero((radius > 0.49) & (np.abs(shell.vertices[:, 2]) < 0.39))
    inside = np.flatnonzero(radius < 0.48)
    gap = np.linalg.norm(shell.vertices[outside, None] - shell.vertices[inside], axis=2)
    faced = gap.min(axis=1) < 1.1 * wall  # the vertices that have one straight behind them
    assert faced.sum() > 100
    front, behind = outside[faced], inside[gap.argmin(axis=1)[faced]]
    same = part[front] == part[behind]
    assert same.mean() > 0.8
    segments, _, _ = crack_segments(solid)
    ends = solid.points[segments]
    near = [to_segments(shell.vertices[k[~same]], ends[:, 0], ends[:, 1]).min(axis=1) for k in (front, behind)]
    assert (np.minimum(*near) < 1.1 * wall).all()


def test_midpoints_are_nodes_and_the_old_vertices_stay_first():
    surface = Surface(
        *(np.asarray(x) for x in (trimesh.creation.box().vertices, trimesh.creation.box().faces)),
        1.0,
        np.zeros(3),
        "box",
    )
    nodes, fine, edges, face_edges = split_in_four(surface)
    np.testing.assert_array_equal(nodes[:8], surface.vertices)
    np.testing.assert_allclose(nodes[8:], surface.vertices[edges].mean(axis=1))
    assert len(fine) == 4 * len(surface.faces)
    assert trimesh.Trimesh(nodes, fine, process=False).is_watertight
    for k in range(3):
        ends = np.sort(surface.faces[:, [k, (k + 1) % 3]], axis=1)
        np.testing.assert_array_equal(edges[face_edges[:, k]], ends)
