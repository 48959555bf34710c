"""The solid: a jittered tetrahedral lattice cut, exactly and conformingly, by the input surface.

Cutting the lattice with the surface itself, rather than meshing a cage around it, gives cells whose volumes,
shared areas and outer faces are those of the real body however thin its walls are: every later question
(which piece is this vertex in, where does the crack meet the surface) has an exact answer. Offline only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .errors import BakeError, MissingExtraError
from .mesh import Surface
from .pieces import vertex_cells

try:
    import manifold3d
except ImportError as error:
    raise MissingExtraError("manifold3d", "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# Facet k of a tetrahedron lies opposite its vertex k and is wound outward.
FACETS = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
JITTER = 0.15  # of the lattice spacing: enough to hide the lattice's favourite directions, too little to fold it
TILT = 0.2  # rad; against the body's own axes, so that no facet is parallel to a flat side
TRIES = 8  # lattices tried before a surface is called impossible; one is enough for any that we have met
SLIVER = 0.1  # of a whole tetrahedron; smaller cells are joined to the neighbour they share most area with


@dataclass(frozen=True, eq=False)
class Solid:
    """A body as a conforming complex of cells: each a connected part of one tetrahedron, or several joined.

    points: (P, 3); the first V are the surface's vertices, in order.
    triangles: (M, 3) into points. sides: (M, 2), the cells behind and before each triangle, -1 outside;
    the normal points from the first to the second, so outer triangles face outward.
    source: (M,) the input face that an outer triangle is a part of, -1 for inner triangles.
    volumes: (C,); they add up to the body's. centroids: (C, 3).
    """

    points: FloatArray
    triangles: IntArray
    sides: IntArray
    source: IntArray
    volumes: FloatArray
    centroids: FloatArray


class _DegenerateError(Exception):
    """The lattice met the surface in a position that rounding cannot decide; another lattice will not."""


def body_centred_lattice(counts: IntArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """A body-centred cubic lattice of ``counts`` cells and its tetrahedra, four around every inner cube face.

    Returns points (P, 3) and tetrahedra (T, 4), positively oriented (Labelle and Shewchuk 2007, section 2).
    """

    def grid(shape: IntArray) -> IntArray:
        return np.stack(np.meshgrid(*[np.arange(k) for k in shape], indexing="ij"), -1).reshape(-1, 3)

    corners, bodies = grid(counts + 1), grid(counts)
    points = np.vstack([corners, bodies + 0.5]) * spacing
    blocks = []
    for axis in np.eye(3, dtype=np.int64):
        first, second = np.roll(axis, 1), np.roll(axis, 2)
        cubes = grid(counts - axis)
        corner = cubes + axis
        ring = [
            np.ravel_multi_index(tuple((corner + step).T), tuple(counts + 1))
            for step in (0 * axis, first, first + second, second)
        ]
        low = len(corners) + np.ravel_multi_index(tuple(cubes.T), tuple(counts))
        high = len(corners) + np.ravel_multi_index(tuple((cubes + axis).T), tuple(counts))
        blocks += [np.stack([low, high, ring[k], ring[(k + 1) % 4]], axis=1) for k in range(4)]
    return points, np.vstack(blocks)


def lattice_spacing(volume: float, area: float, cells: int) -> float:
    """Spacing a at which about ``cells`` tetrahedra meet a body: cells = 12 V/a³ + 6 A/a².

    A tetrahedron has volume a³/12; the second term is the layer that the surface passes through.
    """
    roots = np.roots([cells, 0.0, -6.0 * area, -12.0 * volume])
    return float(roots[np.isreal(roots) & (roots.real > 0)].real.max())


def cut_lattice(surface: Surface, cells: int, rng: np.random.Generator) -> Solid:
    """Cut a jittered lattice of about ``cells`` tetrahedra with ``surface``.

    A tetrahedron that the surface leaves in several parts gives several cells, so two walls closer than the
    spacing stay apart. Raises BakeError if no lattice gives cells that add up to the body.
    """
    fault = ""
    for _ in range(TRIES):
        try:
            return _join_slivers(_cut(surface, *_lattice(surface, cells, rng)))
        except _DegenerateError as error:
            fault = str(error)
    raise BakeError(
        f"{surface.name}: cannot be cut into cells ({fault}); the surface probably runs through itself: "
        "repair it before baking"
    )


def _lattice(surface: Surface, cells: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    mesh = surface.trimesh
    spacing = lattice_spacing(mesh.volume, mesh.area, cells)
    axes = mesh.bounding_box_oriented.primitive.transform[:3, :3]
    tilt = rng.standard_normal(3)
    turn = Rotation.from_rotvec(TILT * tilt / np.linalg.norm(tilt)).as_matrix() @ axes.T
    turned = surface.vertices @ turn.T
    low = turned.min(axis=0) - rng.uniform(1.5, 2.0, 3) * spacing
    counts = np.ceil((turned.max(axis=0) + 1.5 * spacing - low) / spacing).astype(np.int64)
    points, tetrahedra = body_centred_lattice(counts, spacing)
    return (points + low + rng.uniform(-JITTER, JITTER, points.shape) * spacing) @ turn, tetrahedra


def _unique_rows(rows: IntArray) -> tuple[IntArray, IntArray]:
    """Rows sorted within themselves, made unique, and the index of each: ``sort(rows) == unique[inverse]``."""
    ordered = np.sort(rows, axis=1)
    unique, inverse = np.unique(ordered, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)


def _orient(points: FloatArray, *corners: IntArray) -> FloatArray:
    """Six times the signed volume of tetrahedra, positive when the fourth point is before the first three.

    Evaluated with the indices in ascending order whatever the caller's, so that every question about the
    same four points gets the same answer up to sign: that consistency is what keeps the complex closed.
    """
    quad = np.stack(corners, axis=1)
    swaps = sum((quad[:, i] > quad[:, j]).astype(np.int64) for i in range(4) for j in range(i + 1, 4))
    a, b, c, d = np.moveaxis(points[np.sort(quad, axis=1)], 1, 0)
    value = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)
    return np.where(swaps % 2 == 0, value, -value)


def _pierces(points: FloatArray, segment: IntArray, triangle: IntArray) -> npt.NDArray[np.bool_]:
    p, q = segment.T
    a, b, c = triangle.T
    opposite = (_orient(points, a, b, c, p) > 0) != (_orient(points, a, b, c, q) > 0)
    ab, bc, ca = (_orient(points, p, q, x, y) > 0 for x, y in ((a, b), (b, c), (c, a)))
    return opposite & (ab == bc) & (bc == ca)


def _crossing(points: FloatArray, segment: IntArray, triangle: IntArray) -> tuple[FloatArray, FloatArray]:
    """Where segments meet triangles' planes: parameters (N,) along the segment and points (N, 3)."""
    p, q = segment.T
    a, b, c = triangle.T
    first, second = _orient(points, a, b, c, p), _orient(points, a, b, c, q)
    t = first / (first - second)
    return t, points[p] + t[:, None] * (points[q] - points[p])


