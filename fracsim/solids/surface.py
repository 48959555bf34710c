"""Surfaces: read, check, and scale to largest extent 1. Offline only.

This is the one place that reads mesh files; all that is offline starts from its ``Surface``.
"""

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

    Attributes
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Scaled so that the largest extent is 1.
    faces : ndarray of int64, shape (F, 3)
        Indices of vertices, counter-clockwise seen from outside.
    scale : float
        m. The file's coordinates are ``vertices * scale + offset``.
    offset : ndarray of float64, shape (3,)
        m.
    name : str
        Where it came from, for messages.
    """

    vertices: FloatArray
    faces: IntArray
    scale: float
    offset: FloatArray
    name: str

    @property
    def trimesh(self) -> trimesh.Trimesh:
        """The same vertices and faces as a trimesh, which measures them."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def read_surface(source: str | Path | trimesh.Trimesh) -> Surface:
    """Read and check a surface that can be baked.

    Parameters
    ----------
    source : path or trimesh.Trimesh
        A path may be of any format that trimesh reads.

    Returns
    -------
    Surface
        Of largest extent 1.

    Raises
    ------
    MeshError
        If it is missing, unreadable, empty, not finite, not watertight, in several components, or without volume. The
        message names the file and the fault.
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
    """Split the long edges of a surface.

    A field has its values at vertices, so it cannot show pieces that are smaller than a face. New vertices lie on the
    old edges and faces, and the shape does not change.

    Parameters
    ----------
    surface : Surface
        Of any edges.
    longest : float
        In units of the largest extent.

    Returns
    -------
    Surface
        With no edge longer than ``longest``; the same object where there was none.

    Raises
    ------
    MeshError
        If the surface is no manifold.
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
    """Split every face of a surface in three, at its centroid.

    Parameters
    ----------
    surface : Surface
        With F faces.

    Returns
    -------
    Surface
        Of the same shape with F more vertices and 3 F faces.
    """
    count, (a, b, c) = len(surface.vertices), surface.faces.T
    middle = count + np.arange(len(surface.faces))
    faces = np.stack([[a, b, middle], [b, c, middle], [c, a, middle]]).transpose(2, 0, 1).reshape(-1, 3)
    vertices = np.vstack([surface.vertices, surface.vertices[surface.faces].mean(axis=1)])
    return replace(surface, vertices=vertices, faces=np.ascontiguousarray(faces))


def _check(mesh: trimesh.Trimesh, name: str) -> Surface:
    """Make a surface of a mesh, or say what is wrong with it."""
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
