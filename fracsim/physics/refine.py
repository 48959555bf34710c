"""Convex parts made when something breaks rather than when it was baked: at once, or in the background.

Slower than any frame, finer where a piece is one that no bake has seen. Needs the extra ``bake``, when asked for.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import BakeError, MissingExtraError
from ..pieces import Parts, Piece
from .bodies import Body

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Surfaces = list[tuple[FloatArray, IntArray]]

WAYS = ("baked", "coacd", "background")


def require() -> None:
    """Raise MissingExtraError unless pieces can be decomposed here."""
    from importlib.util import find_spec

    for module in ("coacd", "manifold3d"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "bake")


def task(asset: Any, pieces: Sequence[Piece]) -> tuple[Surfaces, IntArray, FloatArray]:
    """Surfaces in units of the asset's largest extent, and the pairs (I, 2) of pieces with their borders' normals."""
    surfaces = [((piece.vertices - asset.offset) / asset.scale, piece.faces) for piece in pieces]
    arrays = asset.arrays
    owner = np.full(arrays.complex.count, -1)
    for k, piece in enumerate(pieces):
        owner[piece.atoms] = k
    ends = owner[arrays.pairs]
    apart = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
    ends, normals = ends[apart], arrays.normals[apart] * arrays.projected[apart][:, None]
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], normals[swap] = ends[swap][:, ::-1], -normals[swap]
    pairs, place = np.unique(ends, axis=0, return_inverse=True)
    total = np.zeros((len(pairs), 3))
    np.add.at(total, place.reshape(-1), normals)
    total /= np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None]
    return surfaces, pairs, total


def decomposed(surfaces: Surfaces, pairs: IntArray, normals: FloatArray) -> list[list[FloatArray]] | None:
    """The points of each surface's convex parts; None when a small one is left with nothing between the others."""
    from ..convex import separate

    try:
        return [[points for points, _ in some] for some in separate(surfaces, pairs, normals)]
    except BakeError:
        return None


def with_parts(asset: Any, pieces: Sequence[Piece], points: Sequence[Sequence[FloatArray]] | None) -> tuple[Piece, ...]:
    """The pieces with other convex parts. Without any, they all keep those that they were baked with, and a warning
    says so: the two kinds are not apart from one another."""
    if points is None:
        warnings.warn(f"{asset.name}: a piece is too small to decompose; baked parts are kept", RuntimeWarning, 2)
        return tuple(pieces)
    return tuple(
        replace(piece, parts=Parts.of(some, asset.scale, asset.offset))
        for piece, some in zip(pieces, points, strict=True)
    )


@cache
def _workers() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=get_context("forkserver"))


@dataclass(eq=False)
class Refinement:
    """Pieces whose convex parts are being made in another process.

    due: s, of the world's time, at which they take their place, ready or waited for, so that runs are the same.
    """

    asset: Any
    pieces: tuple[Piece, ...]
    bodies: list[Body]
    due: float
    future: Future[list[list[FloatArray]] | None]

    @classmethod
    def begun(cls, asset: Any, pieces: tuple[Piece, ...], bodies: list[Body], due: float) -> Refinement:
        return cls(asset, pieces, bodies, due, _workers().submit(decomposed, *task(asset, pieces)))

    def refined(self) -> tuple[Piece, ...]:
        """The pieces with their new parts, once these are there."""
        return with_parts(self.asset, self.pieces, self.future.result())
