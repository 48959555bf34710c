"""Convex parts of solids, those of different solids at least a gap apart. Needs the extra ``bake``.

Baking uses it for an asset's atoms, the worker of live decomposition for pieces. Because of the gap any grouping of
atoms into pieces starts free of overlap, which a physics engine would turn into speed.
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

BODY_VERTICES = 32  # corners of a convex part of the unbroken body, which is made once and seen longest


def decompose(
    surfaces: Sequence[Mesh],
    pairs: IntArray,
    normals: FloatArray,
    gap: float = GAP,
    price: float = PRICE,
    stage: Callable[[str], Callable[[float], None]] = lambda _: lambda _: None,
) -> list[list[FloatArray]]:
    """Decompose solids into convex parts that keep a gap.

    Every solid begins as one part, its hull, cut apart from its neighbours where the cut loses least. A part is split
    in two, or two are joined, as long as that is worth the price. Sample points measure what a part is worth: those of
    its own solid that it holds, less those of anything else.

    Parameters
    ----------
    surfaces : sequence of (vertices, faces)
        Watertight, of S solids that touch but do not overlap.
    pairs : ndarray of int64, shape (I, 2)
        The solids that meet at each interface.
    normals : ndarray of float64, shape (I, 3)
        Of the interfaces, from the first to the second; their planes are tried as cuts among others.
    gap : float
        How far parts of different solids stay apart, in units of the largest extent.
    price : float
        What one more part must gain; see ``convex_partition.PRICE``.
    stage : callable
        Makes a hearer of progress from a stage's name.

    Returns
    -------
    list of list of ndarray of float64, shape (n, 3)
        For each solid its parts, each as the corners of its hull.

    Raises
    ------
    BakeError
        If a solid loses its last part to its neighbours.
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
    """Cut existing convex parts until those of different solids keep a gap.

    Parameters
    ----------
    surfaces : sequence of (vertices, faces)
        Watertight, of S solids.
    parts : sequence of sequence of ndarray of float64, shape (n, 3)
        The convex parts of each solid.
    pairs, normals : ndarray
        As of ``decompose``.
    gap : float
        In units of the largest extent.
    progress : callable
        Hears the share that is done.

    Returns
    -------
    list of list of ndarray of float64, shape (m, 3)
        What is left of them, each as the corners of its hull.

    Raises
    ------
    BakeError
        If a solid loses its last part to its neighbours.
    """
    partition = ConvexPartition(surfaces, pairs, normals, gap)
    partition.begin([[manifold3d.Manifold.hull_points(points) for points in of_solid] for of_solid in parts])
    return partition.finish(progress)


def separate(surfaces: Sequence[Mesh], pairs: IntArray, normals: FloatArray, workers: int = 1) -> list[list[Hull]]:
    """Decompose surfaces that no bake has seen: CoACD on each, then cuts until they keep the gap.

    Parameters
    ----------
    surfaces : sequence of (vertices, faces)
        Watertight; lengths in units of the largest extent of all of them together.
    pairs, normals : ndarray
        As of ``decompose``; both may be empty.
    workers : int
        Processes for CoACD.

    Returns
    -------
    list of list of (points, faces)
        For each surface, its convex parts.

    Raises
    ------
    BakeError
        If a solid loses its last part to its neighbours.
    """
    clipped = clip_apart(surfaces, coacd_parts(surfaces, workers), pairs, normals)
    return [[(points, hull_faces(points)) for points in of_solid] for of_solid in clipped]


def convex_arrays(
    complex_: CellComplex,
    whole: Mesh,
    pairs: IntArray,
    normals: FloatArray,
    stage: Callable[[str], Callable[[float], None]] = lambda _: lambda _: None,
) -> dict[str, Any]:
    """Make the arrays of an asset that hold its convex parts.

    Parameters
    ----------
    complex_ : CellComplex
        Of the asset's atoms.
    whole : (vertices, faces)
        The asset's surface.
    pairs, normals : ndarray
        The asset's interfaces; as of ``decompose``.
    stage : callable
        Makes a hearer of progress from a stage's name.

    Returns
    -------
    dict of ndarray
        The attributes ``hull_...`` and ``body_...`` of ``fracture.arrays.AssetArrays``, by name.

    Raises
    ------
    BakeError
        If an atom loses its last convex part to its neighbours.
    """
    each_atom = np.eye(complex_.count, dtype=bool)
    parts = decompose([complex_.surface(chosen)[:2] for chosen in each_atom], pairs, normals, stage=stage)
    all_parts = [points for of_atom in parts for points in of_atom]
    body = [thin_hull(points, BODY_VERTICES) for points in coacd_parts([whole])[0]]
    body = covering(body, np.concatenate(all_parts))
    hulls, around = pack(all_parts), pack(body)
    return {
        "hull_points": hulls[0],
        "hull_faces": hulls[1],
        "hull_sizes": hulls[2],
        "hull_atoms": np.repeat(np.arange(len(parts)), [len(of_atom) for of_atom in parts]),
        "body_points": around[0],
        "body_faces": around[1],
        "body_sizes": around[2],
    }
