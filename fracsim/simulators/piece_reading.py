"""From what is left of a lattice's faces to the pieces that a body falls into. ``structural`` reads them here.

Offline only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..fracture.rule import Interfaces, components
from ..solids.solid import sum_by_index
from .lattice_faces import CellFaces
from .merging import merge_bound
from .softening import GONE

HELD = 0.2  # mean share of its stiffness that a boundary between pieces has left, at most


@dataclass(frozen=True, eq=False)
class PieceReading:
    """How the N cells of a lattice are grouped into A atoms, and what joins these.

    Attributes
    ----------
    faces : CellFaces
        Between the cells.
    cell_volumes : ndarray of float64, shape (N,)
        Of the cells.
    atom_of_cell : ndarray of int64, shape (N,)
        The atom of each cell.
    atom_volumes : ndarray of float64, shape (A,)
        Of the atoms.
    interfaces : Interfaces
        The I interfaces between atoms, in the order of ``base.interfaces_between``.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the body's volume, join a neighbour.
    """

    faces: CellFaces
    cell_volumes: FloatArray
    atom_of_cell: IntArray
    atom_volumes: FloatArray
    interfaces: Interfaces
    min_piece_volume_fraction: float

    @cached_property
    def _interface_of_face(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Faces of the lattice between two atoms: which they are, the interface that each is part of, its share."""
        faces, pairs, count = self.faces, self.interfaces.pairs, len(self.atom_volumes)
        ends = np.sort(self.atom_of_cell[faces.pairs], axis=1)
        between = np.flatnonzero(ends[:, 0] != ends[:, 1])
        keys = pairs[:, 0] * count + pairs[:, 1]
        interface = np.searchsorted(keys, ends[between, 0] * count + ends[between, 1])
        area = sum_by_index(interface, faces.areas[between], len(pairs))
        return between, interface, faces.areas[between] / area[interface]

    def left_of_interfaces(self, left: FloatArray) -> FloatArray:
        """Work out what is left of the interfaces.

        Parameters
        ----------
        left : ndarray of float64
            The share of its stiffness that each face of the lattice has left.

        Returns
        -------
        ndarray of float64, shape (I,)
            The mean over the area; 0 where the lattice has come apart and the two atoms have gone with different parts
            of it.
        """
        between, interface, share = self._interface_of_face
        result = sum_by_index(interface, share * left[between], len(self.interfaces))
        part = components((left > GONE)[None], self.faces.pairs, len(self.atom_of_cell))[0]
        if part.any():
            # A crack may run through an atom, which then goes with the part that has most of it.
            shares = np.zeros((len(self.atom_volumes), part.max() + 1))
            np.add.at(shares, (self.atom_of_cell, part), self.cell_volumes)
            gone_with = np.argmax(shares, axis=1)[self.interfaces.pairs]
            result[gone_with[:, 0] != gone_with[:, 1]] = 0.0
        return result

    def pieces(self, left: FloatArray) -> IntArray:
        """Join the atoms that still hold together.

        Parameters
        ----------
        left : ndarray of float64, shape (I,)
            What is left of the interfaces.

        Returns
        -------
        ndarray of int64, shape (A,)
            The piece of each atom, from 0.
        """
        if left.min() >= HELD:
            return np.zeros(len(self.atom_volumes), dtype=np.int64)
        floor = self.min_piece_volume_fraction * float(self.atom_volumes.sum())
        return merge_bound(self.atom_volumes, self.interfaces.pairs, self.interfaces.areas, left, HELD, floor)