def _candidates(vertices: FloatArray, faces: IntArray, points: FloatArray, tetrahedra: IntArray) -> IntArray:
    """Pairs (surface face, tetrahedron) that may meet."""
    triangles, tets = vertices[faces], points[tetrahedra]
    middle, centre = triangles.mean(axis=1), tets.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    radius = np.linalg.norm(tets - centre[:, None], axis=2).max()
    near = cKDTree(centre).query_ball_point(middle, reach + radius, return_sorted=True)
    face = np.repeat(np.arange(len(faces)), [len(row) for row in near])
    tet = np.concatenate([np.asarray(row, dtype=np.int64) for row in near])
    # A box that misses, or a tetrahedron wholly on one side of the face's plane, cannot meet.
    overlap = (triangles.min(axis=1)[face] <= tets.max(axis=1)[tet]).all(axis=1)
    overlap &= (triangles.max(axis=1)[face] >= tets.min(axis=1)[tet]).all(axis=1)
    face, tet = face[overlap], tet[overlap]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    height = np.einsum("nij,nj->ni", tets[tet] - triangles[face, None, 0], normal[face])
    cut = (height.max(axis=1) >= 0) & (height.min(axis=1) <= 0)
    return np.stack([face[cut], tet[cut]], axis=1)


def _pairs(left: IntArray, right: IntArray, width: int) -> tuple[IntArray, IntArray]:
    """Unique pairs of the two arrays, ordered by ``left * width + right``."""
    keys = np.unique(left.astype(np.int64) * width + right)
    return keys // width, keys % width


def _find(keys: IntArray, wanted: IntArray) -> IntArray:
    """Positions of ``wanted`` in the sorted ``keys``, -1 where absent."""
    if len(keys) == 0:
        return np.full(wanted.shape, -1)
    position = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
    return np.where(keys[position] == wanted, position, -1)


