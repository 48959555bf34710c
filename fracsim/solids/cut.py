"""Cutting a lattice with a surface, exactly: the solid's cells are the parts of tetrahedra inside the body.

Offline only. All questions about positions go through ``_orient``, so they never contradict each other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError
from .lattice import FACETS, tilted_lattice
from .polygons import triangulate_polygon
from .solid import Solid, merge_small_regions, relabel, shared_faces, sum_by_index
from .surface import Surface

TRIES = 8  # lattices tried before a surface is called impossible; one has been enough for every surface so far
SIZE_RATIO = 1.3  # between tetrahedra that are searched for together
CLEAR = 1e-9  # of the largest extent: what is farther before a plane is so whatever the rounding
SLIVER = 0.1  # of a whole tetrahedron; smaller cells are joined to the neighbour they share most area with


class DegenerateCut(Exception):
    """The lattice met the surface in a position that rounding cannot decide; another lattice does not."""


def cut_lattice(surface: Surface, cells: int, rng: np.random.Generator) -> Solid:
    """Cut a jittered lattice with a surface.

    A tetrahedron that the surface leaves in several parts gives several cells, so two walls closer than the spacing
    stay apart.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    cells : int
        About how many tetrahedra meet the body. There are fewer cells, as small ones are joined.
    rng : numpy.random.Generator
        Places the lattice.

    Returns
    -------
    Solid
        Of the body.

    Raises
    ------
    BakeError
        If no lattice gives cells that add up to the body.
    """
    fault = ""
    for _ in range(TRIES):
        try:
            return join_slivers(cut_once(surface, *tilted_lattice(surface, cells, rng)))
        except DegenerateCut as error:
            fault = str(error)
    raise BakeError(
        f"{surface.name}: cannot be cut into cells ({fault}); the surface probably runs through itself: "
        "repair it before baking"
    )


def _unique_rows(rows: IntArray) -> tuple[IntArray, IntArray]:
    """Sort rows within themselves and make them unique: ``sort(rows) == unique[inverse]``."""
    ordered = np.sort(rows, axis=1)
    unique, inverse = np.unique(ordered, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)


def _orient(points: FloatArray, *corners: IntArray) -> FloatArray:
    """Return six times the signed volume of tetrahedra, positive when the fourth point is before the first three.

    It is evaluated with the indices in ascending order whatever the caller's, so that every question about the
    same four points gets the same answer up to sign: that consistency is what keeps the complex closed.
    """
    quad = np.stack(corners, axis=1)
    swaps = sum((quad[:, i] > quad[:, j]).astype(np.int64) for i in range(4) for j in range(i + 1, 4))
    a, b, c, d = np.moveaxis(points[np.sort(quad, axis=1)], 1, 0)
    value = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)
    return np.where(swaps % 2 == 0, value, -value)


def _pierces(points: FloatArray, segment: IntArray, triangle: IntArray) -> npt.NDArray[np.bool_]:
    """Decide which segments pass through their triangles."""
    p, q = segment.T
    a, b, c = triangle.T
    result = (_orient(points, a, b, c, p) > 0) != (_orient(points, a, b, c, q) > 0)
    # Few segments have their ends on both sides of the plane; only of these the line's side of each edge is asked for.
    p, q, a, b, c = (column[result] for column in (p, q, a, b, c))
    ab, bc, ca = (_orient(points, p, q, x, y) > 0 for x, y in ((a, b), (b, c), (c, a)))
    result[result] = (ab == bc) & (bc == ca)
    return result


def _crossing(points: FloatArray, segment: IntArray, triangle: IntArray) -> tuple[FloatArray, FloatArray]:
    """Find where segments meet triangles' planes: parameters (N,) along the segment and points (N, 3)."""
    p, q = segment.T
    a, b, c = triangle.T
    first, second = _orient(points, a, b, c, p), _orient(points, a, b, c, q)
    t = first / (first - second)
    return t, points[p] + t[:, None] * (points[q] - points[p])


