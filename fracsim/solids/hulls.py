"""Convex hulls as point sets: made by CoACD, thinned, grown and packed. Offline only, but for live decomposition.

``convex`` and ``convex_partition`` build on it. manifold3d and coacd are reached here and there only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import numpy as np
from scipy.spatial import ConvexHull

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import MissingExtraError

try:
    import coacd
    import manifold3d
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

Mesh = tuple[FloatArray, IntArray]  # vertices (V, 3) and outward faces (F, 3) of a closed surface
HULL_VERTICES = 20  # what an engine takes to build a hull grows with them
COVER = 5e-4  # of the largest extent: how far a piece's convex parts may reach out of the unbroken body's
CONCAVITY = 0.15  # CoACD's threshold


def covering(hulls: Sequence[FloatArray], points: FloatArray) -> list[FloatArray]:
    """Grow hulls until every point is in one of them, to within COVER.

    What a body breaks into must not reach out of the body, or it would stand inside of what the body only touched.

    Parameters
    ----------
    hulls : sequence of ndarray of float64, shape (n, 3)
        The body's, as points.
    points : ndarray of float64, shape (N, 3)
        To be covered.

    Returns
    -------
    list of ndarray of float64, shape (m, 3)
        The grown hulls, as their corners. The point furthest outside is added to the hull that it is nearest to, until
        none is outside.
    """
    grown = [ConvexHull(corners, incremental=True) for corners in hulls]
    out = np.array([(points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) for hull in grown])
    while True:
        nearest = out.min(axis=0)
        worst = int(nearest.argmax())
        if nearest[worst] <= COVER:
            break
        chosen = int(out[:, worst].argmin())
        grown[chosen].add_points(points[worst : worst + 1])
        equations = grown[chosen].equations
        out[chosen] = (points @ equations[:, :3].T + equations[:, 3]).max(axis=1)
    result = [hull.points[hull.vertices] for hull in grown]
    for hull in grown:
        hull.close()
    return result


def within(points: FloatArray, planes: FloatArray, margin: float = 0.0) -> BoolArray:
    """Decide which points lie behind all planes.

    Parameters
    ----------
    points : ndarray of float64, shape (N, 3)
        Any.
    planes : ndarray of float64, shape (P, 4)
        Unit normals and offsets, normal · x + offset <= 0 being behind, as in ``scipy.spatial.ConvexHull.equations``.
    margin : float
        How far before a plane still counts as behind it.

    Returns
    -------
    ndarray of bool, shape (N,)
        Whether each lies behind all of them.
    """
    return np.asarray((points @ planes[:, :3].T + planes[:, 3] <= margin).all(axis=1))


def thin_hull(points: FloatArray, limit: int = HULL_VERTICES) -> FloatArray:
    """Choose few of a hull's corners.

    Parameters
    ----------
    points : ndarray of float64, shape (N, 3)
        Whose hull it is.
    limit : int
        The most corners to keep.

    Returns
    -------
    ndarray of float64, shape (n, 3)
        At most ``limit`` of the corners; each one added was that which added most volume.
    """
    points = points[ConvexHull(points).vertices]
    if len(points) <= limit:
        return points
    chosen = [int(np.argmin(points[:, 0])), int(np.argmax(points[:, 0]))]
    start, axis = points[chosen[0]], points[chosen[1]] - points[chosen[0]]
    chosen.append(int(np.argmax(np.linalg.norm(np.cross(points - start, axis), axis=1))))
    chosen.append(int(np.argmax(np.abs((points - start) @ np.cross(axis, points[chosen[2]] - start)))))
    while len(chosen) < limit:
        hull = ConvexHull(points[chosen])
        corner = hull.points[hull.simplices]
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        chosen.append(int(np.argmax(np.maximum(points @ hull.equations[:, :3].T + hull.equations[:, 3], 0.0) @ area)))
    return points[np.sort(chosen)]


def as_manifold(vertices: FloatArray, faces: IntArray) -> manifold3d.Manifold:
    """Make a manifold3d solid of a closed surface.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Of the surface.
    faces : ndarray of int64, shape (F, 3)
        Outward.

    Returns
    -------
    manifold3d.Manifold
        The solid.
    """
    # manifold3d takes no array that cannot be written to, hence the copies.
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.array(vertices, order="C"), np.array(faces, dtype=np.uint64, order="C"))
    )


def hull_points(solid: manifold3d.Manifold) -> FloatArray:
    """List the points of a manifold3d solid.

    Parameters
    ----------
    solid : manifold3d.Manifold
        Any.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Its vertices, each once, in lexicographic order.
    """
    return np.unique(np.asarray(solid.to_mesh64().vert_properties, dtype=np.float64)[:, :3], axis=0)


def coacd_parts(
    surfaces: Sequence[Mesh], workers: int = 1, progress: Callable[[float], None] = lambda _: None
) -> list[list[FloatArray]]:
    """Decompose surfaces into convex parts by CoACD (Wei et al. 2022).

    Parameters
    ----------
    surfaces : sequence of (vertices, faces)
        Watertight.
    workers : int
        Processes; below 2 all happens in this one.
    progress : callable
        Hears the share that is done.

    Returns
    -------
    list of list of ndarray of float64, shape (n, 3)
        For each surface, its parts as point sets.
    """
    result: list[list[FloatArray]] = [[] for _ in surfaces]
    if workers < 2:
        for k, surface in enumerate(surfaces):
            result[k] = run_coacd(*surface)
            progress((k + 1) / len(surfaces))
        return result
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        jobs = {pool.submit(run_coacd, *surface): k for k, surface in enumerate(surfaces)}
        try:
            for done, job in enumerate(as_completed(jobs)):
                result[jobs[job]] = job.result()
                progress((done + 1) / len(surfaces))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return result


def run_coacd(vertices: FloatArray, faces: IntArray) -> list[FloatArray]:
    """Decompose one surface by CoACD.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Of the surface.
    faces : ndarray of int64, shape (F, 3)
        Outward and watertight.

    Returns
    -------
    list of ndarray of float64, shape (n, 3)
        Its parts as point sets.
    """
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=CONCAVITY,
        preprocess_mode="off",  # the surface is manifold already
        resolution=1000,
        mcts_nodes=10,
        mcts_iterations=60,
        mcts_max_depth=2,
        max_ch_vertex=64,
        decimate=True,
        seed=0,
    )
    return [np.asarray(points, dtype=np.float64) for points, _ in parts]


def pack(hulls: Sequence[FloatArray]) -> tuple[FloatArray, IntArray, IntArray]:
    """Put hulls one after the other in arrays.

    Parameters
    ----------
    hulls : sequence of ndarray of float64, shape (n, 3)
        Each its own hull's corners.

    Returns
    -------
    points : ndarray of float64, shape (N, 3)
        Of all hulls.
    faces : ndarray of int64, shape (M, 3)
        Outward, each hull's counted from its own first point.
    sizes : ndarray of int64, shape (H, 2)
        How many points and faces each hull has.
    """
    faces = [hull_faces(points) for points in hulls]
    sizes = np.array([(len(points), len(sides)) for points, sides in zip(hulls, faces, strict=True)])
    return np.concatenate(hulls), np.concatenate(faces), sizes


def hull_faces(points: FloatArray) -> IntArray:
    """Find the faces of a hull.

    Parameters
    ----------
    points : ndarray of float64, shape (n, 3)
        Each a corner of the hull.

    Returns
    -------
    ndarray of int64, shape (m, 3)
        Outward triangles of the points.
    """
    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces
