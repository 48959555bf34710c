"""Convex parts made when something breaks rather than when it was baked: at once, or in the background.

Slower than any frame, finer where a piece is one that no bake has seen. Needs the extra ``bake``, when asked for.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.arrays import FloatArray
from ..common.errors import FracsimError, MissingExtraError
from ..fracture.pieces import ConvexParts, Piece
from .convex_worker import Answer, Task, decompose_pieces, worker

if TYPE_CHECKING:
    from .bodies import Body


DECOMPOSITIONS = ("baked", "coacd", "background")


def require_decomposition() -> None:
    """Raise MissingExtraError unless pieces can be decomposed here."""
    from importlib.util import find_spec

    for module in ("coacd", "manifold3d"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "bake")


def decomposition_task(asset: Any, pieces: Sequence[Piece]) -> Task:
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


def with_parts(
    asset: Any,
    pieces: Sequence[Piece],
    points: Sequence[Sequence[FloatArray]] | None,
    fault: str = "a piece is too small to decompose",
) -> tuple[Piece, ...]:
    """The pieces with other convex parts. Without any, they all keep those that they were baked with, and a warning
    says so and why: the two kinds are not apart from one another."""
    if points is None:
        warnings.warn(f"{asset.name}: {fault}; baked parts are kept", RuntimeWarning, 2)
        return tuple(pieces)
    return tuple(
        replace(piece, convex_parts=ConvexParts.of(some, asset.scale, asset.offset))
        for piece, some in zip(pieces, points, strict=True)
    )


def refined_now(asset: Any, pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """The pieces with parts made at once; as they were if that goes wrong."""
    try:
        return with_parts(asset, pieces, decompose_pieces(*decomposition_task(asset, pieces)))
    except Exception as error:  # of another library's
        return with_parts(asset, pieces, None, f"its pieces were not decomposed ({error})")


@dataclass(eq=False)
class Refinement:
    """Pieces whose convex parts are being made in another process.

    due: s, of the world's time, at which they take their place, ready or waited for, so that runs are the same.
    """

    asset: Any
    pieces: tuple[Piece, ...]
    bodies: list[Body]
    due: float
    future: Future[Answer]

    @classmethod
    def begun(cls, asset: Any, pieces: tuple[Piece, ...], bodies: list[Body], due: float) -> Refinement:
        return cls(asset, pieces, bodies, due, worker(os.getpid()).submit(decomposition_task(asset, pieces)))

    def refined(self) -> tuple[Piece, ...]:
        """The pieces with their new parts, once these are there; as they were if that went wrong."""
        try:
            return with_parts(self.asset, self.pieces, self.future.result())
        except FracsimError as error:
            return with_parts(self.asset, self.pieces, None, str(error))
