"""TODO solids.hulls."""

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

Mesh = tuple[FloatArray, IntArray]
HULL_VERTICES = 20  # what an engine takes to build a hull grows with them
COVER = 5e-4  # of the largest extent: how far a piece's parts may reach out of the unbroken body's
CONCAVITY = 0.15  # CoACD's threshold


def covering(hulls: Sequence[FloatArray], points: FloatArray) -> list[FloatArray]:
    """The hulls, grown to where every point is in one of them, but for COVER: what a body breaks into must not reach
    out of it, or it would stand inside what the body had only touched.

    The point furthest out goes to the hull that it stands out of least, until none is out.
    """
    grown = [ConvexHull(some, incremental=True) for some in hulls]
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
    return np.asarray((points @ planes[:, :3].T + planes[:, 3] <= margin).all(axis=1))


def thin_hull(points: FloatArray, most: int = HULL_VERTICES) -> FloatArray:
    """A hull of at most so many of the points: each next one is that which adds most volume."""
    points = points[ConvexHull(points).vertices]
    if len(points) <= most:
        return points
    chosen = [int(np.argmin(points[:, 0])), int(np.argmax(points[:, 0]))]
    start, axis = points[chosen[0]], points[chosen[1]] - points[chosen[0]]
    chosen.append(int(np.argmax(np.linalg.norm(np.cross(points - start, axis), axis=1))))
    chosen.append(int(np.argmax(np.abs((points - start) @ np.cross(axis, points[chosen[2]] - start)))))
    while len(chosen) < most:
        hull = ConvexHull(points[chosen])
        corner = hull.points[hull.simplices]
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        chosen.append(int(np.argmax(np.maximum(points @ hull.equations[:, :3].T + hull.equations[:, 3], 0.0) @ area)))
    return points[np.sort(chosen)]


def as_manifold(vertices: FloatArray, faces: IntArray) -> manifold3d.Manifold:
    # It takes no array that cannot be written to.
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.array(vertices, order="C"), np.array(faces, dtype=np.uint64, order="C"))
    )


def hull_points(solid: manifold3d.Manifold) -> FloatArray:
    return np.unique(np.asarray(solid.to_mesh64().vert_properties, dtype=np.float64)[:, :3], axis=0)


def coacd_parts(
    surfaces: Sequence[Mesh], workers: int = 1, progress: Callable[[float], None] = lambda _: None
) -> list[list[FloatArray]]:
    """CoACD's convex parts (Wei et al. 2022) of each surface as point sets, in ``workers`` processes."""
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
    """Points and outward faces of hulls one after the other, and how many of each every hull has (H, 2)."""
    faces = [hull_faces(points) for points in hulls]
    sizes = np.array([(len(points), len(some)) for points, some in zip(hulls, faces, strict=True)])
    return np.concatenate(hulls), np.concatenate(faces), sizes


def hull_faces(points: FloatArray) -> IntArray:
    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces
