"""A watershed whose basins are known beforehand: the atoms of a body join where no crack runs between them.

The query segments fields by it, and offline rooms those of a body that is no asset yet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ..common.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray
from .rule import components

# Vertices along a border that must stand high for the flood to pass: two, so that a border which other cracks run
# beside still counts as open, and a single wrong vertex does not open it.
HIGH_VERTICES = 2


def flooded_passes(
    udf: FloatArray, interface_vertices: IntArray, self_distance: FloatArray, height: float
) -> BoolArray:
    """Tell over which borders of given basins the flood passes: the merging step of a watershed.

    Parameters
    ----------
    udf : ndarray of float64, shape (V,)
        The field.
    interface_vertices : ndarray of int64, shape (R, S)
        Vertices along each border.
    self_distance : ndarray of float64, shape (R, S)
        Their distances to the border, which the field has there when the border is a crack.
    height : float
        How much higher than that the field stands, at two of the S vertices, where the flood passes.

    Returns
    -------
    ndarray of bool, shape (R,)
        Whether the flood passes.
    """
    high = udf[interface_vertices] - self_distance > height
    return np.asarray(np.count_nonzero(high, axis=1) >= HIGH_VERTICES)


@dataclass(frozen=True, eq=False)
class AtomWatershed:
    """The atoms of a body and where they meet, ready to segment many fields.

    Attributes
    ----------
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    count : int
        A, the number of atoms.
    interface_vertices : ndarray of int64, shape (R, S)
        Vertices along each interface that reaches the surface.
    self_distance : ndarray of float64, shape (R, S)
        Their distances to it.
    surface_interfaces : ndarray of int64, shape (R,)
        Which interfaces reach the surface.
    binding_interfaces : ndarray of int64, shape (B,)
        Interfaces that never part: an atom none of whose interfaces reaches the surface follows the neighbour that it
        shares most area with.
    """

    pairs: IntArray
    count: int
    interface_vertices: IntArray
    self_distance: FloatArray
    surface_interfaces: IntArray
    binding_interfaces: IntArray

    @classmethod
    def of(
        cls,
        interface_vertices: IntArray,
        distances: AnyFloatArray,
        pairs: IntArray,
        areas: FloatArray,
        count: int,
    ) -> Self:
        """Get the atoms of a body ready.

        Parameters
        ----------
        interface_vertices : ndarray of int64, shape (I, S)
            Vertices along every interface; -1 where it does not reach the surface.
        distances : ndarray, shape (I, V)
            Geodesic distances from the interfaces to the vertices.
        pairs : ndarray of int64, shape (I, 2)
            The atoms that meet at each interface.
        areas : ndarray of float64, shape (I,)
            Of the interfaces.
        count : int
            A, the number of atoms.

        Returns
        -------
        AtomWatershed
            To be asked for labels.
        """
        reached = np.flatnonzero(interface_vertices[:, 0] >= 0)
        self_distance = np.take_along_axis(distances[reached].astype(np.float64), interface_vertices[reached], axis=1)
        inner = np.setdiff1d(np.arange(count), pairs[reached])
        binding = [
            rows[np.argmax(areas[rows])]
            for atom in inner.tolist()
            if len(rows := np.flatnonzero((pairs == atom).any(axis=1)))
        ]
        return cls(pairs, count, interface_vertices[reached], self_distance, reached, np.array(binding, dtype=np.int64))

    def labels(self, udf: FloatArray, height: float, inside: BoolArray | None = None) -> IntArray:
        """Segment a field: atoms join where it stands above what a crack between them would leave.

        Parameters
        ----------
        udf : ndarray of float64, shape (V,)
            The field.
        height : float
            How far above that it must stand.
        inside : ndarray of bool, shape (I,), optional
            The interfaces across which atoms may join at all; every one by default.

        Returns
        -------
        ndarray of int64, shape (A,)
            The piece of each atom, from 0.
        """
        joined = np.zeros(len(self.pairs), dtype=bool)
        joined[self.surface_interfaces] = flooded_passes(udf, self.interface_vertices, self.self_distance, height)
        joined[self.binding_interfaces] = True
        if inside is not None:
            joined &= inside
        return components(joined[None], self.pairs, self.count)[0]