def _candidates(vertices: FloatArray, faces: IntArray, points: FloatArray, tetrahedra: IntArray) -> IntArray:
    """List pairs (surface face, tetrahedron) that may meet."""
    triangles, tets = vertices[faces], points[tetrahedra]
    middle, centre = triangles.mean(axis=1), tets.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    radius = np.linalg.norm(tets - centre[:, None], axis=2).max(axis=1)
    # Tetrahedra of one size at a time, as a search must reach as far as the largest in it.
    size = np.floor(np.log(radius / radius.max()) / np.log(SIZE_RATIO))
    blocks = []
    for one_size in np.unique(size):
        chosen = np.flatnonzero(size == one_size)
        near = cKDTree(centre[chosen]).query_ball_point(middle, reach + radius[chosen].max(), return_sorted=False)
        lengths = [len(row) for row in near]
        blocks.append((np.repeat(np.arange(len(faces)), lengths), chosen[np.concatenate(near).astype(np.int64)]))
    face, tet = (np.concatenate(column) for column in zip(*blocks, strict=True))
    # A box that misses, or a tetrahedron wholly on one side of the face's plane, cannot meet.
    overlap = (triangles.min(axis=1)[face] <= tets.max(axis=1)[tet]).all(axis=1)
    overlap &= (triangles.max(axis=1)[face] >= tets.min(axis=1)[tet]).all(axis=1)
    face, tet = face[overlap], tet[overlap]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    height = np.einsum("nij,nj->ni", tets[tet] - triangles[face, None, 0], normal[face])
    cut = (height.max(axis=1) >= 0) & (height.min(axis=1) <= 0)
    face, tet = face[cut], tet[cut]
    # Nor can a face that is wholly before one of the tetrahedron's facets.
    facet = tets[:, FACETS]
    outward = np.cross(facet[:, :, 1] - facet[:, :, 0], facet[:, :, 2] - facet[:, :, 0])
    outward /= np.maximum(np.linalg.norm(outward, axis=2), 1e-300)[:, :, None]
    offset = np.einsum("tki,tki->tk", outward, facet[:, :, 0])
    for k in range(4):
        before = np.einsum("nji,ni->nj", triangles[face], outward[tet, k]).min(axis=1) - offset[tet, k]
        near_enough = before <= CLEAR
        face, tet = face[near_enough], tet[near_enough]
    return np.stack([face, tet], axis=1)


def _pairs(left: IntArray, right: IntArray, width: int) -> tuple[IntArray, IntArray]:
    """Make pairs of the two arrays unique, ordered by ``left * width + right``."""
    keys = np.sort(left.astype(np.int64) * width + right)
    keys = keys[np.diff(keys, prepend=-1) > 0]  # by sorting, several times faster than numpy's hashing here
    return keys // width, keys % width


def _find(keys: IntArray, wanted: IntArray) -> IntArray:
    """Find ``wanted`` in the sorted ``keys``; -1 where absent."""
    if len(keys) == 0:
        return np.full(wanted.shape, -1)
    position = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
    return np.where(keys[position] == wanted, position, -1)


