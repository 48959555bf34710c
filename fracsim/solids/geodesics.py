"""Unsigned geodesic distances on a surface to the curves where cells meet. Offline only.

Datasets and models get their fields here. The curve of an interface is known exactly (segments inside the input's
faces), so distances start from the straight lines to it at the corners and edge midpoints of the faces that it
crosses, within the face and across one edge; fast marching carries them on over the surface with every face split in
four (Kimmel and Sethian 1998, by geometry-central through potpourri3d).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from .solid import Solid
from .surface import Surface

try:
    import potpourri3d
except ImportError as error:
    raise MissingExtraError("potpourri3d", "bake") from error


VERTICES_PER_INTERFACE = 16  # vertices along an interface's curve at which a field is read
CAP = 0.3  # of the largest extent: a field says nothing about cracks further away than that


def crack_segments(solid: Solid) -> tuple[IntArray, IntArray, IntArray]:
    """Find where cells meet on the surface.

    Parameters
    ----------
    solid : Solid
        Of C cells.

    Returns
    -------
    segments : ndarray of int64, shape (S, 2)
        Pairs of the solid's points.
    cells : ndarray of int64, shape (S, 2)
        The cells on both sides, the smaller index first.
    faces : ndarray of int64, shape (S,)
        A face of the input that each lies in.
    """
    outer = np.flatnonzero(solid.source >= 0)
    ends = np.sort(solid.triangles[outer][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    row = np.repeat(outer, 3)
    order = np.lexsort(ends.T)
    left, right = row[order[::2]], row[order[1::2]]  # the outer surface is closed: two faces an edge
    cells = np.sort(np.stack([solid.sides[left, 0], solid.sides[right, 0]], axis=1), axis=1)
    crack = cells[:, 0] != cells[:, 1]
    return ends[order[::2]][crack], cells[crack], solid.source[left][crack]


def split_in_four(surface: Surface) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
    """Split every face of a surface in four, at its edge midpoints.

    Parameters
    ----------
    surface : Surface
        With V vertices, E edges and F faces.

    Returns
    -------
    nodes : ndarray of float64, shape (V + E, 3)
        Vertices, then midpoints: node V + e is the midpoint of edge e.
    faces : ndarray of int64, shape (4 F, 3)
        Of the nodes.
    edges : ndarray of int64, shape (E, 2)
        The vertices that each edge joins.
    face_edges : ndarray of int64, shape (F, 3)
        Edge k of a face joins its corners k and k + 1.
    """
    faces = surface.faces
    edges, inverse = np.unique(
        np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_inverse=True
    )
    face_edges = inverse.reshape(-1, 3)
    nodes = np.vstack([surface.vertices, surface.vertices[edges].mean(axis=1)])
    a, b, c = faces.T
    x, y, z = (face_edges + len(surface.vertices)).T
    fine = np.stack([[a, x, z], [x, b, y], [z, y, c], [x, y, z]], axis=0)
    return nodes, np.ascontiguousarray(fine.transpose(2, 0, 1).reshape(-1, 3)), edges, face_edges


class CurveDistances:
    """Geodesic distances on one surface to the curves where cells of a solid meet: built once, asked often.

    Parameters
    ----------
    solid : Solid
        Of P cells.
    surface : Surface
        Its outside.

    Attributes
    ----------
    nodes : ndarray of float64, shape (V + E, 3)
        The surface's vertices and edge midpoints.
    vertices : int
        V.
    segments : ndarray of int64, shape (S, 2)
        The pieces of the curves, pairs of the solid's points.
    cells : ndarray of int64, shape (S, 2)
        The cells that meet there, the smaller index first.
    faces : ndarray of int64, shape (S,)
        The input face that each segment lies in.
    corners : ndarray of int64, shape (S, 6)
        The nodes of that face.
    beside : ndarray of float64, shape (S, 6)
        Their distances to the segment; exact within the face.
    beyond : ndarray of int64, shape (S, 9)
        The nodes of the three faces next to it that are not its own.
    across : ndarray of float64, shape (S, 9)
        Their straight distances to the segment across the edge between; infinite where the line misses that edge.
    solver : potpourri3d.MeshFastMarchingDistanceSolver
        Marches over the split surface.
    """

    def __init__(self, solid: Solid, surface: Surface) -> None:
        self.nodes, fine, _, face_edges = split_in_four(surface)
        self.vertices = len(surface.vertices)
        self.segments, self.cells, self.faces = crack_segments(solid)
        self.corners = np.hstack([surface.faces, face_edges + len(surface.vertices)])[self.faces]  # (S, 6)
        start = solid.points[self.segments[:, 0], None]
        along = solid.points[self.segments[:, 1], None] - start
        arm = self.nodes[self.corners] - start
        t = np.clip((arm * along).sum(axis=2) / (along**2).sum(axis=2), 0.0, 1.0)
        self.beside = np.linalg.norm(arm - t[:, :, None] * along, axis=2)  # (S, 6), exact within the face
        self.beyond, self.across = self._across(solid, surface, face_edges)
        self.solver = potpourri3d.MeshFastMarchingDistanceSolver(self.nodes, fine)

    def _across(self, solid: Solid, surface: Surface, face_edges: IntArray) -> tuple[IntArray, FloatArray]:
        """Work out ``beyond`` and ``across``.

        A curve that clips a face's corner goes on in the next face, and may be nearer there to the far nodes of
        this one.
        """
        order = np.argsort(face_edges.ravel(), kind="stable")
        mate = np.empty(len(order), dtype=np.int64)
        mate[order[::2]], mate[order[1::2]] = order[1::2], order[::2]
        face, k = np.divmod(mate.reshape(-1, 3)[self.faces], 3)  # (S, 3), the same edges seen from the other side
        rims = [face_edges[face, (k + step) % 3] + self.vertices for step in (1, 2)]
        far = np.stack([surface.faces[face, (k + 2) % 3], *rims], axis=2)  # (S, 3, 3)
        # In the plane of each edge: how far along it, and how far beyond it; the segment's own face lies below 0.
        corner = surface.vertices[surface.faces[self.faces]]
        edge = np.roll(corner, -1, axis=1) - corner
        length = np.linalg.norm(edge, axis=2)
        edge /= length[:, :, None]
        up = corner - np.roll(corner, -2, axis=1)
        up -= (up * edge).sum(axis=2)[:, :, None] * edge
        up /= np.linalg.norm(up, axis=2)[:, :, None]
        arm = self.nodes[far] - corner[:, :, None]
        along = (arm * edge[:, :, None]).sum(axis=3)
        height = np.linalg.norm(arm - along[..., None] * edge[:, :, None], axis=3)  # unfolded
        node = np.stack([along, height], axis=3)
        ends = solid.points[self.segments][:, None] - corner[:, :, None]  # (S, 3, 2, 3)
        ends = np.stack([(ends * edge[:, :, None]).sum(axis=3), (ends * up[:, :, None]).sum(axis=3)], axis=3)
        start, line = ends[:, :, None, 0], (ends[:, :, 1] - ends[:, :, 0])[:, :, None]
        t = np.clip(((node - start) * line).sum(axis=3) / (line**2).sum(axis=3), 0.0, 1.0)
        foot = start + t[..., None] * line
        meets = along + height / np.maximum(height - foot[..., 1], 1e-300) * (foot[..., 0] - along)
        straight = np.linalg.norm(node - foot, axis=3)
        straight[(meets < 0) | (meets > length[:, :, None])] = np.inf
        return far.reshape(-1, 9), straight.reshape(-1, 9)

    def to(self, segments: IntArray) -> tuple[FloatArray, IntArray]:
        """Measure distances to some segments.

        Parameters
        ----------
        segments : ndarray of int64, shape (n,)
            Which; there may be none.

        Returns
        -------
        distances : ndarray of float64, shape (V + E,)
            In units of the largest extent, at most CAP.
        seeds : ndarray of int64, shape (s,)
            The nodes of the faces that the segments lie in. There a distance is exact unless the shortest line
            crosses two edges or more.
        """
        if len(segments) == 0:
            return np.full(len(self.nodes), CAP), np.zeros(0, dtype=np.int64)
        seeds = np.unique(self.corners[segments])
        straight = np.full(len(self.nodes), np.inf)
        np.minimum.at(straight, self.corners[segments].ravel(), self.beside[segments].ravel())
        np.minimum.at(straight, self.beyond[segments].ravel(), self.across[segments].ravel())
        marched = self.solver.compute_distance([[(int(s), []) for s in seeds]], [straight[seeds].tolist()])
        return np.minimum(np.minimum(marched, straight), CAP), seeds

    def between(self, labels: IntArray) -> FloatArray:
        """Measure distances to the cracks of a fracture.

        Parameters
        ----------
        labels : ndarray of int64, shape (P,)
            The piece of each cell.

        Returns
        -------
        ndarray of float64, shape (V + E,)
            Distance to the nearest curve between cells of different pieces, at most CAP.
        """
        return self.to(np.flatnonzero(labels[self.cells[:, 0]] != labels[self.cells[:, 1]]))[0]


def interface_distances(
    curves: CurveDistances, pairs: IntArray, progress: Callable[[float], None] = lambda _: None
) -> tuple[FloatArray, IntArray]:
    """Measure distances to the curve of each interface on its own.

    Parameters
    ----------
    curves : CurveDistances
        Of the solid whose interfaces they are.
    pairs : ndarray of int64, shape (I, 2)
        The interfaces' cells, the smaller index first.
    progress : callable
        Hears the share that is done.

    Returns
    -------
    distances : ndarray of float64, shape (I, V + E)
        At most CAP, and CAP throughout where an interface does not reach the surface.
    interface_vertices : ndarray of int64, shape (I, VERTICES_PER_INTERFACE)
        Vertices of the faces that each curve crosses, evenly taken from their list; -1 throughout where there are none.
    """
    count = int(max(curves.cells.max(initial=0), pairs.max(initial=0))) + 1
    key = curves.cells[:, 0] * count + curves.cells[:, 1]
    order = np.argsort(key, kind="stable")
    low, high = (np.searchsorted(key[order], pairs[:, 0] * count + pairs[:, 1], side=s) for s in ("left", "right"))
    result = np.empty((len(pairs), len(curves.nodes)))
    interface_vertices = np.full((len(pairs), VERTICES_PER_INTERFACE), -1)
    for row in range(len(pairs)):
        result[row], seeds = curves.to(order[low[row] : high[row]])
        beside = seeds[seeds < curves.vertices]
        if len(beside):
            interface_vertices[row] = beside[
                np.linspace(0, len(beside) - 1, VERTICES_PER_INTERFACE).round().astype(np.int64)
            ]
        progress((row + 1) / len(pairs))
    return result, interface_vertices
