"""Surfaces: read, check, and bring to largest extent 1. Offline only; the one place that reads mesh files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MeshError, MissingExtraError

try:
    import manifold3d
    import trimesh
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

LONGEST = 0.08  # of the largest extent: edges longer than that are split before baking


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface of one component with outward faces.

    vertices: (V, 3), of largest extent 1. faces: (F, 3).
    scale, offset: m; the file's coordinates are ``vertices * scale + offset``.
    name: where it came from, for messages.
    """

    vertices: FloatArray
    faces: IntArray
    scale: float
    offset: FloatArray
    name: str

    @property
    def trimesh(self) -> trimesh.Trimesh:
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def read_surface(source: str | Path | trimesh.Trimesh) -> Surface:
    """Read and check a surface that can be baked.

    source: a path to any format trimesh reads, or a Trimesh.
    Raises MeshError, naming the file and the fault, if it is missing, unreadable, empty, not finite,
    not watertight, in several parts, without volume, or folded through itself into negative volume.
    """
    if isinstance(source, trimesh.Trimesh):
        return _check(source, "mesh")
    path = Path(source)
    if not path.is_file():
        raise MeshError(f"{path}: no such file")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh raises whatever its readers raise
        raise MeshError(f"{path}: cannot be read as a mesh ({type(error).__name__}: {error})") from error
    return _check(mesh, str(path))


def refine(surface: Surface, longest: float = LONGEST) -> Surface:
    """The same surface with no edge longer than ``longest``, as given where it has none.

    A field has its values at vertices, so faces larger than the pieces that break off leave it blind. New
    vertices lie on the old edges and faces, conformingly; the shape does not change.
    """
    edges = surface.vertices[surface.faces] - surface.vertices[np.roll(surface.faces, -1, axis=1)]
    if np.linalg.norm(edges, axis=2).max() <= longest:
        return surface
    solid = manifold3d.Manifold(manifold3d.Mesh64(surface.vertices, surface.faces.astype(np.uint64)))
    if solid.status() != manifold3d.Error.NoError:
        raise MeshError(f"{surface.name}: not a manifold ({solid.status().name}); repair it before baking")
    fine = solid.refine_to_length(longest).to_mesh64()
    vertices = np.ascontiguousarray(np.asarray(fine.vert_properties)[:, :3])
    return replace(surface, vertices=vertices, faces=np.asarray(fine.tri_verts).astype(np.int64))


def split_faces(surface: Surface) -> Surface:
    """The same surface with every face split in three at its centroid: about three times the vertices."""
    count, (a, b, c) = len(surface.vertices), surface.faces.T
    middle = count + np.arange(len(surface.faces))
    faces = np.stack([[a, b, middle], [b, c, middle], [c, a, middle]]).transpose(2, 0, 1).reshape(-1, 3)
    vertices = np.vstack([surface.vertices, surface.vertices[surface.faces].mean(axis=1)])
    return replace(surface, vertices=vertices, faces=np.ascontiguousarray(faces))


def _check(mesh: trimesh.Trimesh, name: str) -> Surface:
    vertices = np.array(mesh.vertices, dtype=np.float64)
    faces = np.array(mesh.faces, dtype=np.int64)
    if len(vertices) == 0 or len(faces) == 0:
        raise MeshError(f"{name}: empty mesh (no vertices or no faces)")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise MeshError(f"{name}: vertex {bad} is not finite; repair the mesh before baking it")
    # Files repeat a vertex per normal or texture seam; the surface is what is left when they are one again.
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise MeshError(f"{name}: every face is degenerate")
    if not mesh.is_watertight:
        _, counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        raise MeshError(
            f"{name}: not watertight ({int((counts != 2).sum())} edges are not shared by exactly two faces); "
            "close its holes before baking it"
        )
    components = mesh.body_count
    if components != 1:
        raise MeshError(f"{name}: {components} components; bake each by itself, or join them into one solid")
    if not mesh.is_winding_consistent:
        mesh.fix_normals()
    volume = float(np.linalg.det(mesh.triangles).sum()) / 6
    if volume < 0:
        mesh.invert()
    extent = float(mesh.extents.max())
    if not mesh.is_winding_consistent or abs(volume) < 1e-6 * extent**3:
        raise MeshError(f"{name}: encloses no volume; its faces are inconsistently oriented or it is flat")
    offset = np.asarray(mesh.bounds.mean(axis=0), dtype=np.float64)
    vertices = np.ascontiguousarray((mesh.vertices - offset) / extent, dtype=np.float64)
    return Surface(vertices, np.ascontiguousarray(mesh.faces, dtype=np.int64), extent, offset, name)
