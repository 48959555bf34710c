"""Make the example meshes: ``python meshes/make_meshes.py [bunny chair vase mug plate rod] [--out DIR]``.

Each mesh is one closed, outward-oriented surface of even triangles, stands along +z, is centred on its
bounding box and has a largest extent of exactly 1. The bunny is the 453-vertex one that
``pybullet_data`` carries, smoothed by Loop subdivision; the chair is a boolean union of convex parts whose
edges stay sharp; vase, plate and rod are surfaces of revolution, and the mug is one with a handle.

Real sizes, which a largest extent of 1 leaves out: the mug is 0.1 m high and 0.114 m with its handle, walls
of 4 mm; the plate 0.27 m across and 5 mm thick; the rod 0.3 m long and 18 mm thick. Give the largest extent
as the scale where metres matter.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pybullet_data
import trimesh
from manifold3d import CrossSection, Error, Manifold, Mesh64, OpType
from remeshing import Floats, Ints, Surface, flip, remesh
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree


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


def _revolved(pieces: list[tuple[Floats, int | None]], edge: float) -> Surface:
    """Turn a profile about z, in rings of even segments, staggered.

    Parameters
    ----------
    pieces : list of (ndarray of float64 (N, 2), int or None)
        Stretches of the profile as distances from the axis and heights, from the axis at the bottom outside to the
        axis at the top inside; and how many edges each gets, as many as fit by default.
    edge : float
        The length of edges, in the profile's unit.

    Returns
    -------
    vertices, faces : ndarray
        Outward.
    """
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
    return points, flip(points, triangles, False)


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
    return _revolved(pieces, edge)


def _line(*points: tuple[float, float]) -> tuple[Floats, int | None]:
    """Make a straight stretch of a profile, or several."""
    return np.array(points), None


def _arc(x: float, z: float, radius: float, start: float, end: float, count: int) -> tuple[Floats, int | None]:
    """Make a round stretch of a profile about (x, z), from angle to angle in degrees, in so many edges."""
    angle = np.radians(np.linspace(start, end, 101))
    return np.stack([x + radius * np.cos(angle), z + radius * np.sin(angle)], 1), count


def rod() -> Surface:
    """Make a round rod with rounded edges, 0.06 of its length thick, with about 900 vertices.

    Returns
    -------
    vertices, faces : ndarray
        Not scaled yet.
    """
    radius, edge, bevel = 0.03, 0.0165, 0.006
    flat, low, high = radius - bevel, bevel, 1 - bevel
    pieces = [
        _line((0, 0), (flat, 0)),
        _arc(flat, low, bevel, -90, 0, 1),
        _line((radius, low), (radius, high)),
        _arc(flat, high, bevel, 0, 90, 1),
        _line((flat, 1), (0, 1)),
    ]
    return _revolved(pieces, edge)


def plate() -> Surface:
    """Make a dinner plate with a raised rim and a foot, 0.0185 of its width thick, with about 2,600 vertices.

    Returns
    -------
    vertices, faces : ndarray
        Not scaled yet.
    """
    edge, wall = 0.036, 0.0185
    pieces = [
        _line((0, 0.013), (0.265, 0.013)),
        _line((0.265, 0.013), (0.275, 0.0), (0.3, 0.0), (0.315, 0.0155)),
        _line((0.315, 0.0155), (0.36, 0.05), (0.4907, 0.0815)),
        _arc(0.4907, 0.0815 + wall / 2, wall / 2, -90, 90, 2),
        _line((0.4907, 0.0815 + wall), (0.352, 0.0672), (0.3, 0.0315)),
        _line((0.3, 0.0315), (0, 0.0315)),
    ]
    return _revolved(pieces, edge)


def mug() -> Surface:
    """Make a mug with a round handle, walls of 4 % of its height and about 2,500 vertices; the handle is at +x.

    Returns
    -------
    vertices, faces : ndarray
        Not scaled yet.
    """
    radius, wall, base, edge, bevel = 0.4, 0.04, 0.06, 0.05, 0.03
    inner, rim = radius - wall, 1 - wall / 2
    pieces = [
        _line((0, 0), (radius - bevel, 0)),
        _arc(radius - bevel, bevel, bevel, -90, 0, 1),
        _line((radius, bevel), (radius, rim)),
        _arc(radius - wall / 2, rim, wall / 2, 0, 180, 2),
        _line((inner, rim), (inner, base + bevel)),
        _arc(inner - bevel, base + bevel, bevel, 0, -90, 1),
        _line((inner - bevel, base), (0, base)),
    ]
    vertices, faces = _revolved(pieces, edge)
    body = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    section = CrossSection.circle(0.05, 10).translate((0.24, 0))
    ring = Manifold.revolve(section, 32).rotate((90, 0, 0)).translate((0.45, 0, 0.5))
    within = Manifold.cylinder(1.0, radius - wall / 2, circular_segments=96)
    mesh = (body + (ring - within)).simplify(2e-3).to_mesh64()
    vertices = np.asarray(mesh.vert_properties)[:, :3]
    return vertices, flip(vertices, np.asarray(mesh.tri_verts).astype(np.int64), False)


MESHES: dict[str, Callable[[], Surface]] = {
    "bunny": bunny,
    "chair": chair,
    "vase": vase,
    "mug": mug,
    "plate": plate,
    "rod": rod,
}


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
