"""TODO fracture.arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..geometry.complex import CellComplex, vertex_cells
from .atom_watershed import AtomWatershed
from .pieces import ConvexParts
from .rule import Interfaces, weakest_cut


@dataclass(frozen=True, eq=False)
class AssetArrays:
    """What is in the file, lengths in units of the largest extent.

    faces: (F, 3) of the surface, whose vertices are the first V points. points, triangles, sides: the atoms'
    complex. rows: (V, A) impact field. pairs, areas, normals, projected: the interfaces.
    distances: (I, V) geodesic distances to their curves. interface_vertices: (I, S) vertices along these, -1 where an
    interface does not reach the surface. hull_points, hull_faces: the atoms' convex parts one after the other,
    with hull_sizes (H, 2) points and faces in each, and hull_atoms (H,); body_...: those of the whole.
    """

    faces: IntArray
    points: FloatArray
    triangles: IntArray
    sides: IntArray
    impact_field: npt.NDArray[np.float32]
    pairs: IntArray
    areas: FloatArray
    normals: FloatArray
    projected: FloatArray
    distances: npt.NDArray[np.float16]
    interface_vertices: IntArray
    hull_points: FloatArray
    hull_faces: IntArray
    hull_sizes: IntArray
    hull_atoms: IntArray
    body_points: FloatArray
    body_faces: IntArray
    body_sizes: IntArray

    # What follows from them, worked out once and shared by all sizes and materials of an asset

    @cached_property
    def complex(self) -> CellComplex:
        return CellComplex(self.points, self.triangles, self.sides)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.complex.moments()

    @cached_property
    def interfaces(self) -> Interfaces:
        return Interfaces(self.pairs, self.areas, self.normals, self.projected)

    @cached_property
    def vertex_atom(self) -> IntArray:
        """(V,) the atom of each vertex."""
        return vertex_cells(self.triangles, self.sides, len(self.points))[: len(self.impact_field)]

    @cached_property
    def trace(self) -> tuple[IntArray, FloatArray]:
        """(U,) the vertices along any shore, all that a segmentation asks a field for, and their distances (I, U)."""
        vertices = np.unique(self.interface_vertices[self.interface_vertices >= 0])
        return vertices, np.ascontiguousarray(self.distances[:, vertices])

    @cached_property
    def atom_watershed(self) -> AtomWatershed:
        """On the vertices of the coast."""
        vertices, distances = self.trace
        interface_vertices = np.where(
            self.interface_vertices >= 0, np.searchsorted(vertices, self.interface_vertices), -1
        )
        return AtomWatershed.of(interface_vertices, distances, self.pairs, self.areas, self.complex.count)

    @cached_property
    def whole(self) -> Domain:
        return Domain.of(np.arange(self.complex.count), self.interfaces, self.moments[0])

    @cached_property
    def atom_convex_parts(self) -> ConvexParts:
        """The atoms' convex parts."""
        return ConvexParts.of(np.split(self.hull_points, np.cumsum(self.hull_sizes[:, 0])[:-1]))

    @cached_property
    def whole_convex_parts(self) -> ConvexParts:
        return ConvexParts.of(np.split(self.body_points, np.cumsum(self.body_sizes[:, 0])[:-1]))

    @cached_property
    def convex_parts_of_atom(self) -> list[list[int]]:
        """Which of the parts each atom has."""
        rows: list[list[int]] = [[] for _ in range(self.complex.count)]
        for k, atom in enumerate(self.hull_atoms.tolist()):
            rows[atom].append(k)
        return rows

    @cached_property
    def weakest(self) -> tuple[FloatArray, FloatArray]:
        """(V,) severities below which no point of the faces around a vertex can be hit to any effect: by one
        impact, nothing parts; by several, each counted as a share of its own, no interface even breaks."""
        pairs = self.pairs
        jump = np.abs(self.impact_field[:, pairs[:, 0]] - self.impact_field[:, pairs[:, 1]]).astype(np.float64)
        # Between vertices the field is linear, so no jump there exceeds the largest around; and no direction
        # drives an interface by more than the whole jump, as neither κ nor β exceeds 1.
        start, end = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]).T
        order = np.argsort(start, kind="stable")  # a closed surface runs along every edge in both directions
        first = np.searchsorted(start[order], np.arange(len(jump)))
        jump = np.maximum(jump, np.maximum.reduceat(jump[end[order]], first))
        return 1.0 / weakest_cut(jump, pairs, self.complex.count), 1.0 / jump.max(axis=1)

    @cached_property
    def face_tree(self) -> cKDTree:
        return cKDTree(self.points[self.faces].mean(axis=1))


@dataclass(frozen=True)
class SimulatorRecord:
    """What the asset was baked from. kind: "modal", whose impact field the asset carries and can answer from; any
    other is known by its samples alone. least: total severity below which none of these broke, halved to be safe.
    typical: the median one at which a single impact first parts the body.
    """

    simulator: str = "modal"
    min_severity: float = 0.0
    typical_severity: float = 1.0


@dataclass(frozen=True, eq=False)
class Domain:
    """The atoms (A,) of what is struck, all of an asset's or those of a piece, and what holds them together: the
    interfaces between two of them, ``rows`` (I,) of the asset's, with pairs that count within the domain.

    inside: (all interfaces,), which they are. volumes: (A,). share: of the asset's volume.
    """

    atoms: IntArray
    interface_indices: IntArray
    interfaces: Interfaces
    is_inside: npt.NDArray[np.bool_]
    volumes: FloatArray
    share: float

    @classmethod
    def of(cls, atoms: IntArray, interfaces: Interfaces, volumes: FloatArray) -> Domain:
        local = np.full(len(volumes), -1)
        local[atoms] = np.arange(len(atoms))
        pairs = local[interfaces.pairs]
        inside = np.asarray((pairs >= 0).all(axis=1))
        kept = Interfaces(
            pairs[inside], interfaces.areas[inside], interfaces.normals[inside], interfaces.projected[inside]
        )
        share = float(volumes[atoms].sum() / volumes.sum())
        return cls(atoms, np.flatnonzero(inside), kept, inside, volumes[atoms], share)
