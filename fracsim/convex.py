"""Convex parts: CoACD on every atom, then cut pairwise so that no two atoms' parts overlap. Offline only.

Any grouping of atoms into pieces then starts free of overlap, which a physics engine would turn into speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from .errors import BakeError, MissingExtraError

try:
    import coacd
    import manifold3d
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

GAP = 3e-3  # of the largest extent, between parts of different atoms; three times the engine's hull margin
CONVEX = 0.92  # share of its hull's volume from which an atom counts as convex
CONCAVITY = 0.15  # CoACD's threshold
SMALLEST = 1e-3  # of the atom's volume: thinner offcuts of the clipping are dropped
HULL_VERTICES = 64  # the most an engine handles gladly


def decompose(
    surfaces: Sequence[tuple[FloatArray, IntArray]],
    workers: int = 2,
    progress: Callable[[float], None] = lambda _: None,
) -> list[list[FloatArray]]:
    """Convex parts of each watertight surface, as point sets (n, 3) that are their own hulls.

    Nearly convex ones are one part; the others go through CoACD (Wei et al. 2022), in ``workers`` processes.
    """
    result: list[list[FloatArray]] = [[] for _ in surfaces]
    hard = []
    for k, (vertices, faces) in enumerate(surfaces):
        corner = vertices[faces]
        volume = float(np.linalg.det(corner).sum()) / 6
        hull = ConvexHull(vertices)
        if volume >= CONVEX * hull.volume:
            result[k] = [_thin(vertices[hull.vertices])]
        else:
            hard.append(k)
    progress(1 - len(hard) / max(1, len(surfaces)))
    if workers < 2:
        for done, k in enumerate(hard):
            result[k] = _coacd(*surfaces[k])
            progress(1 - (len(hard) - done - 1) / len(surfaces))
        return result
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        jobs = {pool.submit(_coacd, *surfaces[k]): k for k in hard}
        try:
            for done, job in enumerate(as_completed(jobs)):
                result[jobs[job]] = job.result()
                progress(1 - (len(hard) - done - 1) / len(surfaces))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return result


def _coacd(vertices: FloatArray, faces: IntArray) -> list[FloatArray]:
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=CONCAVITY,
        preprocess_mode="off",  # the surface is manifold already
        resolution=1000,
        mcts_nodes=10,
        mcts_iterations=60,
        mcts_max_depth=2,
        max_ch_vertex=HULL_VERTICES,
        decimate=True,
        seed=0,
    )
    return [_thin(np.asarray(points, dtype=np.float64)) for points, _ in parts]


def _thin(points: FloatArray) -> FloatArray:
    """A hull of at most HULL_VERTICES of the points: those that stick out furthest in evenly spread directions."""
    if len(points) <= HULL_VERTICES:
        return points
    k = np.arange(4 * HULL_VERTICES) + 0.5  # a Fibonacci sphere
    z = 1 - 2 * k / len(k)
    angle = np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z**2)
    reach = points @ np.stack([ring * np.cos(angle), ring * np.sin(angle), z])
    chosen, count = np.unique(np.argmax(reach, axis=0), return_counts=True)
    return points[np.sort(chosen[np.argsort(-count, kind="stable")][:HULL_VERTICES])]


def clip_apart(
    parts: Sequence[Sequence[FloatArray]],
    pairs: IntArray,
    normals: FloatArray,
    gap: float = GAP,
    progress: Callable[[float], None] = lambda _: None,
) -> list[list[FloatArray]]:
    """Cut convex parts by planes until those of different atoms keep ``gap`` between them.

    parts: per atom, point sets. pairs (I, 2), normals (I, 3): the atoms' interfaces, whose mean planes are
    tried as cuts beside the parts' own faces; each pair is cut where least volume goes.
    """
    owner = np.repeat(np.arange(len(parts)), [len(some) for some in parts])
    solids = [manifold3d.Manifold.hull_points(points) for some in parts for points in some]
    whole = np.array([solid.volume() for solid in solids])
    hint = {(int(a), int(b)): normal for (a, b), normal in zip(pairs, normals, strict=True)}
    low = np.array([solid.bounding_box()[:3] for solid in solids]) - gap / 2
    high = np.array([solid.bounding_box()[3:] for solid in solids]) + gap / 2
    near = (low[:, None] <= high[None]).all(axis=2)
    near &= near.T & (owner[:, None] != owner[None])
    candidates = np.argwhere(np.triu(near))
    for done, (i, j) in enumerate(candidates.tolist()):
        if not solids[i].is_empty() and not solids[j].is_empty():
            solids[i], solids[j] = _part(solids[i], solids[j], hint.get((int(owner[i]), int(owner[j]))), gap)
        if done % 32 == 0:
            progress(done / len(candidates))
    progress(1.0)
    total = np.bincount(owner, whole, minlength=len(parts))
    result: list[list[FloatArray]] = [[] for _ in parts]
    for k, solid in enumerate(solids):
        if solid.volume() > SMALLEST * total[owner[k]]:
            result[owner[k]].append(_thin(_points(solid)))
    for k, some in enumerate(result):
        if not some:
            raise BakeError(f"atom {k} lost its last convex part to its neighbours; use fewer modes or a larger mesh")
    return result


def _points(solid: manifold3d.Manifold) -> FloatArray:
    points = np.asarray(solid.to_mesh64().vert_properties)[:, :3]
    return np.unique(points, axis=0)


def _part(
    first: manifold3d.Manifold, second: manifold3d.Manifold, hint: FloatArray | None, gap: float
) -> tuple[manifold3d.Manifold, manifold3d.Manifold]:
    """The two convex solids, cut by the one slab of thickness ``gap`` that costs them least volume."""
    a, b = _points(first), _points(second)
    if first.min_gap(second, gap) >= gap:
        return first, second
    directions = [b.mean(axis=0) - a.mean(axis=0)]
    if hint is not None:
        directions.append(hint)
    overlap = first ^ second
    if not overlap.is_empty() and overlap.volume() > 0:
        directions.append(np.linalg.svd(_points(overlap) - _points(overlap).mean(axis=0))[2][2])
    directions += [equation[:3] for equation in _face_planes(a)] + [-equation[:3] for equation in _face_planes(b)]
    normals = np.array(directions)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals *= np.where(normals @ (b.mean(axis=0) - a.mean(axis=0)) < 0, -1.0, 1.0)[:, None]
    # How deep the two are in each other along each direction; only the shallowest few are worth a cut.
    depth = (a @ normals.T).max(axis=0) - (b @ normals.T).min(axis=0)
    best, loss = (first, second), np.inf
    for k in np.argsort(depth, kind="stable")[:8].tolist():
        top, bottom = float((a @ normals[k]).max()), float((b @ normals[k]).min())
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            # From cutting only the second to cutting only the first, the slab stays between the two ends.
            middle = (top + gap / 2) + share * ((bottom - gap / 2) - (top + gap / 2))
            one = first.trim_by_plane(tuple(-normals[k]), -(middle - gap / 2))
            other = second.trim_by_plane(tuple(normals[k]), middle + gap / 2)
            lost = first.volume() - one.volume() + second.volume() - other.volume()
            # Taking all of one part is no way out while another is left.
            if one.is_empty() or other.is_empty():
                lost += 10 * (first.volume() + second.volume())
            if lost < loss:
                best, loss = (one, other), lost
    return best


def _face_planes(points: FloatArray) -> FloatArray:
    try:
        return np.unique(np.round(ConvexHull(points).equations, 6), axis=0)
    except QhullError:
        return np.zeros((0, 4))


def pack(hulls: Sequence[FloatArray]) -> tuple[FloatArray, IntArray, IntArray]:
    """Points and outward faces of hulls one after the other, and how many of each every hull has (H, 2)."""
    faces = [_hull_faces(points) for points in hulls]
    sizes = np.array([(len(points), len(some)) for points, some in zip(hulls, faces, strict=True)])
    return np.concatenate(hulls), np.concatenate(faces), sizes


def _hull_faces(points: FloatArray) -> IntArray:
    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces
