"""Convex parts made when something breaks rather than when it was baked: at once, or in the background.

The replacement uses them where the world's `decomposition` says so. They take longer than any frame, and are finer
where a piece is one that no bake has seen. Needs the extra ``bake``, when asked for.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..common.arrays import FloatArray
from ..common.errors import BakeError, MissingExtraError, PhysicsError
from ..fracture.asset import BreakableAsset
from ..fracture.breakable_piece import BreakablePiece
from ..fracture.pieces import ConvexParts, Piece
from .convex_worker import Answer, Task, decompose_pieces, worker

if TYPE_CHECKING:
    from .bodies import Body

DECOMPOSITIONS = ("baked", "coacd", "background")


def require_decomposition() -> None:
    """Refuse to go on unless pieces can be decomposed here.

    Raises
    ------
    MissingExtraError
        Where a library of the extra ``bake`` is not installed.
    """
    from importlib.util import find_spec

    for module in ("coacd", "manifold3d"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "bake")


def asset_of(breakable: object) -> BreakableAsset:
    """Find the baked asset behind something that breaks, whose arrays a decomposition needs.

    Parameters
    ----------
    breakable : object
        An asset, or a piece of one.

    Returns
    -------
    BreakableAsset
        The asset.

    Raises
    ------
    PhysicsError
        Where it is an object of a user's own.
    """
    if isinstance(breakable, BreakablePiece):
        return breakable.asset
    if isinstance(breakable, BreakableAsset):
        return breakable
    raise PhysicsError(
        f"only baked assets can be decomposed as they break, not {breakable!r:.80}; use decomposition='baked'"
    )


def decomposition_task(asset: BreakableAsset, pieces: Sequence[Piece]) -> Task:
    """Put together what a decomposition of pieces needs.

    Parameters
    ----------
    asset : BreakableAsset
        The asset that broke.
    pieces : sequence of Piece
        K of its pieces.

    Returns
    -------
    surfaces : list of tuple of ndarray
        Vertices and faces of each piece, in units of the asset's largest extent.
    pairs : ndarray of int64, shape (I, 2)
        Pieces that meet, the smaller index first.
    normals : ndarray of float64, shape (I, 3)
        Mean normal of the border of each pair, from the first to the second.
    """
    surfaces = [((piece.vertices - asset.offset) / asset.scale, piece.faces) for piece in pieces]
    arrays = asset.arrays
    owner = np.full(arrays.complex.count, -1)
    for k, piece in enumerate(pieces):
        owner[piece.atoms] = k
    ends = owner[arrays.pairs]
    apart = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
    ends, normals = ends[apart], arrays.normals[apart] * arrays.projected[apart][:, None]
    is_reversed = ends[:, 0] > ends[:, 1]
    ends[is_reversed], normals[is_reversed] = ends[is_reversed][:, ::-1], -normals[is_reversed]
    pairs, place = np.unique(ends, axis=0, return_inverse=True)
    total = np.zeros((len(pairs), 3))
    np.add.at(total, place.reshape(-1), normals)
    total /= np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None]  # 1e-12: no division by zero
    return surfaces, pairs, total


def with_parts(
    asset: BreakableAsset,
    pieces: Sequence[Piece],
    points: Sequence[Sequence[FloatArray]] | None,
    fault: str = "a piece is too small to decompose",
) -> tuple[Piece, ...]:
    """Give pieces other convex parts; without any, all of them keep those that they were baked with.

    All or none, since the two kinds are not apart from one another.

    Parameters
    ----------
    asset : BreakableAsset
        The asset that broke.
    pieces : sequence of Piece
        Its pieces.
    points : sequence of sequences of ndarray, or None
        Points of the convex parts of each piece, in units of the asset's largest extent; None gives a warning.
    fault : str
        Why there are none, for that warning.

    Returns
    -------
    tuple of Piece
        The pieces, with the new parts or as they were.
    """
    if points is None:
        warnings.warn(f"{asset.name}: {fault}; baked parts are kept", RuntimeWarning, 2)
        return tuple(pieces)
    return tuple(
        replace(piece, convex_parts=ConvexParts.of(parts, asset.scale, asset.offset))
        for piece, parts in zip(pieces, points, strict=True)
    )


def refined_now(asset: BreakableAsset, pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """Make convex parts for pieces and wait for them.

    Parameters
    ----------
    asset : BreakableAsset
        The asset that broke.
    pieces : sequence of Piece
        Its pieces.

    Returns
    -------
    tuple of Piece
        The pieces with new parts, or, with a warning, as they were where the decomposition failed.
    """
    task = decomposition_task(asset, pieces)
    try:
        return with_parts(asset, pieces, decompose_pieces(*task))
    except BakeError as error:
        return with_parts(asset, pieces, None, str(error))


@dataclass(eq=False)
class Refinement:
    """Pieces whose convex parts are being made in another process.

    Attributes
    ----------
    asset : BreakableAsset
        The asset that broke.
    pieces : tuple of Piece
        Its pieces.
    bodies : list of Body
        The bodies of these.
    due : float
        When the parts take their place, s of the world's time; ready, or waited for, so that runs are the same.
    future : Future
        The answer of the other process.
    """

    asset: BreakableAsset
    pieces: tuple[Piece, ...]
    bodies: list[Body]
    due: float
    future: Future[Answer]

    @classmethod
    def begun(cls, asset: BreakableAsset, pieces: tuple[Piece, ...], bodies: list[Body], due: float) -> Refinement:
        """Begin to make convex parts.

        Parameters
        ----------
        asset, pieces, bodies, due
            As the attributes of this class.

        Returns
        -------
        Refinement
            The work in progress.
        """
        return cls(asset, pieces, bodies, due, worker(os.getpid()).submit(decomposition_task(asset, pieces)))

    def refined(self) -> tuple[Piece, ...]:
        """Wait for the parts.

        Returns
        -------
        tuple of Piece
            The pieces with new parts, or, with a warning, as they were where the decomposition failed.
        """
        try:
            return with_parts(self.asset, self.pieces, self.future.result())
        except BakeError as error:
            return with_parts(self.asset, self.pieces, None, str(error))