def _cut(surface: Surface, lattice: FloatArray, tetrahedra: IntArray) -> Solid:
    """The arrangement of the surface and the lattice inside the body.

    Its vertices are surface vertices, surface edges through lattice facets, lattice edges through surface
    faces, and lattice points inside. A face and a tetrahedron meet in a convex polygon; a facet and the body
    meet in polygons bounded by where faces cross it and by the inner stretches of its edges.
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
                (found := _find(line_keys, facet_lines[sf_facet] * s + sf_face[:, None])) < 0,
                base_edge - 1,
                found + base_line,
            ),
        ],
        axis=1,
    )
    happened = events >= base_edge
    count = happened.sum(axis=1)
    if not np.isin(count, (0, 2)).all():
        raise _DegenerateError("a face and a lattice facet meet in one point")
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
        raise _DegenerateError("the lattice does not cover the body")
    sides = _cells(triangles, tets)
    used = np.unique(triangles)
    used = np.union1d(np.arange(v), used)
    rank = np.full(len(points), -1)
    rank[used] = np.arange(len(used))
    source = np.concatenate([outer_face, np.full(len(inner), -1)])
    solid = _measure(points[used], rank[triangles], sides, source)
    volume = surface.trimesh.volume
    if (solid.volumes <= 0).any() or abs(solid.volumes.sum() - volume) > 1e-9 * volume:
        raise _DegenerateError(f"cells add up to {solid.volumes.sum():.12g}, the body has {volume:.12g}")
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
    """Triangles of the input faces inside each tetrahedron: (N, 3), their tetrahedra and input faces."""
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
        raise _DegenerateError("a surface vertex lies in no tetrahedron, or in two")
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
        raise _DegenerateError("a face meets a tetrahedron in less than a polygon")
    # Convex, so the order of its corners is their order by angle about their mean.
    corners = both[faces]
    across = corners[:, 1] - corners[:, 0]
    normal = np.cross(across, corners[:, 2] - corners[:, 0])
    up = np.cross(normal, across)
    across /= np.linalg.norm(across, axis=1)[:, None]
    up /= np.linalg.norm(up, axis=1)[:, None]
    mean = sums(polygon, points[ids], len(size)) / size[:, None]
    arm = points[ids] - mean[polygon]
    angle = np.arctan2(np.einsum("ij,ij->i", arm, up[face[polygon]]), np.einsum("ij,ij->i", arm, across[face[polygon]]))
    ids = ids[np.lexsort((angle, polygon))]
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    fan = np.repeat(np.arange(len(size)), size - 2)
    step = np.arange(len(fan)) - np.repeat(np.concatenate([[0], np.cumsum(size - 2)[:-1]]), size - 2)
    triangles = np.stack([ids[start[fan]], ids[start[fan] + step + 1], ids[start[fan] + step + 2]], axis=1)
    return triangles, tets[fan], face[fan]


def _lattice_inside(count: int, lines: IntArray, pierced: IntArray) -> npt.NDArray[np.bool_]:
    """Which lattice points lie inside: every passage through the surface changes sides."""
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
        raise _DegenerateError("inside and outside contradict each other")
    return inside


def _stretches(
    lines: IntArray,
    pierced: IntArray,
    t: FloatArray,
    inside: npt.NDArray[np.bool_],
    base_line: int,
    base_point: int,
) -> IntArray:
    """The parts of lattice edges that run inside the body: rows (edge, from, to), along the edge."""
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
    """Triangles of the facets' parts inside the body, wound as the facets: (N, 3) and their facets."""

    def normals(triangles: FloatArray) -> FloatArray:
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
        raise _DegenerateError("the surface's trace on a lattice facet is not a set of loops")
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
        cut = _triangulate(points, block[:, 1], block[:, 2], both[facets[facet_id]])
        triangles.append(cut)
        owner.append(np.full(len(cut), facet_id))
    return np.vstack(triangles), np.concatenate(owner)


