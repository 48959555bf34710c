"""Watershed whose basins are known beforehand: the atoms of a body, which join where no crack runs between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import BoolArray, FloatArray, IntArray
from .rule import components


def flooded_passes(udf: FloatArray, interface_vertices: IntArray, own: FloatArray, height: float) -> BoolArray:
    """Which of a set of given basins' borders the flood passes over: the merging step of a watershed whose
    basins are known beforehand (the asset's atoms).

    interface_vertices: (I, S) vertices along each border. own: (I, S) their distances to it, which the field reads there
    when the border is a crack. The flood passes where the field stands more than ``height`` above that, at the
    second highest of the S: a border that other cracks run beside is still high somewhere.
    """
    return np.asarray(np.count_nonzero(udf[interface_vertices] - own > height, axis=1) >= 2)


@dataclass(frozen=True, eq=False)
class AtomWatershed:
    """A atoms and the I interfaces between them, ``pairs`` (I, 2).

    reached: (R,), the interfaces that reach the surface; interface_vertices (R, S), vertices along each, and own (R, S), their
    distances to it. bound: interfaces that bind inner atoms: one that no curve borders follows the neighbour it shares
    most area with.
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
        distances: npt.NDArray[np.floating[Any]],
        pairs: IntArray,
        areas: FloatArray,
        count: int,
    ) -> Self:
        """interface_vertices: (I, S) vertices along every interface, or -1. distances: (I, V) geodesic. areas: (I,)."""
        reached = np.flatnonzero(interface_vertices[:, 0] >= 0)
        own = np.take_along_axis(distances[reached].astype(np.float64), interface_vertices[reached], axis=1)
        inner = np.setdiff1d(np.arange(count), pairs[reached])
        bound = [
            rows[np.argmax(areas[rows])]
            for atom in inner.tolist()
            if len(rows := np.flatnonzero((pairs == atom).any(axis=1)))
        ]
        return cls(pairs, count, interface_vertices[reached], own, reached, np.array(bound, dtype=np.int64))

    def labels(self, udf: FloatArray, height: float, inside: BoolArray | None = None) -> IntArray:
        """(A,) pieces of a field (V,): atoms join where it stands more than ``height`` above what a crack between them
        would leave. inside: (I,), the interfaces that may join at all; without, every one."""
        joined = np.zeros(len(self.pairs), dtype=bool)
        joined[self.surface_interfaces] = flooded_passes(udf, self.interface_vertices, self.self_distance, height)
        joined[self.binding_interfaces] = True
        if inside is not None:
            joined &= inside
        return components(joined[None], self.pairs, self.count)[0]
