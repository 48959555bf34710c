"""TODO solids.walls."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import IntArray
from .surface import Surface

REACH = 0.1  # of the largest extent: walls thicker than that are no walls to link across
THINNEST = 1e-4  # of the largest extent: nearer than that a line has not left the faces around its own vertex


def facing_vertices(surface: Surface, reach: float = REACH) -> IntArray:
    """Links (L, 2): vertices that face each other through a wall thinner than ``reach``.

    The partner of a vertex is the corner nearest to where the line into the body along its normal first comes out
    again. A pair is listed once, the smaller index first.
    """
    vertices, faces = surface.vertices, surface.faces
    inward = -np.asarray(surface.trimesh.vertex_normals)
    corner = vertices[faces]
    middle = corner.mean(axis=1)
    tree = cKDTree(middle)
    radius = np.linalg.norm(corner - middle[:, None], axis=2).max()
    found = []
    for start in range(0, len(vertices), 512):
        stop = min(start + 512, len(vertices))
        near = tree.query_ball_point(vertices[start:stop] + 0.5 * reach * inward[start:stop], 0.5 * reach + radius)
        one = np.repeat(np.arange(start, stop), [len(rows) for rows in near])
        face = np.concatenate([np.asarray(rows, dtype=np.int64) for rows in near])
        # Where the lines meet the faces (Möller and Trumbore 1997), from behind.
        u, v = corner[face, 1] - corner[face, 0], corner[face, 2] - corner[face, 0]
        arm = vertices[one] - corner[face, 0]
        across, side = np.cross(inward[one], v), np.cross(arm, u)
        volume = np.einsum("ni,ni->n", u, across)
        out = volume < 0
        scale = np.where(out, volume, -1.0)
        a, b = (np.einsum("ni,ni->n", x, y) / scale for x, y in ((arm, across), (inward[one], side)))
        depth = np.einsum("ni,ni->n", v, side) / scale
        hit = out & (a >= 0) & (b >= 0) & (a + b <= 1) & (depth > THINNEST) & (depth < reach)
        one, face, depth, a, b = one[hit], face[hit], depth[hit], a[hit], b[hit]
        order = np.lexsort((depth, one))
        _, first = np.unique(one[order], return_index=True)
        rows = order[first]
        nearest = np.argmax(np.stack([1 - a - b, a, b], axis=1)[rows], axis=1)
        found.append(np.sort(np.stack([one[rows], faces[face[rows], nearest]], axis=1), axis=1))
    return np.unique(np.concatenate(found), axis=0)