def _cells(triangles: IntArray, tets: IntArray) -> IntArray:
    """The cells on both sides of each triangle: connected closed shells within one tetrahedron."""
    rows, side = np.nonzero(tets >= 0)
    node_tet = tets[rows, side]
    ends = np.sort(triangles[rows][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.column_stack([np.repeat(node_tet, 3), ends])
    order = np.lexsort(keys.T)
    ordered = keys[order]
    if len(order) % 2 or not (ordered[::2] == ordered[1::2]).all():
        raise _DegenerateError("a cell is not closed")
    if (ordered[1:-1:2] == ordered[2::2]).all(axis=1).any():
        raise _DegenerateError("a cell touches itself along an edge")
    left, right = order[::2] // 3, order[1::2] // 3
    graph = coo_matrix((np.ones(len(left)), (left, right)), shape=(len(rows), len(rows)))
    _, shell = connected_components(graph, directed=False)
    sides = np.full(tets.shape, -1)
    sides[rows, side] = shell
    return sides


def _measure(points: FloatArray, triangles: IntArray, sides: IntArray, source: IntArray) -> Solid:
    """Volumes and centroids of the cells, each by the divergence theorem about its own first point."""
    cells = int(sides.max()) + 1
    origin = np.zeros((cells, 3))
    for side in (1, 0):
        there = sides[:, side] >= 0
        origin[sides[there, side]] = points[triangles[there, 0]]
    volumes = np.zeros(cells)
    moments = np.zeros((cells, 3))
    for side, sign in ((0, 1.0), (1, -1.0)):
        rows = np.flatnonzero(sides[:, side] >= 0)
        cell = sides[rows, side]
        a, b, c = np.moveaxis(points[triangles[rows]] - origin[cell, None], 1, 0)
        weight = sign * np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
        volumes += sums(cell, weight, cells)
        moments += sums(cell, weight[:, None] * (a + b + c) / 4, cells)
    centroids = origin + moments / np.where(volumes > 0, volumes, 1.0)[:, None]
    return Solid(points, triangles, sides, source, volumes, centroids)


def shared_faces(triangles: IntArray, sides: IntArray, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """What neighbouring regions share: pairs (I, 2) with first < second, areas (I,), and the vector areas
    (I, 3) that point from the first to the second."""
    inner = (sides >= 0).all(axis=1) & (sides[:, 0] != sides[:, 1])
    corner = points[triangles[inner]]
    vector = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    pairs = np.sort(sides[inner], axis=1)
    vector = np.where((sides[inner, 0] == pairs[:, 0])[:, None], vector, -vector)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    count = len(unique)
    return unique, sums(inverse, np.linalg.norm(vector, axis=1), count), sums(inverse, vector, count)


def sums(index: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Rows of ``values`` (N,) or (N, k) added up by their ``index`` (N,): (count,) or (count, k)."""
    if values.ndim == 1:
        return np.asarray(np.bincount(index, values, minlength=count), dtype=np.float64)
    return np.stack([np.bincount(index, column, minlength=count) for column in values.T], axis=1)


def join_small(
    volumes: FloatArray, pairs: IntArray, bond: FloatArray, floor: float, label: IntArray | None = None
) -> IntArray:
    """Join every region smaller than ``floor`` to the neighbour it is most strongly bound to, until none is.

    volumes: (C,). pairs: (I, 2) neighbours. bond: (I,), the strength. label: (C,), the regions to begin with, from 0;
    each by itself by default. Returns (C,) the region each is now in.
    """
    label = np.arange(len(volumes)) if label is None else label
    while True:
        count = int(label.max()) + 1
        total = np.bincount(label, volumes, minlength=count)
        ends = label[pairs]
        between = ends[:, 0] != ends[:, 1]
        if not (total < floor).any() or not between.any():
            return label
        # One at a time, the smallest first: what it joins may no longer be small.
        joint, inverse = np.unique(np.sort(ends[between], axis=1), axis=0, return_inverse=True)
        weight = np.bincount(inverse.reshape(-1), bond[between])
        small = np.argsort(total, kind="stable")
        small = small[total[small] < floor]
        moved = np.zeros(count, dtype=bool)
        target = np.arange(count)
        best: dict[int, tuple[float, int]] = {}
        for (a, b), w in zip(joint.tolist(), weight.tolist(), strict=True):
            for x, y in ((a, b), (b, a)):
                if x not in best or (w, -y) > (best[x][0], -best[x][1]):
                    best[x] = (w, y)
        for region in small.tolist():
            if region in best and not moved[region] and not moved[best[region][1]]:
                target[region] = best[region][1]
                moved[[region, best[region][1]]] = True
        if not moved.any():
            return label
        _, label = np.unique(target[label], return_inverse=True)


def relabel(solid: Solid, label: IntArray) -> Solid:
    """The solid with cells joined by ``label`` and the triangles between joined cells dropped."""
    sides = np.where(solid.sides >= 0, label[solid.sides], -1)
    keep = sides[:, 0] != sides[:, 1]
    count = int(label.max()) + 1
    volumes = sums(label, solid.volumes, count)
    centroids = sums(label, solid.volumes[:, None] * solid.centroids, count)
    return Solid(
        solid.points,
        solid.triangles[keep],
        sides[keep],
        solid.source[keep],
        volumes,
        centroids / volumes[:, None],
    )


def surface_parts(solid: Solid, count: int) -> IntArray:
    """(V,) the cell that each of the surface's ``count`` vertices lies on."""
    return vertex_cells(solid.triangles, solid.sides, len(solid.points))[:count]


def _join_slivers(solid: Solid) -> Solid:
    pairs, areas, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    floor = SLIVER * float(np.quantile(solid.volumes, 0.9))
    return relabel(solid, join_small(solid.volumes, pairs, areas, floor))


def _loops(points: FloatArray, start: IntArray, end: IntArray, frame: FloatArray) -> list[list[int]]:
    """Closed loops of directed planar edges with the region to their left; regions touching in a point part."""
    ways: dict[int, list[int]] = {}
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        ways.setdefault(a, []).append(b)
    # Where the region touches itself, the way on is the first one clockwise from the way back: it bounds the
    # same wedge of the region.
    after: dict[tuple[int, int], int] = {}
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        choices = ways[b]
        if len(choices) > 1:
            arms = (points[[a, *choices]] - points[b]) @ frame
            angle = np.arctan2(arms[:, 1], arms[:, 0])
            choices = [choices[int(np.argmin((angle[0] - angle[1:]) % (2 * np.pi)))]]
        after[a, b] = choices[0]
    loops = []
    while after:
        edge = next(iter(after))
        loop = []
        while edge in after:
            loop.append(edge[1])
            edge = edge[1], after.pop(edge)
        loops.append(loop)
    return loops


def _triangulate(
    points: FloatArray,
    start: IntArray,
    end: IntArray,
    triangle: FloatArray,
    needed: npt.NDArray[np.bool_] | None = None,
) -> IntArray:
    """Triangles (N, 3) over the planar region to the left of the directed edges, wound like ``triangle`` (3, 3).

    ``needed`` drops points from the rim that lie on straight stretches of it.
    """
    across = triangle[1] - triangle[0]
    up = np.cross(np.cross(across, triangle[2] - triangle[0]), across)
    frame = np.stack([across / np.linalg.norm(across), up / np.linalg.norm(up)], axis=1)
    loops = [
        loop if needed is None else [point for point in loop if needed[point]]
        for loop in _loops(points, start, end, frame)
    ]
    if len(loops) == 1 and len(loops[0]) == 3:
        return np.array(loops)
    flat = [(points[loop] - triangle[0]) @ frame for loop in loops]
    return np.concatenate(loops)[np.asarray(manifold3d.triangulate(flat)).astype(np.int64)]


def coarsen(solid: Solid, surface: Surface) -> Solid:
    """Undo the lattice's marks on the outer faces wherever no inner triangle needs them.

    Each input face comes out as one polygon per cell it touches, triangulated anew; inner triangles stay, so
    the complex stays closed. Points that nothing uses any more go; the surface's vertices stay first.
    """
    inner = solid.source < 0
    needed = np.zeros(len(solid.points), dtype=bool)
    needed[: len(surface.vertices)] = True
    needed[solid.triangles[inner]] = True
    outer = solid.triangles[~inner]
    cells = len(solid.volumes)
    keys, group = np.unique(solid.source[~inner] * cells + solid.sides[~inner, 0], return_inverse=True)
    # A group's rim: its directed edges without the pairs that cancel inside it.
    start, end = outer.ravel(), outer[:, [1, 2, 0]].ravel()
    owner = np.repeat(group.reshape(-1), 3)
    edge = np.column_stack([np.maximum(start, end), np.minimum(start, end), owner])
    order = np.lexsort(edge.T)
    same = (edge[order][1:] == edge[order][:-1]).all(axis=1)
    rim = np.ones(len(start), dtype=bool)
    rim[order[1:][same]] = rim[order[:-1][same]] = False
    start, end, owner = start[rim], end[rim], owner[rim]
    order = np.argsort(owner, kind="stable")
    start, end = start[order], end[order]
    cuts = np.searchsorted(owner[order], np.arange(len(keys) + 1))
    blocks = []
    for key, low, high in zip(keys.tolist(), cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        corners = surface.vertices[surface.faces[key // cells]]
        blocks.append(_triangulate(solid.points, start[low:high], end[low:high], corners, needed))
    repeat = np.repeat(keys, [len(block) for block in blocks])
    triangles = np.vstack([*blocks, solid.triangles[inner]])
    sides = np.vstack([np.column_stack([repeat % cells, np.full(len(repeat), -1)]), solid.sides[inner]])
    source = np.concatenate([repeat // cells, solid.source[inner]])
    rank = np.cumsum(needed) - 1
    return Solid(solid.points[needed], rank[triangles], sides, source, solid.volumes, solid.centroids)
