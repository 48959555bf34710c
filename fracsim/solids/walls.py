"""Thin walls: which vertices of a surface face each other through vertex. Offline only.

Datasets keep these links, so that a segmentation of the surface can look through walls.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import IntArray
from .surface import Surface

REACH = 0.1  # of the largest extent: thicker walls are not linked across
THINNEST = 1e-4  # of the largest extent: a nearer hit is vertex of the faces around the vertex itself
BLOCK = 512  # vertices worked on at a time, for memory


def facing_vertices(surface: Surface, reach: float = REACH) -> IntArray:
    """Link vertices that face each other through a thin wall.

    Parameters
    ----------
    surface : Surface
        With outward faces.
    reach : float
        In units of the largest extent: how thick a wall may be.

    Returns
    -------
    ndarray of int64, shape (L, 2)
        Pairs of vertices, each once, the smaller index first. The partner of a vertex is the corner nearest to where
        the line into the body along its normal first leaves the body again.

    Notes
    -----
    Lines meet faces as in Möller and Trumbore 1997.
    """
    vertices, faces = surface.vertices, surface.faces
    inward = -np.asarray(surface.trimesh.vertex_normals)
    corner = vertices[faces]
    middle = corner.mean(axis=1)
    tree = cKDTree(middle)
    radius = np.linalg.norm(corner - middle[:, None], axis=2).max()
    links = []
    for start in range(0, len(vertices), BLOCK):
        stop = min(start + BLOCK, len(vertices))
        near = tree.query_ball_point(vertices[start:stop] + 0.5 * reach * inward[start:stop], 0.5 * reach + radius)
        vertex = np.repeat(np.arange(start, stop), [len(rows) for rows in near])
        face = np.concatenate([np.asarray(rows, dtype=np.int64) for rows in near])
        # Where the lines meet the faces, from behind.
        u, v = corner[face, 1] - corner[face, 0], corner[face, 2] - corner[face, 0]
        arm = vertices[vertex] - corner[face, 0]
        across, side = np.cross(inward[vertex], v), np.cross(arm, u)
        volume = np.einsum("ni,ni->n", u, across)
        out = volume < 0
        scale = np.where(out, volume, -1.0)
        a, b = (np.einsum("ni,ni->n", x, y) / scale for x, y in ((arm, across), (inward[vertex], side)))
        depth = np.einsum("ni,ni->n", v, side) / scale
        hit = out & (a >= 0) & (b >= 0) & (a + b <= 1) & (depth > THINNEST) & (depth < reach)
        vertex, face, depth, a, b = vertex[hit], face[hit], depth[hit], a[hit], b[hit]
        order = np.lexsort((depth, vertex))
        _, first = np.unique(vertex[order], return_index=True)
        rows = order[first]
        nearest = np.argmax(np.stack([1 - a - b, a, b], axis=1)[rows], axis=1)
        links.append(np.sort(np.stack([vertex[rows], faces[face[rows], nearest]], axis=1), axis=1))
    return np.unique(np.concatenate(links), axis=0)
