"""Fracture samples: impulses drawn over a surface, and what a generator says they do. Offline only.

Samples come in blocks, each drawn from its own seed, so that any number of them, made by any number of workers or in
any number of sittings, is the beginning of one and the same sequence. ``storage`` keeps them in a file.
"""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from .errors import DatasetError, MissingExtraError
from .generator import Blows, Generator
from .mesh import Surface
from .sampling import CONE, SEVERITY, SurfacePoints, cone

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
) -> Samples:
    """``count`` samples: points uniform over the area, directions uniform in a cone about the inward normal,
    severity log-uniform about the threshold; none is rejected, those that break nothing included.

    transform: applied to every block before they are joined."""
    blocks = []
    for block in run_blocks(sample_block, generator, seed, list(range(-(-count // BLOCK))), workers, backend):
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

    workers: processes. backend: "joblib", on this machine, or "ray", on whatever cluster ray is connected to, where
    the block of a node that dies is made again by another. The bits are the same.
    """
    if backend not in ("joblib", "ray"):
        raise DatasetError(f"unknown backend {backend!r}; use joblib or ray")
    if workers < 1:
        raise DatasetError(f"workers must be at least 1, got {workers}")
    if backend == "ray":
        yield from _on_ray(job, generator, seed, blocks, workers)
    elif workers == 1:
        for block in blocks:
            yield job(generator, seed, block)
    else:
        parallel = joblib.Parallel(n_jobs=workers, return_as="generator", batch_size=1)
        yield from parallel(joblib.delayed(job)(generator, seed, block) for block in blocks)


def _on_ray(
    job: Callable[[Generator, int, int], Result], generator: Generator, seed: int, blocks: list[int], workers: int
) -> Iterator[Result]:
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("ray", "ray") from error
    if not ray.is_initialized():
        ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, configure_logging=False)
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
        ratio = np.exp(rng.uniform(np.log(SEVERITY[0]), np.log(SEVERITY[1]), BLOCK))
        blows = shares.times(ratio * generator.thresholds(shares))
        response = generator.fracture(blows)
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


def draw_blows(surface: Surface, count: int, rng: np.random.Generator) -> tuple[Blows, IntArray]:
    """Blows whose severities add up to 1, and their kinds (N,).

    Single and scattered contacts are uniform over the area, in a cone about the inward normal. A landing is on a flat
    floor: the lowest points along a random way down. A ring is the end of a tube: points around a circle. Both push
    one way, within TILT. A grip is two opposite points pushed towards each other, equally hard.
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
        lowest = np.argpartition(up @ pool.T, 4 * CONTACTS, axis=1)[:, : 4 * CONTACTS]
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
        _, chosen = cKDTree(pool).query(centre[:, None] + radius[:, None, None] * around)
        face[ring], bary[ring] = pool_face[chosen], pool_bary[chosen]
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
        directions[grip, 0], directions[grip, 1] = inward, -inward
        share[grip, :2] = 1.0

    share /= share.sum(axis=1, keepdims=True)
    return Blows(face, bary, directions, share), kind
