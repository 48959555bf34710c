"""Isotropic remeshing of closed surfaces, for ``make_meshes``: edges of about one length.

Botsch and Kobbelt 2004: split long edges, collapse short ones, flip to Delaunay, smooth within the surface. A
vertex may only move in the directions that leave all its face planes unchanged, so a polyhedron keeps its creases
and corners exactly, without a list of them.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Surface = tuple[Floats, Ints]


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


def flip(vertices: Floats, faces: Ints, sharp: bool) -> Ints:
    """Flip edges until the surface is Delaunay, where it keeps its shape.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Of the surface.
    faces : ndarray of int64, shape (F, 3)
        Outward.
    sharp : bool
        Whether it is a polyhedron, whose creases are kept.

    Returns
    -------
    ndarray of int64, shape (F, 3)
        The new faces.
    """
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
            faces = flip(vertices, faces, sharp)
            vertices = _smooth(vertices, faces, sharp, project)
    for _ in range(10):
        faces = flip(vertices, faces, sharp)
        vertices = _smooth(vertices, faces, sharp, project)
    return vertices, flip(vertices, faces, sharp)
