"""The arrays of an asset, what follows from them once and for all, and the parts of it that an impulse can strike.

Every file of this room reads them; ``baking`` makes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import BoolArray, Float16Array, Float32Array, FloatArray, IntArray
from ..geometry.complex import CellComplex, Hull
from .atom_watershed import AtomWatershed
from .pieces import ConvexParts
from .rule import Interfaces, weakest_cut


@dataclass(frozen=True, eq=False)
class AssetArrays:
    """What is in an asset's file; lengths in units of the largest extent.

    V vertices, F faces, P points, M triangles, A atoms, I interfaces, H convex parts of atoms, B of the whole.

    Attributes
    ----------
    faces : ndarray of int64, shape (F, 3)
        Of the surface, whose vertices are the first V points.
    points : ndarray of float64, shape (P, 3)
        Of the atoms' complex, see `fracsim.geometry.complex.CellComplex`.
    triangles : ndarray of int64, shape (M, 3)
        Of the atoms' complex.
    sides : ndarray of int64, shape (M, 2)
        Of the atoms' complex.
    impact_field : ndarray of float32, shape (V, A)
        How strongly a unit impulse at each vertex moves each atom.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    areas : ndarray of float64, shape (I,)
        Of the jagged interfaces.
    normals : ndarray of float64, shape (I, 3)
        Unit mean normals, from the first atom to the second.
    projected : ndarray of float64, shape (I,)
        Areas projected on the mean normals.
    distances : ndarray of float16, shape (I, V)
        Geodesic distances from the interfaces' curves on the surface to the vertices.
    interface_vertices : ndarray of int64, shape (I, S)
        Vertices along these curves; -1 where an interface does not reach the surface.
    hull_points : ndarray of float64, shape (sum of sizes, 3)
        Corners of the atoms' convex parts, one part after the other.
    hull_faces : ndarray of int64, shape (sum of sizes, 3)
        Their faces.
    hull_sizes : ndarray of int64, shape (H, 2)
        How many points and faces each has.
    hull_atoms : ndarray of int64, shape (H,)
        The atom of each.
    body_points, body_faces, body_sizes : ndarray
        The same three of the convex parts of the whole body.
    compliance : ndarray of float64, shape (V,), or None
        How far the surface at each vertex gives way to a unit force, beyond what the body moves as a whole; in units of
        1 / (Young's modulus * largest extent). None where the simulator does not know it: then the body does not bend.
    """

    faces: IntArray
    points: FloatArray
    triangles: IntArray
    sides: IntArray
    impact_field: Float32Array
    pairs: IntArray
    areas: FloatArray
    normals: FloatArray
    projected: FloatArray
    distances: Float16Array
    interface_vertices: IntArray
    hull_points: FloatArray
    hull_faces: IntArray
    hull_sizes: IntArray
    hull_atoms: IntArray
    body_points: FloatArray
    body_faces: IntArray
    body_sizes: IntArray
    compliance: FloatArray | None = None

    @property
    def prepared(self) -> bool:
        """Whether all that a first break waits for has been worked out."""
        return "_prepared" in vars(self)

    def mark_prepared(self) -> None:
        """Note that it has."""
        object.__setattr__(self, "_prepared", True)

    # What follows from them, worked out once and shared by all sizes and materials of an asset

    @cached_property
    def complex(self) -> CellComplex:
        """The atoms as a complex."""
        return CellComplex(self.points, self.triangles, self.sides)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Volumes, first and second moments of the atoms, as `CellComplex.moments`."""
        return self.complex.moments()

    @cached_property
    def interfaces(self) -> Interfaces:
        """All interfaces."""
        return Interfaces(self.pairs, self.areas, self.normals, self.projected)

    @cached_property
    def vertex_atom(self) -> IntArray:
        """(V,) the atom of each vertex."""
        return self.complex.vertex_cells(len(self.impact_field))

    @cached_property
    def trace(self) -> tuple[IntArray, FloatArray]:
        """The vertices (U,) along any interface's curve, and distances to them (I, U).

        A segmentation asks for the field there and nowhere else.
        """
        vertices = np.unique(self.interface_vertices[self.interface_vertices >= 0])
        return vertices, np.ascontiguousarray(self.distances[:, vertices])

    @cached_property
    def atom_watershed(self) -> AtomWatershed:
        """The segmentation, of fields at the vertices of `trace`."""
        vertices, distances = self.trace
        interface_vertices = np.where(
            self.interface_vertices >= 0, np.searchsorted(vertices, self.interface_vertices), -1
        )
        return AtomWatershed.of(interface_vertices, distances, self.pairs, self.areas, self.complex.count)

    @cached_property
    def whole(self) -> Domain:
        """All atoms."""
        return Domain.of(np.arange(self.complex.count), self.interfaces, self.moments[0])

    @cached_property
    def atom_hulls(self) -> tuple[Hull, ...]:
        """Vertices and faces of the atoms' convex parts."""
        return split_hulls(self.hull_points, self.hull_faces, self.hull_sizes)

    @cached_property
    def whole_hulls(self) -> tuple[Hull, ...]:
        """Vertices and faces of the whole body's convex parts."""
        return split_hulls(self.body_points, self.body_faces, self.body_sizes)

    @cached_property
    def atom_convex_parts(self) -> ConvexParts:
        """The atoms' convex parts, as an engine takes them in."""
        return ConvexParts.of([points for points, _ in self.atom_hulls])

    @cached_property
    def whole_convex_parts(self) -> ConvexParts:
        """The whole body's convex parts, as an engine takes them in."""
        return ConvexParts.of([points for points, _ in self.whole_hulls])

    @cached_property
    def convex_parts_of_atom(self) -> list[list[int]]:
        """Which of the convex parts each atom has."""
        rows: list[list[int]] = [[] for _ in range(self.complex.count)]
        for k, atom in enumerate(self.hull_atoms.tolist()):
            rows[atom].append(k)
        return rows

    @cached_property
    def weakest(self) -> tuple[FloatArray, FloatArray]:
        """Severities (V,) and (V,) below which impacts on the faces around a vertex surely do nothing.

        Below the first, a single impact leaves one piece. Below the second, each of several impacts counted as a share
        of its own, not one interface breaks.
        """
        pairs = self.pairs
        jump = np.abs(self.impact_field[:, pairs[:, 0]] - self.impact_field[:, pairs[:, 1]]).astype(np.float64)
        # Between vertices the field is linear, so no jump there exceeds the largest around; and no direction
        # loads an interface by more than the whole jump, as neither κ nor β exceeds 1.
        start, end = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]).T
        order = np.argsort(start, kind="stable")  # a closed surface runs along every edge in both directions
        first = np.searchsorted(start[order], np.arange(len(jump)))
        jump = np.maximum(jump, np.maximum.reduceat(jump[end[order]], first))
        return 1.0 / weakest_cut(jump, pairs, self.complex.count), 1.0 / jump.max(axis=1)

    @cached_property
    def face_tree(self) -> cKDTree:
        """The middles of the faces, for searches by place."""
        return cKDTree(self.points[self.faces].mean(axis=1))


