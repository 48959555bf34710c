"""Unsigned geodesic distance to the crack curve on a surface. Offline only.

The curve of an interface is known exactly (segments inside the input's faces), so distances start from the
straight ways to it at the corners and edge midpoints of the faces it crosses, within the face and across one edge,
and fast marching carries them on over the surface with every face split in four.
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
    """Where cells meet on the surface: segments (S, 2) into points, cells (S, 2) ascending, input faces (S,)."""
    outer = np.flatnonzero(solid.source >= 0)
    ends = np.sort(solid.triangles[outer][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    row = np.repeat(outer, 3)
    order = np.lexsort(ends.T)
    left, right = row[order[::2]], row[order[1::2]]  # the outer surface is closed: two faces an edge
    cells = np.sort(np.stack([solid.sides[left, 0], solid.sides[right, 0]], axis=1), axis=1)
    crack = cells[:, 0] != cells[:, 1]
    return ends[order[::2]][crack], cells[crack], solid.source[left][crack]


def split_in_four(surface: Surface) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
    """The surface with a node at every edge midpoint.

    Returns nodes (V + E, 3), faces (4F, 3), edges (E, 2) and face_edges (F, 3): edge k of a face joins its
    corners k and k + 1, and node V + e is the midpoint of edge e.
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
    """Geodesic distances on one surface to the curves where parts of a solid meet: build once, ask often.

    nodes: (V + E, 3), the surface's vertices and edge midpoints. segments: (S, 2) into the solid's points, the
    curves' pieces; parts: (S, 2) ascending, the parts that meet there; faces: (S,) the input face each lies in.
    """

    def __init__(self, solid: Solid, surface: Surface) -> None:
        self.nodes, fine, _, face_edges = split_in_four(surface)
        self.vertices = len(surface.vertices)
        self.segments, self.parts, self.faces = crack_segments(solid)
        self.corners = np.hstack([surface.faces, face_edges + len(surface.vertices)])[self.faces]  # (S, 6)
        start = solid.points[self.segments[:, 0], None]
        along = solid.points[self.segments[:, 1], None] - start
        arm = self.nodes[self.corners] - start
        t = np.clip((arm * along).sum(axis=2) / (along**2).sum(axis=2), 0.0, 1.0)
        self.beside = np.linalg.norm(arm - t[:, :, None] * along, axis=2)  # (S, 6), exact within the face
        self.beyond, self.across = self._across(solid, surface, face_edges)
        self.solver = potpourri3d.MeshFastMarchingDistanceSolver(self.nodes, fine)

    def _across(self, solid: Solid, surface: Surface, face_edges: IntArray) -> tuple[IntArray, FloatArray]:
        """The nodes (S, 9) of the faces beside each segment's face that are not its own, and the straight ways
        (S, 9) from them to the segment across the edge between, inf where the straight line misses that edge.

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
        way = np.linalg.norm(node - foot, axis=3)
        way[(meets < 0) | (meets > length[:, :, None])] = np.inf
        return far.reshape(-1, 9), way.reshape(-1, 9)

    def to(self, segments: IntArray) -> tuple[FloatArray, IntArray]:
        """(V + E,) distance to the chosen segments (any number of indices), capped at CAP, and the nodes of the
        faces that they cross, where it is exact unless the shortest way crosses two edges or more."""
        if len(segments) == 0:
            return np.full(len(self.nodes), CAP), np.zeros(0, dtype=np.int64)
        seeds = np.unique(self.corners[segments])
        straight = np.full(len(self.nodes), np.inf)
        np.minimum.at(straight, self.corners[segments].ravel(), self.beside[segments].ravel())
        np.minimum.at(straight, self.beyond[segments].ravel(), self.across[segments].ravel())
        marched = self.solver.compute_distance([[(int(s), []) for s in seeds]], [straight[seeds].tolist()])
        return np.minimum(np.minimum(marched, straight), CAP), seeds

    def between(self, labels: IntArray) -> FloatArray:
        """(V + E,) distance to the cracks between parts of different pieces; labels: (P,)."""
        return self.to(np.flatnonzero(labels[self.parts[:, 0]] != labels[self.parts[:, 1]]))[0]


def interface_distances(
    curves: CurveDistances, pairs: IntArray, progress: Callable[[float], None] = lambda _: None
) -> tuple[FloatArray, IntArray]:
    """Distances to the curve of each interface on its own.

    pairs: (I, 2) ascending, the interfaces. Returns distances (I, V + E), capped at CAP and at CAP throughout
    where an interface does not reach the surface; and interface_vertices (I, VERTICES_PER_INTERFACE), vertices of the faces that each curve
    crosses, evenly from the list of them, or -1 throughout.
    """
    count = int(max(curves.parts.max(initial=0), pairs.max(initial=0))) + 1
    key = curves.parts[:, 0] * count + curves.parts[:, 1]
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
