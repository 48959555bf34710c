"""The shipped meshes: sizes, closed single surfaces, the walls, and that the script makes them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

manifold3d = pytest.importorskip("manifold3d")

MESHES = Path(__file__).parents[1] / "meshes"
VERTICES = {
    "bunny": (3250, 3350),
    "chair": (1400, 1600),
    "vase": (1400, 1600),
    "mug": (2000, 2500),
    "plate": (1500, 1700),
    "rod": (800, 950),
}
GENUS = {"bunny": 0, "chair": 8, "vase": 0, "mug": 1, "plate": 0, "rod": 0}


def load(name: str) -> trimesh.Trimesh:
    return trimesh.load(MESHES / f"{name}.obj", force="mesh", process=False)


@pytest.fixture(params=VERTICES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_one_closed_outward_surface(name: str) -> None:
    mesh = load(name)
    low, high = VERTICES[name]
    assert low <= len(mesh.vertices) <= high
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.euler_number == 2 - 2 * GENUS[name]
    solid = manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices), np.array(mesh.faces, np.uint64)))
    assert solid.status() == manifold3d.Error.NoError
    assert len(solid.decompose()) == 1
    assert solid.volume() == pytest.approx(mesh.volume, abs=1e-9)


def test_unit_extent_and_centre(name: str) -> None:
    mesh = load(name)
    assert mesh.extents.max() == 1
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=2e-8)


def test_stands_along_z(name: str) -> None:
    mesh = load(name)
    if name not in ("bunny", "plate"):
        assert mesh.extents.argmax() == (0 if name == "mug" else 2)  # whose handle reaches out
    # The lowest parts (feet, legs, base) surround the point below the centre of mass.
    foot = mesh.vertices[mesh.vertices[:, 2] < mesh.bounds[0, 2] + 0.03]
    assert (foot.min(axis=0)[:2] < mesh.center_mass[:2]).all()
    assert (foot.max(axis=0)[:2] > mesh.center_mass[:2]).all()


def test_even_triangles(name: str) -> None:
    mesh = load(name)
    angles = np.degrees(mesh.face_angles)
    if name == "mug":  # but for the few triangles where the handle was joined to the wall
        assert (angles.min(axis=1) < 20).mean() < 0.15
        assert np.median(angles.min(axis=1)) > 40
        return
    assert angles.min() > 20
    assert angles.max() < 125
    assert np.median(angles.min(axis=1)) > 45
    assert mesh.edges_unique_length.max() < 2 * np.median(mesh.edges_unique_length)


def test_no_self_intersection(name: str) -> None:
    """No edge passes through a face that it shares no vertex with."""
    mesh = load(name)
    edges, faces, points = mesh.edges_unique, mesh.faces, mesh.vertices
    reach = mesh.edges_unique_length.max() * (0.5 + 3**-0.5)
    near = cKDTree(mesh.triangles_center).query_ball_point(points[edges].mean(axis=1), reach)
    e = np.repeat(np.arange(len(edges)), [len(row) for row in near])
    f = np.concatenate(near)
    apart = (edges[e][:, :, None] != faces[f][:, None, :]).all(axis=(1, 2))
    e, f = e[apart], f[apart]
    p, q = points[edges[e]].transpose(1, 0, 2)
    a, b, c = points[faces[f]].transpose(1, 0, 2)

    def side(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.sign(np.einsum("ni,ni->n", np.cross(x - w, y - w), z - w))

    crosses = side(a, b, c, p) * side(a, b, c, q) < 0
    turns = [side(p, q, s, t) for s, t in ((a, b), (b, c), (c, a))]
    assert not (crosses & (turns[0] == turns[1]) & (turns[1] == turns[2])).any()


def test_vase_wall_is_three_percent_of_its_height() -> None:
    mesh = load("vase")
    centre, normal = mesh.triangles_center, mesh.face_normals
    radial = np.einsum("ni,ni->n", centre[:, :2], normal[:, :2]) / np.linalg.norm(centre[:, :2], axis=1)
    # The inner surface: it faces the axis, or it is the floor, which faces up; the rim is left out.
    floor = (normal[:, 2] > 0.99) & (centre[:, 2] < -0.4)
    inner = np.flatnonzero(((radial < -1e-3) | floor) & (centre[:, 2] < 0.47))
    start = centre[inner] - 1e-4 * normal[inner]  # a start on the surface might hit its own face
    hit, ray, _ = mesh.ray.intersects_location(start, -normal[inner], multiple_hits=False)
    assert sorted(ray) == list(range(len(inner)))
    wall = np.linalg.norm(hit - centre[inner][ray], axis=1)
    assert len(inner) > 1000
    assert wall.min() > 0.02
    assert wall.max() < 0.045
    assert np.median(wall) == pytest.approx(0.03, abs=0.002)


def test_thickness_of_the_everyday_things() -> None:
    """By the greatest distance of two parallel planes that touch the body, or by its volume."""
    rod, plate, mug = load("rod"), load("plate"), load("mug")
    assert rod.extents[:2] == pytest.approx(0.06, rel=0.01)
    assert rod.volume == pytest.approx(np.pi * 0.03**2, rel=0.06)
    # 5 mm of 0.27 m, and 4 mm of 0.114 m: volume over half of the area.
    assert 2 * plate.volume / plate.area == pytest.approx(0.005 / 0.27, rel=0.05)
    assert mug.extents[2] == pytest.approx(0.1 / 0.114, rel=0.01)
    assert 2 * mug.volume / mug.area == pytest.approx(0.0042 / 0.114, rel=0.1)


def test_script_makes_the_shipped_files(tmp_path: Path) -> None:
    pytest.importorskip("pybullet_data")
    command = [sys.executable, MESHES / "make_meshes.py", "--out", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{name}.obj" for name in VERTICES)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (MESHES / path.name).read_bytes(), path.name