def split_hulls(points: FloatArray, faces: IntArray, sizes: IntArray) -> tuple[Hull, ...]:
    """Take apart hulls that are stored one after the other.

    Parameters
    ----------
    points : ndarray of float64, shape (sum of sizes, 3)
        Their vertices.
    faces : ndarray of int64, shape (sum of sizes, 3)
        Their faces, each hull's counted from its own first vertex.
    sizes : ndarray of int64, shape (H, 2)
        How many vertices and faces each has.

    Returns
    -------
    tuple of (ndarray of float64, shape (n, 3); ndarray of int64, shape (k, 3))
        The hulls, as views.
    """
    ends = np.cumsum(sizes, axis=0)[:-1].T
    return tuple(zip(np.split(points, ends[0]), np.split(faces, ends[1]), strict=True))


@dataclass(frozen=True)
class SimulatorRecord:
    """What an asset was baked from.

    Attributes
    ----------
    simulator : str
        Its name.
    min_severity : float
        The least total severity that broke one of the samples, halved to be safe.
    typical_severity : float
        The median severity at which a single impact first breaks the body, or opens a first crack where the simulator
        knows that sooner.
    driven_by_impact_field : bool
        Whether the simulator breaks what the breaking rule breaks under the impact field that the asset carries. Then
        the asset can answer as the simulator does; any other is known by its samples alone.
    severity_kind : str
        What severities are: "impulse", over mass, gauge and critical velocity; or "force", the peak force over tensile
        strength and the square of the largest extent.
    gauge : float
        Where they are impulses, the share of the critical velocity that breaks an interface.
    """

    simulator: str = "modal"
    min_severity: float = 0.0
    typical_severity: float = 1.0
    driven_by_impact_field: bool = True
    severity_kind: str = "impulse"
    gauge: float = 0.24  # of all files that do not say


@dataclass(frozen=True, eq=False)
class Domain:
    """The atoms of what is struck, all of an asset's or those of a piece, and the interfaces between two of them.

    Attributes
    ----------
    atoms : ndarray of int64, shape (A,)
        Which of the asset's atoms.
    interface_indices : ndarray of int64, shape (I,)
        Which of the asset's interfaces.
    interfaces : Interfaces
        These, with pairs that count within ``atoms``.
    is_inside : ndarray of bool, shape (all interfaces,)
        Which of the asset's interfaces are among them.
    volumes : ndarray of float64, shape (A,)
        In units of the largest extent.
    share : float
        Of the asset's volume.
    """

    atoms: IntArray
    interface_indices: IntArray
    interfaces: Interfaces
    is_inside: BoolArray
    volumes: FloatArray
    share: float

    @classmethod
    def of(cls, atoms: IntArray, interfaces: Interfaces, volumes: FloatArray) -> Self:
        """Take some atoms of an asset, and what holds them together.

        Parameters
        ----------
        atoms : ndarray of int64, shape (A,)
            Which.
        interfaces : Interfaces
            All of the asset's.
        volumes : ndarray of float64, shape (all atoms,)
            Of all of the asset's atoms.

        Returns
        -------
        Domain
            These atoms.
        """
        local = np.full(len(volumes), -1)
        local[atoms] = np.arange(len(atoms))
        pairs = local[interfaces.pairs]
        inside = np.asarray((pairs >= 0).all(axis=1))
        kept = Interfaces(
            pairs[inside], interfaces.areas[inside], interfaces.normals[inside], interfaces.projected[inside]
        )
        share = float(volumes[atoms].sum() / volumes.sum())
        return cls(atoms, np.flatnonzero(inside), kept, inside, volumes[atoms], share)
