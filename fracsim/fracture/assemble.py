"""From labels to pieces: which atoms make a piece, and its exact mass properties; the query's last step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..common.arrays import FloatArray, IntArray
from ..geometry.complex import mass_of_moments
from .arrays import AssetArrays
from .pieces import LatePieceShape, Piece


def mass_properties(
    arrays: AssetArrays, atoms: IntArray, density: float, scale: float, offset: FloatArray
) -> tuple[float, float, FloatArray, FloatArray]:
    """Add up the moments of some atoms.

    Parameters
    ----------
    arrays : AssetArrays
        Those of the asset.
    atoms : ndarray of int64, shape (n,)
        Which of its atoms.
    density : float
        kg/m³.
    scale : float
        m, the asset's largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the origin of the arrays' units lies.

    Returns
    -------
    volume : float
        m³.
    mass : float
        kg.
    center : ndarray of float64, shape (3,)
        m, the centre of mass.
    inertia : ndarray of float64, shape (3, 3)
        kg·m² about the centre of mass.
    """
    zeroth, first, second = (moment[atoms].sum(axis=0) for moment in arrays.moments)
    return mass_of_moments(float(zeroth), first, second, density, scale, offset)


def assemble_pieces(
    arrays: AssetArrays, groups: Sequence[IntArray], density: float, scale: float, offset: FloatArray
) -> tuple[Piece, ...]:
    """Make a piece of every group of atoms.

    Parameters
    ----------
    arrays : AssetArrays
        Those of the asset.
    groups : sequence of ndarray of int64, shape (n,) each
        The atoms of each piece.
    density : float
        kg/m³.
    scale : float
        m, the asset's largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the origin of the arrays' units lies.

    Returns
    -------
    tuple of Piece
        One a group. Their surfaces and hulls are not worked out yet.
    """
    parts = replace(arrays.atom_convex_parts, scale=scale, offset=offset)
    pieces = []
    for atoms in groups:
        volume, mass, center, inertia = mass_properties(arrays, atoms, density, scale, offset)
        chosen = [part for atom in atoms.tolist() for part in arrays.convex_parts_of_atom[atom]]
        shape = LatePieceShape(arrays.complex, atoms, arrays.atom_hulls, chosen, scale, offset)
        pieces.append(Piece(volume, mass, center, inertia, parts.select(chosen), atoms, shape))
    return tuple(pieces)
