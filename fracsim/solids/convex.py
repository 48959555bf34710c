"""Convex parts of solids, no two solids' parts nearer to one another than a gap. Needs the extra ``bake``.

Any grouping of atoms into pieces then starts free of overlap, which a physics engine would turn into speed. What a
part is worth is told by sample points: those of its own solid that it holds, less those of anything else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from ..geometry.complex import CellComplex, Hull
from .convex_partition import GAP, PRICE, ConvexPartition
from .hulls import Mesh, as_manifold, coacd_parts, covering, hull_faces, pack, thin_hull

try:
    import manifold3d
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

BODY_VERTICES = 32  # of the unbroken body's, made once and seen more


def decompose(
    surfaces: Sequence[Mesh],
    pairs: IntArray,
    normals: FloatArray,
    gap: float = GAP,
    price: float = PRICE,
    stage: Callable[[str], Callable[[float], None]] = lambda _: lambda _: None,
) -> list[list[FloatArray]]:
    """Convex parts of each watertight surface, as point sets (n, 3) that are their own hulls, ``gap`` apart.

    Every solid begins as one part, its hull, cut apart from its neighbours where least is lost; a part is split in
    two, or two are joined, as long as that is worth ``price``.
    pairs (I, 2), normals (I, 3): the solids' interfaces, whose mean planes are tried as cuts among others.
    """
    progress = stage("convex")
    partition = ConvexPartition(surfaces, pairs, normals, gap)
    partition.begin([[as_manifold(*surface)] for surface in surfaces])
    partition.refine(price, progress)
    return partition.finish(stage("clipping"))


def clip_apart(
    surfaces: Sequence[Mesh],
    parts: Sequence[Sequence[FloatArray]],
    pairs: IntArray,
    normals: FloatArray,
    gap: float = GAP,
    progress: Callable[[float], None] = lambda _: None,
) -> list[list[FloatArray]]:
    """Cut given convex parts of each surface, point sets, by planes until those of different surfaces keep ``gap``
    between them; see ``decompose``."""
    partition = ConvexPartition(surfaces, pairs, normals, gap)
    partition.begin([[manifold3d.Manifold.hull_points(points) for points in some] for some in parts])
    return partition.finish(progress)


def separate(surfaces: Sequence[Mesh], pairs: IntArray, normals: FloatArray, workers: int = 1) -> list[list[Hull]]:
    """Convex parts of surfaces that no bake has seen: CoACD on each, then cut apart. Points and faces of each part.

    Lengths are in units of the largest extent of all. pairs, normals: as ``decompose`` has them; both may be empty.
    """
    clipped = clip_apart(surfaces, coacd_parts(surfaces, workers), pairs, normals)
    return [[(points, hull_faces(points)) for points in some] for some in clipped]


def convex_arrays(
    complex_: CellComplex,
    whole: Mesh,
    pairs: IntArray,
    normals: FloatArray,
    stage: Callable[[str], Callable[[float], None]] = lambda _: lambda _: None,
) -> dict[str, Any]:
    """The arrays of an asset that hold its convex parts, from its atoms' complex, its surface and its interfaces."""
    one = np.eye(complex_.count, dtype=bool)
    parts = decompose([complex_.surface(row)[:2] for row in one], pairs, normals, stage=stage)
    body = [thin_hull(points, BODY_VERTICES) for points in coacd_parts([whole])[0]]
    body = covering(body, np.concatenate([points for some in parts for points in some]))
    hulls, around = pack([points for some in parts for points in some]), pack(body)
    return {
        "hull_points": hulls[0],
        "hull_faces": hulls[1],
        "hull_sizes": hulls[2],
        "hull_atoms": np.repeat(np.arange(len(parts)), [len(some) for some in parts]),
        "body_points": around[0],
        "body_faces": around[1],
        "body_sizes": around[2],
    }
