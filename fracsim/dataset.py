"""Fracture samples: impulses drawn over a surface, and what a generator says they do. Offline only.

Samples come in blocks, each drawn from its own seed, so that any number of them, made by any number of workers or in
any number of sittings, is the beginning of one and the same sequence. ``storage`` keeps them in a file.
"""

from __future__ import annotations

import collections
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from .errors import DatasetError, MissingExtraError
from .generator import Blows, Generator, Response
from .mesh import Surface
from .sampling import CONE, SurfacePoints, cone, ratios

try:
    import joblib
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

Result = TypeVar("Result")
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

BLOCK = 400  # samples that are drawn together
CONTACTS = 6  # the most that act together in a sample
SEVERAL = 0.25  # share of samples with 2 to CONTACTS contacts, in equal parts of every kind but the first
KINDS = ("single", "scattered", "landing", "ring", "grip")
TEST, VALIDATION = 0.15, 0.1  # shares of a block; validation is taken from what is not test
FOLDS = 5
POOL = 2048  # points from which the contacts of landings, rings and grips are chosen
TILT = np.deg2rad(10.0)  # half angle within which contacts of one body on another push the same way
RING = (0.05, 0.25)  # radii, in units of the largest extent


@dataclass(frozen=True, eq=False)
class Samples:
    """Impulses and their fractures.

    faces: (N, CONTACTS) and barycentric: (N, CONTACTS, 3), where on the surface; directions: (N, CONTACTS, 3).
    severities: (N, CONTACTS), impulse / (mass * breaking velocity), 0 where there is no contact.
    ratio: (N,), severity as a multiple of the one at which this very blow would first part the body.
    kind: (N,), index into KINDS. labels: (N, P), the piece of each part. broken: (N, I), the interfaces that give
    way, or (N, 0) from a generator that knows none; one that broke within a piece, its sides being joined another
    way, parts nothing. split: (N,), 0 train, 1 validation, 2 test. fold: (N,), 0 to FOLDS - 1, or -1 in the test
    split, which no fold may contain.
    """

    faces: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray
    ratio: FloatArray
    kind: IntArray
    labels: IntArray
    broken: BoolArray
    split: IntArray
    fold: IntArray

    @property
    def blows(self) -> Blows:
        return Blows(self.faces, self.barycentric, self.directions, self.severities)

    def part(self, split: int) -> Samples:
        return self.rows(self.split == split)

    def rows(self, rows: slice | IntArray | BoolArray) -> Samples:
        return Samples(*(getattr(self, field.name)[rows] for field in fields(self)))

    def __len__(self) -> int:
        return len(self.ratio)

    @classmethod
    def join(cls, blocks: list[Samples]) -> Samples:
        return cls(*(np.concatenate([getattr(block, field.name) for block in blocks]) for field in fields(cls)))


