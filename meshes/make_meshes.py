"""Make the example meshes: ``python meshes/make_meshes.py [bunny chair vase] [--out DIR]``.

Each mesh is one closed, outward-oriented surface of even triangles, stands along +z, is centred on its
bounding box and has a largest extent of exactly 1. The bunny is the 453-vertex one that
``pybullet_data`` carries, smoothed by Loop subdivision; the chair is a boolean union of convex parts whose
edges stay sharp; the vase is a thin-walled surface of revolution.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pybullet_data
import trimesh
from manifold3d import Error, Manifold, Mesh64, OpType
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Surface = tuple[Floats, Ints]


# --------------------------------------------------------------------------------------------------------
# Isotropic remeshing (Botsch and Kobbelt 2004): split long edges, collapse short ones, flip to Delaunay,
# smooth within the surface. A vertex may only move in the directions that leave all its face planes
# unchanged, so a polyhedron keeps its creases and corners exactly, without a list of them.


def _edges(faces: Ints) -> tuple[Ints, ...]:
    """List edges (a, b) of a closed surface, their faces f = (a, b, c) and g = (b, a, d), as a, b, c, d, f, g."""
    a, b, c = (np.roll(faces, -k, axis=1).ravel() for k in range(3))
    order = np.lexsort((a, np.maximum(a, b), np.minimum(a, b)))
    one, two = order[::2], order[1::2]
    return a[one], b[one], c[one], c[two], one // 3, two // 3


def _normals(vertices: Floats, faces: Ints) -> Floats:
    """Compute the faces' unit normals."""
    p, q, r = (vertices[faces[..., k]] for k in range(3))
    n = np.cross(q - p, r - p)
    unit: Floats = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-300)
    return unit


def _free(vertices: Floats, faces: Ints, sharp: bool) -> Floats:
    """Find each vertex's projector (3, 3) onto the directions it may move in: plane, crease line or nothing."""
    n = _normals(vertices, faces)
    tensor = np.zeros((len(vertices), 3, 3))
    for k in range(3):
        np.add.at(tensor, faces[:, k], n[:, :, None] * n[:, None, :])
    values, vectors = np.linalg.eigh(tensor)
    if sharp:
        free = values < 1e-3 * values.sum(axis=1, keepdims=True)
    else:  # only the main normal is held
        free = np.tile([True, True, False], (len(values), 1))
    projector: Floats = np.einsum("nik,nk,njk->nij", vectors, free.astype(float), vectors)
    return projector


def _independent(rows: Ints, priority: Floats) -> Ints:
    """Choose rows that share no entry, greedily by falling priority; return their indices."""
    used: set[int] = set()
    kept = []
    for i in np.argsort(-priority.round(9), kind="stable"):
        row = rows[i].tolist()
        if used.isdisjoint(row):
            used.update(row)
            kept.append(i)
    return np.array(kept, dtype=np.int64)


def _split(vertices: Floats, faces: Ints, longest: float) -> Surface:
    """Split edges that are too long at their middle, the longest first."""
    while True:
        edges = np.stack(_edges(faces))
        length = np.linalg.norm(vertices[edges[0]] - vertices[edges[1]], axis=1)
        edges, length = edges[:, length > longest], length[length > longest]
        if not len(length):
            return vertices, faces
        a, b, c, d, f, g = edges[:, _independent(edges[4:].T, length)]
        m = len(vertices) + np.arange(len(a))
        vertices = np.concatenate([vertices, (vertices[a] + vertices[b]) / 2])
        faces = faces.copy()
        faces[f], faces[g] = np.stack([a, m, c], 1), np.stack([b, m, d], 1)
        faces = np.concatenate([faces, np.stack([m, b, c], 1), np.stack([m, a, d], 1)])


