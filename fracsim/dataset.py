"""Fracture samples: impulses drawn over a surface, and what the generator says they do. Offline only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .breaking import Interfaces, absorb_crumbs, components, drives, weakest_cut
from .mesh import Surface
from .sampling import CONE, SEVERITY, SurfacePoints, cone

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

CONTACTS = 6  # the most that act together in a sample
SEVERAL = 0.25  # share of samples with 2 to CONTACTS contacts, half of them landings on a flat floor
TEST, VALIDATION = 0.15, 0.1  # shares; validation is taken from what is not test
CHUNK = 512


@dataclass(frozen=True, eq=False)
class Generator:
    """The truth that everything learned is held against: modal fracture of one asset.

    surface: of largest extent 1. rows: (V, A), the impact field at each
    vertex. volumes: (A,). crumb_floor: fraction of the whole below which a piece joins a neighbour.
    """

    surface: Surface
    rows: FloatArray
    interfaces: Interfaces
    volumes: FloatArray
    crumb_floor: float

    def fracture(self, drive: FloatArray) -> IntArray:
        """(N, A) the piece of each atom, from the drives (N, I) of the interfaces."""
        labels = components(drive < 1.0, self.interfaces.pairs, len(self.volumes))
        share = self.volumes / self.volumes.sum()
        if share.min() >= self.crumb_floor:  # then no piece can be a crumb
            return labels
        return np.array([absorb_crumbs(row, share, self.interfaces, self.crumb_floor) for row in labels])


@dataclass(frozen=True, eq=False)
class Samples:
    """Impulses and their fractures.

    faces: (N, CONTACTS) and barycentric: (N, CONTACTS, 3), where on the surface; directions: (N, CONTACTS, 3).
    severities: (N, CONTACTS), impulse / (mass * breaking velocity), 0 where there is no contact.
    ratio: (N,), severity as a multiple of the one at which this very blow would first part the body.
    broken: (N, I), the interfaces that give way. labels: (N, A), the piece of each atom; an interface that broke
    within a piece, its sides being joined another way, parts nothing.
    split: (N,), 0 train, 1 validation, 2 test.
    """

    faces: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray
    ratio: FloatArray
    broken: BoolArray
    labels: IntArray
    split: IntArray

    def part(self, split: int) -> Samples:
        rows = self.split == split
        return Samples(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.ratio)


def sample(
    generator: Generator, count: int, rng: np.random.Generator, progress: Callable[[float], None] = lambda _: None
) -> Samples:
    """``count`` samples: points uniform over the area, directions uniform in a cone about the inward normal,
    severity log-uniform about the threshold; none is rejected, those that break nothing included."""
    surface = generator.surface
    pool = SurfacePoints(surface.vertices, surface.faces)
    contacts = np.ones(count, dtype=np.int64)
    several = rng.random(count) < SEVERAL
    contacts[several] = rng.integers(2, CONTACTS + 1, int(several.sum()))
    landing = several & (rng.random(count) < 0.5)
    face, bary = pool.draw(count * CONTACTS, rng)
    face, bary = face.reshape(count, CONTACTS), bary.reshape(count, CONTACTS, 3)
    directions = cone(-pool.normals[face.ravel()], CONE, rng).reshape(count, CONTACTS, 3)
    if landing.any():
        # A landing: the lowest points along a random way down, all pushed up within 10°.
        up = rng.standard_normal((int(landing.sum()), 3))
        up /= np.linalg.norm(up, axis=1)[:, None]
        many_face, many_bary = pool.draw(2048, rng)
        height = up @ pool.at(many_face, many_bary).T
        lowest = np.argpartition(height, 4 * CONTACTS, axis=1)[:, : 4 * CONTACTS]
        chosen = np.take_along_axis(lowest, rng.permuted(np.tile(np.arange(4 * CONTACTS), (len(up), 1)), axis=1), 1)
        chosen = chosen[:, :CONTACTS]
        face[landing], bary[landing] = many_face[chosen], many_bary[chosen]
        up = np.repeat(up, CONTACTS, axis=0)
        directions[landing] = cone(up, np.deg2rad(10.0), rng).reshape(-1, CONTACTS, 3)
    share = rng.exponential(size=(count, CONTACTS)) * (np.arange(CONTACTS) < contacts[:, None])
    share /= share.sum(axis=1, keepdims=True)
    ratio = np.exp(rng.uniform(np.log(SEVERITY[0]), np.log(SEVERITY[1]), count))
    severities = np.empty_like(share)
    broken = np.empty((count, len(generator.interfaces)), dtype=bool)
    labels = np.empty((count, len(generator.volumes)), dtype=np.int64)
    for start in range(0, count, CHUNK):
        rows = slice(start, start + CHUNK)
        field = pool.rows(generator.rows, face[rows], bary[rows])
        drive = drives(field, directions[rows], share[rows], generator.interfaces)  # is proportional to severity
        scale = ratio[rows] / weakest_cut(drive, generator.interfaces.pairs, len(generator.volumes))
        severities[rows] = share[rows] * scale[:, None]
        drive *= scale[:, None]
        broken[rows] = drive >= 1.0
        labels[rows] = generator.fracture(drive)
        progress(min(1.0, (start + CHUNK) / count))
    split = np.zeros(count, dtype=np.int64)
    order = rng.permutation(count)
    test = round(TEST * count)
    split[order[:test]] = 2
    split[order[test : test + round(VALIDATION * (count - test))]] = 1
    return Samples(face, bary, directions, severities, ratio, broken, labels, split)