def sample(
    generator: Generator,
    count: int,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
    workers: int = 1,
    backend: str = "joblib",
    transform: Callable[[Samples], Samples] = lambda block: block,
    begun: Sequence[Samples] = (),
) -> Samples:
    """``count`` samples: points uniform over the area, directions uniform in a cone about the inward normal,
    severity log-uniform about the threshold; none is rejected, those that break nothing included.

    transform: applied to every block before they are joined. begun: the first blocks, where they are there already."""
    if count < 1 or seed < 0:
        raise DatasetError(f"a count of samples must be at least 1 and a seed at least 0, got {count} and {seed}")
    blocks = []
    rest = list(range(len(begun), -(-count // BLOCK)))
    for block in itertools.chain(begun, run_blocks(sample_block, generator, seed, rest, workers, backend)):
        blocks.append(transform(block))
        progress(min(1.0, len(blocks) * BLOCK / count))
    return Samples.join(blocks).rows(slice(count))


def run_blocks(
    job: Callable[[Generator, int, int], Result],
    generator: Generator,
    seed: int,
    blocks: list[int],
    workers: int = 1,
    backend: str = "joblib",
) -> Iterator[Result]:
    """``job(generator, seed, block)`` for every block, in order, whoever does it.

    workers: processes. backend: "joblib", on this machine, or "ray", on the cluster that ray is connected to or that
    the environment's RAY_ADDRESS names, or else on this machine; the block of a node that dies is made again by
    another. The bits are the same.
    """
    check_workers(workers, backend)
    if backend == "ray":
        yield from _on_ray(job, generator, seed, blocks, workers)
    elif workers == 1:
        for block in blocks:
            yield job(generator, seed, block)
    else:
        # In windows, so that no more than these wait in memory for whoever takes the results.
        with joblib.Parallel(n_jobs=workers, return_as="generator", batch_size=1) as parallel:
            for start in range(0, len(blocks), 4 * workers):
                window = blocks[start : start + 4 * workers]
                yield from parallel(joblib.delayed(job)(generator, seed, block) for block in window)


def check_workers(workers: int, backend: str) -> None:
    if backend not in ("joblib", "ray"):
        raise DatasetError(f"unknown backend {backend!r}; use joblib or ray")
    if workers < 1:
        raise DatasetError(f"workers must be at least 1, got {workers}")


def _on_ray(
    job: Callable[[Generator, int, int], Result], generator: Generator, seed: int, blocks: list[int], workers: int
) -> Iterator[Result]:
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("ray", "ray") from error
    if not ray.is_initialized():
        address, count = (None, None) if "RAY_ADDRESS" in os.environ else ("local", workers)
        ray.init(address, num_cpus=count, log_to_driver=False, configure_logging=False)
    remote = ray.remote(max_retries=-1)(job)
    shared = ray.put(generator)
    # Twice as many under way as there are workers: enough to keep them busy, few enough to fit any memory.
    waiting: collections.deque[Any] = collections.deque()
    for block in blocks:
        waiting.append(remote.remote(shared, seed, block))
        if len(waiting) >= 2 * workers:
            yield ray.get(waiting.popleft())
    while waiting:
        yield ray.get(waiting.popleft())


def sample_block(generator: Generator, seed: int, block: int) -> Samples:
    """The ``block``-th BLOCK samples of a seed."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1, block)))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        shares, kind = draw_blows(generator.surface, BLOCK, rng)
        ratio = ratios(BLOCK, rng)
        thresholds = generator.thresholds(shares)
        blows = shares.times(ratio * thresholds)
        response = checked(generator, blows, thresholds, generator.fracture(blows))
    broken = response.broken
    split, fold = np.zeros(BLOCK, dtype=np.int64), np.full(BLOCK, -1)
    order = rng.permutation(BLOCK)
    test = round(TEST * BLOCK)
    split[order[:test]] = 2
    split[order[test : test + round(VALIDATION * (BLOCK - test))]] = 1
    fold[rng.permutation(order[test:])] = np.arange(BLOCK - test) % FOLDS
    return Samples(
        blows.faces,
        blows.barycentric,
        blows.directions,
        blows.severities,
        ratio,
        kind,
        response.labels,
        np.zeros((BLOCK, 0), dtype=bool) if broken is None else broken,
        split,
        fold,
    )


def checked(generator: Generator, blows: Blows, thresholds: FloatArray, response: Response) -> Response:
    """The response, if a generator of whatever origin answered as it should; DatasetError says what is wrong."""
    name, count, parts = type(generator).__name__, len(blows), len(generator.parts.volumes)
    if np.shape(thresholds) != (count,) or not (np.isfinite(thresholds).all() and (np.asarray(thresholds) > 0).all()):
        raise DatasetError(f"{name}: thresholds must be ({count},), finite and positive")
    labels = np.asarray(response.labels)
    if labels.shape != (count, parts) or labels.dtype.kind not in "iu":
        raise DatasetError(
            f"{name}: labels must be integers of shape ({count}, {parts}), got {labels.dtype} of {labels.shape}"
        )
    if labels.min(initial=0) < 0 or labels.max(initial=0) >= parts:
        raise DatasetError(f"{name}: labels must lie in 0 to {parts - 1}")
    broken = response.broken
    if broken is not None and (broken.dtype != bool or broken.ndim != 2 or len(broken) != count):
        raise DatasetError(f"{name}: broken must be booleans of shape ({count}, interfaces), or None")
    return Response(labels.astype(np.int64, copy=False), broken)


def draw_blows(surface: Surface, count: int, rng: np.random.Generator) -> tuple[Blows, IntArray]:
    """Blows whose severities add up to 1, and their kinds (N,).

    Single and scattered contacts are uniform over the area, in a cone about the inward normal. The others choose
    among POOL points of the surface, one pool for all the blows: a landing is on a flat floor, at the lowest points
    along a random way down that face it. A ring is the end of a tube: points around a circle. Both push
    one way, within TILT. A grip is two opposite points pushed towards each other, within TILT and equally hard.
    """
    points = SurfacePoints(surface.vertices, surface.faces)
    kind = np.where(rng.random(count) < SEVERAL, rng.integers(1, len(KINDS), count), 0)
    contacts = np.where(kind == 0, 1, rng.integers(2, CONTACTS + 1, count))
    contacts[kind == KINDS.index("ring")] = rng.integers(3, CONTACTS + 1, int((kind == KINDS.index("ring")).sum()))
    contacts[kind == KINDS.index("grip")] = 2
    face, bary = points.draw(count * CONTACTS, rng)
    face, bary = face.reshape(count, CONTACTS), bary.reshape(count, CONTACTS, 3)
    directions = cone(-points.normals[face.ravel()], CONE, rng).reshape(count, CONTACTS, 3)
    share = rng.exponential(size=(count, CONTACTS)) * (np.arange(CONTACTS) < contacts[:, None])

    pool_face, pool_bary = points.draw(POOL, rng)
    pool, normal = points.at(pool_face, pool_bary), points.normals[pool_face]

    landing = kind == KINDS.index("landing")
    if landing.any():
        up = rng.standard_normal((int(landing.sum()), 3))
        up /= np.linalg.norm(up, axis=1)[:, None]
        height = up @ pool.T + 10.0 * (up @ normal.T > -0.2)  # what faces away from the floor does not touch it
        lowest = np.argpartition(height, 4 * CONTACTS, axis=1)[:, : 4 * CONTACTS]
        chosen = np.take_along_axis(lowest, rng.permuted(np.tile(np.arange(4 * CONTACTS), (len(up), 1)), axis=1), 1)
        chosen = chosen[:, :CONTACTS]
        face[landing], bary[landing] = pool_face[chosen], pool_bary[chosen]
        directions[landing] = cone(np.repeat(up, CONTACTS, axis=0), TILT, rng).reshape(-1, CONTACTS, 3)

    ring = kind == KINDS.index("ring")
    if ring.any():
        centre = points.at(face[ring, 0], bary[ring, 0])
        axis = -points.normals[face[ring, 0]]
        radius = np.exp(rng.uniform(np.log(RING[0]), np.log(RING[1]), len(centre)))
        side = cone(axis, np.pi / 2, rng)
        side -= np.einsum("ni,ni->n", side, axis)[:, None] * axis
        side /= np.linalg.norm(side, axis=1)[:, None]
        turn = 2 * np.pi * np.arange(CONTACTS) / contacts[ring, None]
        around = np.cos(turn)[:, :, None] * side[:, None] + np.sin(turn)[:, :, None] * np.cross(axis, side)[:, None]
        target = centre[:, None] + radius[:, None, None] * around
        _, near = cKDTree(pool).query(target, k=64)
        facing = np.einsum("rkni,ri->rkn", normal[near], axis) < -0.2
        first = np.argmax(facing, axis=2)
        chosen = np.take_along_axis(near, first[:, :, None], axis=2)[:, :, 0]
        # Where nothing near faces the tube, the contact is at its centre, which does.
        there = np.take_along_axis(facing, first[:, :, None], axis=2)
        face[ring] = np.where(there[:, :, 0], pool_face[chosen], face[ring][:, :1])
        bary[ring] = np.where(there, pool_bary[chosen], bary[ring][:, :1])
        directions[ring] = cone(np.repeat(axis, CONTACTS, axis=0), TILT, rng).reshape(-1, CONTACTS, 3)

    grip = kind == KINDS.index("grip")
    if grip.any():
        first = points.at(face[grip, 0], bary[grip, 0])
        inward = -points.normals[face[grip, 0]]
        arm = pool - first[:, None]
        along = np.einsum("gpi,gi->gp", arm, inward)
        beside = np.linalg.norm(arm - along[:, :, None] * inward[:, None], axis=2)
        facing = (normal @ inward.T).T > 0.5
        # The nearest point of the far side that is close to the line through the body.
        chosen = np.argmin(beside + 0.2 * along + 10.0 * ((along <= 0) | ~facing), axis=1)
        face[grip, 1], bary[grip, 1] = pool_face[chosen], pool_bary[chosen]
        directions[grip, 0], directions[grip, 1] = cone(inward, TILT, rng), cone(-inward, TILT, rng)
        share[grip, :2] = 1.0

    share /= share.sum(axis=1, keepdims=True)
    return Blows(face, bary, directions, share), kind
