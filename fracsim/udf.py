"""Unsigned geodesic distance to the crack curve on a surface. Offline only.

The curve of an interface is known exactly (segments inside the input's faces), so distances start from exact
values at the corners and edge midpoints of the faces it crosses, and fast marching carries them on over the
surface with every face split in four.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from .errors import MissingExtraError
from .mesh import Surface
from .solid import Solid

try:
    import potpourri3d
except ImportError as error:
    raise MissingExtraError("potpourri3d", "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

SHORE = 16  # vertices along an interface's curve at which a field is read
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


def interface_distances(
    solid: Solid, surface: Surface, pairs: IntArray, progress: Callable[[float], None] = lambda _: None
) -> tuple[FloatArray, IntArray]:
    """Geodesic distance from the surface's vertices and edge midpoints to each interface's curve on it.

    pairs: (I, 2) ascending, the interfaces. Returns distances (I, V + E), capped at CAP and at CAP throughout
    where an interface does not reach the surface; and shores (I, SHORE), corners of the faces that each curve
    crosses, evenly from the list of them, or -1 throughout.
    """
    nodes, fine, _, face_edges = split_in_four(surface)
    segments, cells, faces = crack_segments(solid)
    corners = np.hstack([surface.faces, face_edges + len(surface.vertices)])[faces]  # (S, 6)
    start = solid.points[segments[:, 0], None]
    along = solid.points[segments[:, 1], None] - start
    arm = nodes[corners] - start
    t = np.clip((arm * along).sum(axis=2) / (along**2).sum(axis=2), 0.0, 1.0)
    exact = np.linalg.norm(arm - t[:, :, None] * along, axis=2)  # (S, 6)

    solver = potpourri3d.MeshFastMarchingDistanceSolver(nodes, fine)
    count = len(solid.volumes)
    key = cells[:, 0] * count + cells[:, 1]
    order = np.argsort(key, kind="stable")
    low, high = (np.searchsorted(key[order], pairs[:, 0] * count + pairs[:, 1], side=s) for s in ("left", "right"))
    result = np.full((len(pairs), len(nodes)), CAP)
    shores = np.full((len(pairs), SHORE), -1)
    for row in range(len(pairs)):
        mine = order[low[row] : high[row]]
        if len(mine) == 0:
            continue
        seeds, inverse = np.unique(corners[mine].ravel(), return_inverse=True)
        initial = np.full(len(seeds), np.inf)
        np.minimum.at(initial, inverse.reshape(-1), exact[mine].ravel())
        marched = solver.compute_distance([[(int(s), []) for s in seeds]], [initial.tolist()])
        result[row] = np.minimum(marched, CAP)
        result[row, seeds] = np.minimum(initial, result[row, seeds])
        beside = seeds[seeds < len(surface.vertices)]
        shores[row] = beside[np.linspace(0, len(beside) - 1, SHORE).round().astype(np.int64)]
        progress((row + 1) / len(pairs))
    return result, shores