def cut_once(surface: Surface, lattice: FloatArray, tetrahedra: IntArray) -> Solid:
    """Arrange the surface and one lattice inside the body.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    lattice : ndarray of float64, shape (P, 3)
        Points that cover the body.
    tetrahedra : ndarray of int64, shape (T, 4)
        Of positive volume.

    Returns
    -------
    Solid
        Every connected part of a tetrahedron is a cell.

    Raises
    ------
    DegenerateCut
        If rounding cannot decide how they meet.

    Notes
    -----
    The vertices are surface vertices, surface edges through lattice facets, lattice edges through surface faces, and
    lattice points inside. A face and a tetrahedron meet in a convex polygon; a facet and the body meet in polygons
    bounded by where faces cross it and by the inner stretches of its edges.
    """
    vertices, faces = surface.vertices, surface.faces
    v, s = len(vertices), len(faces)
    both = np.vstack([vertices, lattice])
    edges, face_edges = _unique_rows(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    face_edges = face_edges.reshape(-1, 3)
    wound = (tetrahedra[:, FACETS] + v).reshape(-1, 3)
    _, tet_facets = _unique_rows(wound)
    _, first = np.unique(tet_facets, return_index=True)
    facets = wound[first]  # as wound by the first of its two tetrahedra
    facet_tets = np.full((len(facets), 2), -1)
    facet_tets[:, 0] = first // 4
    others = np.setdiff1d(np.arange(len(wound)), first)
    facet_tets[tet_facets[others], 1] = others // 4
    tet_facets = tet_facets.reshape(-1, 4)
    lines, facet_lines = _unique_rows(facets[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    facet_lines = facet_lines.reshape(-1, 3)
    f = len(facets)

    meet = _candidates(vertices, faces, lattice, tetrahedra)
    sf_face, sf_facet = _pairs(np.repeat(meet[:, 0], 4), tet_facets[meet[:, 1]].ravel(), f)
    # Surface edges through facets, lattice edges through faces.
    e, g = _pairs(face_edges[sf_face].ravel(), np.repeat(sf_facet, 3), f)
    hit = _pierces(both, edges[e], facets[g])
    e, g = e[hit], g[hit]
    _, edge_points = _crossing(both, edges[e], facets[g])
    edge_keys = e * f + g
    line, face = _pairs(facet_lines[sf_facet].ravel(), np.repeat(sf_face, 3), s)
    hit = _pierces(both, lines[line], faces[face])
    line, face = line[hit], face[hit]
    line_t, line_points = _crossing(both, lines[line], faces[face])
    line_keys = line * s + face
    base_edge, base_line = v, v + len(e)
    base_point = base_line + len(line)
    points = np.vstack([vertices, edge_points, line_points, lattice])

    # Where a face crosses a facet: the two of the six possible events that happened.
    events = np.concatenate(
        [
            _find(edge_keys, face_edges[sf_face] * f + sf_facet[:, None]) + base_edge,
            np.where(
                (piercing := _find(line_keys, facet_lines[sf_facet] * s + sf_face[:, None])) < 0,
                base_edge - 1,
                piercing + base_line,
            ),
        ],
        axis=1,
    )
    happened = events >= base_edge
    count = happened.sum(axis=1)
    if not np.isin(count, (0, 2)).all():
        raise DegenerateCut("a face and a lattice facet meet in one point")
    crossed = count == 2
    segment = events[crossed][happened[crossed]].reshape(-1, 2)
    segment_face, segment_facet = sf_face[crossed], sf_facet[crossed]

    outer, outer_tet, outer_face = _face_polygons(
        both, faces, facets, facet_tets, tet_facets, meet, segment, segment_face, segment_facet, points
    )
    inside = _lattice_inside(len(lattice), lines - v, line)
    stretches = _stretches(lines - v, line, line_t, inside, base_line, base_point)
    inner, inner_facet = _facet_polygons(
        points, both, faces, facets, facet_lines, lines, segment, segment_face, segment_facet, stretches
    )
    triangles = np.vstack([outer, inner])
    tets = np.vstack([np.stack([outer_tet, np.full(len(outer), -1)], 1), facet_tets[inner_facet]])
    if (tets[:, 0] < 0).any() or (tets[len(outer) :] < 0).any():
        raise DegenerateCut("the lattice does not cover the body")
    sides = _connected_cells(triangles, tets)
    used = np.unique(triangles)
    used = np.union1d(np.arange(v), used)
    rank = np.full(len(points), -1)
    rank[used] = np.arange(len(used))
    source = np.concatenate([outer_face, np.full(len(inner), -1)])
    solid = measure_cells(points[used], rank[triangles], sides, source)
    volume = surface.trimesh.volume
    if (solid.volumes <= 0).any() or abs(solid.volumes.sum() - volume) > 1e-9 * volume:
        raise DegenerateCut(f"cells add up to {solid.volumes.sum():.12g}, the body has {volume:.12g}")
    return solid


def _face_polygons(
    both: FloatArray,
    faces: IntArray,
    facets: IntArray,
    facet_tets: IntArray,
    tet_facets: IntArray,
    meet: IntArray,
    segment: IntArray,
    segment_face: IntArray,
    segment_facet: IntArray,
    points: FloatArray,
) -> tuple[IntArray, IntArray, IntArray]:
    """Triangulate the input faces inside each tetrahedron: (N, 3), their tetrahedra and input faces."""
    t = len(tet_facets)
    # The tetrahedron that holds each surface vertex.
    vertex, tet = _pairs(faces[meet[:, 0]].ravel(), np.repeat(meet[:, 1], 3), t)
    holds = np.ones(len(vertex), dtype=bool)
    for k in range(4):
        facet = tet_facets[tet, k]
        before = _orient(both, *facets[facet].T, vertex) > 0
        holds &= before != (facet_tets[facet, 0] == tet)
    vertex, tet = vertex[holds], tet[holds]
    if not np.array_equal(vertex, np.unique(faces)):
        raise DegenerateCut("a surface vertex lies in no tetrahedron, or in two")
    home = np.full(len(both), -1)
    home[vertex] = tet
    corner = [(faces[:, k], home[faces[:, k]], np.arange(len(faces))) for k in range(3)]
    ends = [(segment[:, k], facet_tets[segment_facet, side], segment_face) for k in (0, 1) for side in (0, 1)]
    ids, tets, face = (np.concatenate(column) for column in zip(*corner, *ends, strict=True))
    known = tets >= 0
    polygon_keys, polygon = np.unique(face[known] * t + tets[known], return_inverse=True)
    rows = np.unique(np.stack([polygon, ids[known]], axis=1), axis=0)
    polygon, ids = rows.T
    face, tets = polygon_keys // t, polygon_keys % t
    size = np.bincount(polygon)
    if size.min() < 3:
        raise DegenerateCut("a face meets a tetrahedron in less than a polygon")
    # Convex, so the order of its corners is their order by angle about their mean.
    corners = both[faces]
    across = corners[:, 1] - corners[:, 0]
    normal = np.cross(across, corners[:, 2] - corners[:, 0])
    up = np.cross(normal, across)
    across /= np.linalg.norm(across, axis=1)[:, None]
    up /= np.linalg.norm(up, axis=1)[:, None]
    mean = sum_by_index(polygon, points[ids], len(size)) / size[:, None]
    arm = points[ids] - mean[polygon]
    angle = np.arctan2(np.einsum("ij,ij->i", arm, up[face[polygon]]), np.einsum("ij,ij->i", arm, across[face[polygon]]))
    ids = ids[np.lexsort((angle, polygon))]
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    fan = np.repeat(np.arange(len(size)), size - 2)
    step = np.arange(len(fan)) - np.repeat(np.concatenate([[0], np.cumsum(size - 2)[:-1]]), size - 2)
    triangles = np.stack([ids[start[fan]], ids[start[fan] + step + 1], ids[start[fan] + step + 2]], axis=1)
    return triangles, tets[fan], face[fan]


def _lattice_inside(count: int, lines: IntArray, pierced: IntArray) -> npt.NDArray[np.bool_]:
    """Decide which lattice points lie inside: every passage through the surface changes sides."""
    odd = np.bincount(pierced, minlength=len(lines)) % 2 == 1
    graph = coo_matrix((np.ones(len(lines)), (lines[:, 0], lines[:, 1])), shape=(count, count)).tocsr()
    # The first line's first point is on the lattice's rim, hence outside.
    order, before = breadth_first_order(graph, lines[0, 0], directed=False)
    step = np.sort(np.stack([order[1:], before[order[1:]]], axis=1), axis=1)
    changes = odd[_find(lines[:, 0] * count + lines[:, 1], step[:, 0] * count + step[:, 1])]
    inside = np.zeros(count, dtype=bool)
    for point, previous, change in zip(order[1:], before[order[1:]], changes, strict=True):
        inside[point] = inside[previous] != change
    if not np.array_equal(inside[lines[:, 0]] != inside[lines[:, 1]], odd):
        raise DegenerateCut("inside and outside contradict each other")
    return inside


def _stretches(
    lines: IntArray,
    pierced: IntArray,
    t: FloatArray,
    inside: npt.NDArray[np.bool_],
    base_line: int,
    base_point: int,
) -> IntArray:
    """List the parts of lattice edges that run inside the body: rows (edge, from, to), along the edge."""
    low, high = (np.flatnonzero(inside[lines[:, k]]) for k in (0, 1))
    line = np.concatenate([pierced, low, high])
    where = np.concatenate([t, np.full(len(low), -1.0), np.full(len(high), 2.0)])
    ids = np.concatenate(
        [
            base_line + np.arange(len(pierced)),
            base_point + lines[low, 0],
            base_point + lines[high, 1],
        ]
    )
    order = np.lexsort((where, line))
    ends = ids[order].reshape(-1, 2)
    return np.column_stack([line[order].reshape(-1, 2)[:, 0], ends])


def _facet_polygons(
    points: FloatArray,
    both: FloatArray,
    faces: IntArray,
    facets: IntArray,
    facet_lines: IntArray,
    lines: IntArray,
    segment: IntArray,
    segment_face: IntArray,
    segment_facet: IntArray,
    stretches: IntArray,
) -> tuple[IntArray, IntArray]:
    """Triangulate the facets' parts inside the body, wound as the facets: (N, 3) and their facets."""

    def normals(triangles: FloatArray) -> FloatArray:
        """Return normals of any length."""
        return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])

    facet_normal = normals(both[facets])
    # With the facet's normal upward, the body lies to the left of (facet normal) x (face normal).
    along = np.cross(facet_normal[segment_facet], normals(both[faces])[segment_face])
    forward = np.einsum("ij,ij->i", points[segment[:, 1]] - points[segment[:, 0]], along) > 0
    directed = [np.column_stack([segment_facet, np.where(forward[:, None], segment, segment[:, ::-1])])]
    order = np.argsort(facet_lines.ravel(), kind="stable")
    flat = facet_lines.ravel()[order]
    low, high = (np.searchsorted(flat, stretches[:, 0], side=side) for side in ("left", "right"))
    repeat = np.repeat(np.arange(len(stretches)), high - low)
    offset = np.arange(len(repeat)) - np.repeat(np.concatenate([[0], np.cumsum(high - low)[:-1]]), high - low)
    slot = order[low[repeat] + offset]
    facet, k = slot // 3, slot % 3
    same = facets[facet, k] == lines[stretches[repeat, 0], 0]
    ends = stretches[repeat, 1:]
    directed.append(np.column_stack([facet, np.where(same[:, None], ends, ends[:, ::-1])]))
    arrows = np.vstack(directed)
    arrows = arrows[np.lexsort((arrows[:, 1], arrows[:, 0]))]
    into = arrows[np.lexsort((arrows[:, 2], arrows[:, 0]))]
    if not np.array_equal(arrows[:, :2], into[:, [0, 2]]) or ((arrows[1:, :2] == arrows[:-1, :2]).all(axis=1).any()):
        raise DegenerateCut("the surface's trace on a lattice facet is not a set of loops")
    starts = np.flatnonzero(np.r_[True, arrows[1:, 0] != arrows[:-1, 0]])
    sizes = np.diff(np.r_[starts, len(arrows)])
    three = starts[sizes == 3]
    a = arrows[three, 1]
    b = arrows[three, 2]
    c = np.where(arrows[three + 1, 1] == b, arrows[three + 1, 2], arrows[three + 2, 2])
    triangles = [np.stack([a, b, c], axis=1)]
    owner = [arrows[three, 0]]
    for start, size in zip(starts[sizes > 3], sizes[sizes > 3], strict=True):
        block = arrows[start : start + size]
        facet_id = block[0, 0]
        cut = triangulate_polygon(points, block[:, 1], block[:, 2], both[facets[facet_id]])
        triangles.append(cut)
        owner.append(np.full(len(cut), facet_id))
    return np.vstack(triangles), np.concatenate(owner)


def _connected_cells(triangles: IntArray, tets: IntArray) -> IntArray:
    """Label the cells on both sides of each triangle: connected closed shells within one tetrahedron."""
    rows, side = np.nonzero(tets >= 0)
    node_tet = tets[rows, side]
    ends = np.sort(triangles[rows][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.column_stack([np.repeat(node_tet, 3), ends])
    order = np.lexsort(keys.T)
    ordered = keys[order]
    if len(order) % 2 or not (ordered[::2] == ordered[1::2]).all():
        raise DegenerateCut("a cell is not closed")
    if (ordered[1:-1:2] == ordered[2::2]).all(axis=1).any():
        raise DegenerateCut("a cell touches itself along an edge")
    left, right = order[::2] // 3, order[1::2] // 3
    graph = coo_matrix((np.ones(len(left)), (left, right)), shape=(len(rows), len(rows)))
    _, shell = connected_components(graph, directed=False)
    sides = np.full(tets.shape, -1)
    sides[rows, side] = shell
    return sides


def measure_cells(points: FloatArray, triangles: IntArray, sides: IntArray, source: IntArray) -> Solid:
    """Measure the cells of a complex.

    Parameters
    ----------
    points, triangles, sides, source : ndarray
        As of ``Solid``.

    Returns
    -------
    Solid
        With volumes and centroids by the divergence theorem, each cell's about its own first point.
    """
    cells = int(sides.max()) + 1
    origin = np.zeros((cells, 3))
    for side in (1, 0):
        bounded = sides[:, side] >= 0
        origin[sides[bounded, side]] = points[triangles[bounded, 0]]
    volumes = np.zeros(cells)
    moments = np.zeros((cells, 3))
    for side, sign in ((0, 1.0), (1, -1.0)):
        rows = np.flatnonzero(sides[:, side] >= 0)
        cell = sides[rows, side]
        a, b, c = np.moveaxis(points[triangles[rows]] - origin[cell, None], 1, 0)
        weight = sign * np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
        volumes += sum_by_index(cell, weight, cells)
        moments += sum_by_index(cell, weight[:, None] * (a + b + c) / 4, cells)
    centroids = origin + moments / np.where(volumes > 0, volumes, 1.0)[:, None]
    return Solid(points, triangles, sides, source, volumes, centroids)


def join_slivers(solid: Solid) -> Solid:
    """Join cells that are much smaller than a whole tetrahedron to a neighbour.

    Parameters
    ----------
    solid : Solid
        As ``cut_once`` made it.

    Returns
    -------
    Solid
        No cell has less than SLIVER of the volume that nine in ten cells do not exceed.
    """
    pairs, areas, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    floor = SLIVER * float(np.quantile(solid.volumes, 0.9))
    return relabel(solid, merge_small_regions(solid.volumes, pairs, areas, floor))