def _collapse(vertices: Floats, faces: Ints, shortest: float, longest: float, sharp: bool) -> Surface:
    """Collapse edges that are too short, where the surface keeps its shape and its topology."""
    # How far a vertex may leave the surface, as a share of the edge, and the smallest cosine that a face may turn by.
    flat, cosine = (1e-4, 0.999) if sharp else (0.7, 0.7)
    for _ in range(3):
        a, b = _edges(faces)[:2]
        a, b = np.concatenate([a, b]), np.concatenate([b, a])
        step = vertices[b] - vertices[a]
        length = np.linalg.norm(step, axis=1)
        moved = np.einsum("nij,nj->ni", _free(vertices, faces, sharp)[a], step)
        ok = np.flatnonzero((length < shortest) & (np.linalg.norm(step - moved, axis=1) < flat * length))
        corners = faces.ravel()
        by_vertex = np.argsort(corners, kind="stable")
        start = np.searchsorted(corners[by_vertex], np.arange(len(vertices) + 1))
        normals = _normals(vertices, faces)
        used: set[int] = set()
        target = np.arange(len(vertices))
        for i in ok[np.argsort(length[ok].round(9), kind="stable")]:
            u, v = int(a[i]), int(b[i])
            if u in used or v in used:
                continue
            around = by_vertex[start[u] : start[u + 1]] // 3
            ring = set(faces[around].ravel().tolist())
            ring_v = set(faces[by_vertex[start[v] : start[v + 1]] // 3].ravel().tolist())
            kept = around[(faces[around] != v).all(axis=1)]
            new = np.where(faces[kept] == u, v, faces[kept])
            if (
                len(ring & ring_v) == 4  # u, v and the two apexes: the link condition
                and np.linalg.norm(vertices[new] - vertices[v], axis=2).max() < longest
                and (np.einsum("ni,ni->n", _normals(vertices, new), normals[kept]) > cosine).all()
            ):
                target[u] = v
                used |= ring
        if not used:
            break
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        index, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[index], faces.reshape(-1, 3)
    return vertices, faces


def _flip(vertices: Floats, faces: Ints, sharp: bool) -> Ints:
    """Flip edges until the surface is Delaunay, where it keeps its shape."""
    cosine = 0.999 if sharp else 0.7  # the smallest that a face may turn by
    for _ in range(30):
        a, b, c, d, f, g = _edges(faces)
        left, right = vertices[[a, b]] - vertices[c], vertices[[a, b]] - vertices[d]
        # The edge is not Delaunay where its opposite angles sum to more than pi: sin(c + d) < 0.
        cos = [np.einsum("ni,ni->n", *s) for s in (left, right)]
        sin = [np.linalg.norm(np.cross(*s), axis=1) for s in (left, right)]
        excess = -np.sin(np.arctan2(sin[0], cos[0]) + np.arctan2(sin[1], cos[1]))
        pair = np.stack([np.stack([c, a, d], 1), np.stack([d, b, c], 1)])
        old = _normals(vertices, faces)
        new = _normals(vertices, pair)
        size = len(vertices)
        ok = (excess > 1e-4) & (np.einsum("ni,ni->n", old[f], old[g]) > cosine)
        ok &= (np.einsum("kni,ni->kn", new, old[f]) > cosine).all(axis=0)
        ok &= ~np.isin(np.minimum(c, d) * size + np.maximum(c, d), np.minimum(a, b) * size + np.maximum(a, b))
        ok = np.flatnonzero(ok)
        if not len(ok):
            break
        ok = ok[_independent(np.stack([a, b, c, d], 1)[ok], excess[ok])]
        faces = faces.copy()
        faces[f[ok]], faces[g[ok]] = pair[:, ok]
    return faces


def _smooth(vertices: Floats, faces: Ints, sharp: bool, project: Callable[[Floats], Floats]) -> Floats:
    """Take one step towards the neighbours' mean; a vertex whose faces would turn over stays where it was."""
    a, b = _edges(faces)[:2]
    total, count = np.zeros_like(vertices), np.bincount(np.concatenate([a, b]))
    np.add.at(total, a, vertices[b])
    np.add.at(total, b, vertices[a])
    step = np.einsum("nij,nj->ni", _free(vertices, faces, sharp), total / count[:, None] - vertices)
    new, normals = project(vertices + 0.7 * step).round(9), _normals(vertices, faces)
    while (bad := np.einsum("ni,ni->n", _normals(new, faces), normals) < 0.5).any():
        new[faces[bad]] = vertices[faces[bad]]
    return new


def remesh(
    vertices: Floats,
    faces: Ints,
    edge: float,
    sharp: bool,
    project: Callable[[Floats], Floats] = lambda points: points,
) -> Surface:
    """Remesh a closed surface to edges of about one length.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Of the surface.
    faces : ndarray of int64, shape (F, 3)
        Outward.
    edge : float
        The length, in the vertices' unit.
    sharp : bool
        Whether it is a polyhedron, whose creases and corners are kept.
    project : callable
        Moves points (N, 3) back onto a curved surface.

    Returns
    -------
    vertices, faces : ndarray
        Of the same shape.

    Notes
    -----
    Botsch and Kobbelt 2004, *A remeshing approach to multiresolution modeling*.
    """
    for _ in range(6):
        vertices, faces = _split(vertices, faces, 4 / 3 * edge)
        vertices, faces = _collapse(vertices, faces, 4 / 5 * edge, 4 / 3 * edge, sharp)
        for _ in range(3):
            faces = _flip(vertices, faces, sharp)
            vertices = _smooth(vertices, faces, sharp, project)
    for _ in range(10):
        faces = _flip(vertices, faces, sharp)
        vertices = _smooth(vertices, faces, sharp, project)
    return vertices, _flip(vertices, faces, sharp)


# --------------------------------------------------------------------------------------------------------
# The three objects.


def bunny() -> Surface:
    """Make the bunny of ``pybullet_data`` smooth, with about 3,300 vertices; it faces -y.

    Returns
    -------
    vertices, faces : ndarray
        Not scaled yet.
    """
    raw = trimesh.load_mesh(Path(pybullet_data.getDataPath()) / "bunny.obj", process=False)
    raw.merge_vertices(merge_tex=True, merge_norm=True)
    raw.vertices = raw.vertices[:, [0, 2, 1]] * [1, -1, 1]  # y up, facing z
    raw.vertices /= raw.extents.max()
    start, fine = raw.subdivide_loop(iterations=2), raw.subdivide_loop(iterations=4)
    tree, normals = cKDTree(fine.vertices), np.asarray(fine.vertex_normals)

    def project(points: Floats) -> Floats:
        nearest = tree.query(points)[1]
        height = np.einsum("ni,ni->n", points - tree.data[nearest], normals[nearest])
        on_surface: Floats = points - normals[nearest] * height[:, None]
        return on_surface

    return remesh(np.array(start.vertices), np.array(start.faces, dtype=np.int64), 0.025, False, project)


def _bar(*sections: tuple[float, float, float, float, float]) -> Manifold:
    """Make a straight bar along z through level rectangles, each (x, y, z, width along x, depth along y)."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    return Manifold.hull_points([(x + w * i, y + d * j, z) for x, y, z, w, d in sections for i, j in corners])


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Manifold:
    """Make a box between bounds along each axis."""
    low, high = np.array([x, y, z]).T
    return Manifold.cube(high - low).translate(low)


def chair() -> Surface:
    """Make an armchair of slats with sharp edges and about 1,500 vertices; it faces -y.

    Returns
    -------
    vertices, faces : ndarray
        Not scaled yet.
    """
    # Parts are flush or at least 0.0175 apart, as a narrow ledge would force thin triangles.
    back, lean = 0.225, 0.12 / 0.56  # the back leans from the seat's top at z = 0.44 to z = 1

    def slat(x: float, width: float, depth: float, low: float, high: float) -> Manifold:
        front = back - 0.065 / 2 + depth / 2
        return _bar(*((x, front + lean * (z - 0.44), z, width, depth) for z in (low, high)))

    parts = [_box((-0.25, 0.25), (-0.3, 0.29), (0.39, 0.44)), slat(0.0, 0.5, 0.04, 0.86, 0.96)]
    parts += [slat(x, 0.065, 0.04, 0.42, 0.88) for x in (-0.115, 0.0, 0.115)]
    for x in (-0.255, 0.255):
        parts += [
            _box((x - 0.0325, x + 0.0325), (-0.2675, -0.2025), (0.0, 0.63)),  # front leg, up to the arm
            _bar((x, 0.25, 0.0, 0.065, 0.065), (x, back, 0.44, 0.065, 0.065)),  # hind leg
            slat(x, 0.065, 0.065, 0.44, 1.0),
            _box((x - 0.055, x + 0.055), (-0.31, 0.268), (0.62, 0.665)),  # arm
            _box((x - 0.015, x + 0.015), (-0.235, 0.24), (0.17, 0.215)),  # stretcher
        ]
    mesh = Manifold.batch_boolean(parts, OpType.Add).simplify(1e-6).to_mesh64()
    return remesh(mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64), 0.048, True)


def _zip(lower: Floats, upper: Floats, first_lower: int, first_upper: int) -> Ints:
    """Triangulate between two rings of rising angles; an edge's apex is the other ring's nearest vertex."""
    n, m = len(lower), len(upper)
    middle = np.concatenate([lower + np.pi / n, upper + np.pi / m])
    order = np.argsort(middle.round(9), kind="stable")
    is_lower = order < n
    i = (np.cumsum(is_lower) - is_lower) % n
    j = (np.cumsum(~is_lower) - ~is_lower) % m
    apex = np.where(is_lower, first_upper + j, first_lower + i)
    start = np.where(is_lower, first_lower + i, first_upper + (j + 1) % m)
    end = np.where(is_lower, first_lower + (i + 1) % n, first_upper + j)
    return np.stack([start, end, apex], 1)


def vase() -> Surface:
    """Make a vase with a wall of 3 % of its height and about 1,500 vertices, in rings of even segments, staggered.

    Returns
    -------
    vertices, faces : ndarray
        Not scaled yet.
    """
    wall, edge = 0.03, 0.045
    z = np.linspace(0, 1 - wall / 2, 2001)
    knots = [0, 0.06, 0.5, 0.84, 1 - wall / 2], [0.15, 0.135, 0.285, 0.115, 0.175]
    radius = CubicSpline(*knots, bc_type=((1, -0.6), (1, 1.0)))
    outer = np.stack([radius(z), z], 1)
    normal = np.stack([np.ones_like(z), -radius(z, 1)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inner = outer - wall * normal
    inner = inner[inner[:, 1] > wall][::-1]
    top, turn = outer[-1] - wall / 2 * normal[-1], np.arctan2(normal[-1, 1], normal[-1, 0])
    angle = turn + np.linspace(0, np.pi, 101)[:, None]
    rim = top + wall / 2 * np.hstack([np.cos(angle), np.sin(angle)])
    pieces = [
        (np.array([[0, 0], outer[0]]), None),
        (outer, None),
        (rim, 2),
        (inner, None),
        (np.array([[inner[-1, 0], wall], [0, wall]]), None),
    ]
    profile = [np.zeros((1, 2))]
    for curve, count in pieces:
        along = np.append(0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
        at = np.linspace(0, along[-1], 1 + (count or max(1, round(along[-1] / (edge * 0.75**0.5)))))[1:]
        profile.append(np.stack([np.interp(at, along, curve[:, k]) for k in range(2)], 1))
    vertices, faces = [], []
    previous, first = np.zeros(1), 0
    for k, (r, height) in enumerate(np.concatenate(profile)):
        count = max(6, 2 * round(np.pi * r / edge)) if r else 1  # even, so that the axis stays at the centre
        ring = (np.arange(count) + k % 2 / 2) * 2 * np.pi / count
        vertices.append(np.stack([r * np.cos(ring), r * np.sin(ring), np.full(count, height)], 1))
        if k:
            faces.append(_zip(previous, ring, first - len(previous), first))
        previous, first = ring, first + count
    triangles = np.concatenate(faces)
    triangles = triangles[triangles[:, 0] != triangles[:, 1]]  # the only edge of a pole
    points = np.concatenate(vertices)
    return points, _flip(points, triangles, False)


MESHES: dict[str, Callable[[], Surface]] = {"bunny": bunny, "chair": chair, "vase": vase}


def normalised(vertices: Floats) -> Floats:
    """Centre vertices on their bounding box and scale them to largest extent 1, to the 8 decimals that are written.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        In any unit.

    Returns
    -------
    ndarray of float64, shape (V, 3)
        The vertices that the file gets.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit: Floats = ((vertices - (low + high) / 2) / (high - low).max()).round(8)
    return unit


def check(mesh: trimesh.Trimesh) -> None:
    """Check that a mesh is one closed, outward-oriented surface that a boolean kernel accepts.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        As it is written.

    Raises
    ------
    ValueError
        If it is not.
    """
    solid = Manifold(Mesh64(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)))
    sound = (
        mesh.is_watertight
        and mesh.is_winding_consistent
        and mesh.body_count == 1
        and solid.status() == Error.NoError
        and len(solid.decompose()) == 1
        and abs(solid.volume() - mesh.volume) < 1e-9
        and mesh.volume > 0
        and mesh.area_faces.min() > 1e-9
    )
    if not sound:
        raise ValueError("not one closed, outward-oriented surface")


def write_obj(path: Path, vertices: Floats, faces: Ints) -> None:
    """Write a mesh as an OBJ file, in whole or not at all.

    Parameters
    ----------
    path : Path
        The file; it is replaced if it is there.
    vertices : ndarray of float64, shape (V, 3)
        Written with 8 decimals.
    faces : ndarray of int64, shape (F, 3)
        Counted from 0.
    """
    lines = ["v {:.8f} {:.8f} {:.8f}".format(*v) for v in (vertices + 0.0).tolist()]  # no -0.00000000
    lines += ["f {} {} {}".format(*f) for f in (faces + 1).tolist()]
    part = path.with_name(path.name + ".part")
    part.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
    os.replace(part, path)


def main() -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description="Make the example meshes.")
    parser.add_argument("names", nargs="*", help=f"which of {', '.join(MESHES)}; all by default")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder of the OBJ files")
    args = parser.parse_args()
    if unknown := set(args.names) - set(MESHES):
        parser.error(f"no such mesh: {', '.join(sorted(unknown))}")
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names or MESHES:
        vertices, faces = MESHES[name]()
        mesh = trimesh.Trimesh(normalised(vertices), faces, process=False)
        check(mesh)
        write_obj(args.out / f"{name}.obj", mesh.vertices, mesh.faces)
        angles = np.degrees(mesh.face_angles)
        print(
            f"{name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, volume {mesh.volume:.6f}, "
            f"area {mesh.area:.4f}, angles from {angles.min():.1f} (median of the least: "
            f"{np.median(angles.min(axis=1)):.1f}) to {angles.max():.1f} degrees, "
            f"genus {1 - mesh.euler_number // 2}, watertight {mesh.is_watertight}"
        )


if __name__ == "__main__":
    main()
