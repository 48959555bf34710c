"""A body as a lattice of rigid cells joined by springs, and its elastic answer to impacts. Offline only.

Every cell of a solid is a rigid body of six degrees of freedom; every face between two cells carries springs, normal
and tangential, of Young's modulus over the distance of the cells per area (Kawai 1978, *New discrete models and their
application to seismic response analysis of structures*; Bolander and Saito 1998, *Fracture analyses using spring
networks with random geometry*). The simulators ``structural`` and ``sequential`` take springs away or weaken them.

Lengths are in units of the body's largest extent L, stresses in units of Young's modulus E and densities in units of
the body's, so speeds are in c = sqrt(E / density) and forces in E L². All answers are linear in the force.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..geometry.locate import closest_on_triangles
from ..solids.solid import Solid
from .base import Impacts
from .lattice_faces import CellFaces
from .lattice_factor import Factor, factorise, filling_least
from .lattice_springs import cross_matrices, jump_matrices, normal_springs, springs, torsion_share
from .lattice_stress import principal_on

PATCH = 0.08  # of the largest extent: the standard deviation of the patch that a contact's force is spread over
BLOCK = 256  # forces that are solved for at a time, for memory
PATCH_REACH = 3.0  # standard deviations, along the body, beyond which a cell takes no part of the force


@dataclass(frozen=True, eq=False)
class Stiffness:
    """What is left of each face's springs.

    Attributes
    ----------
    left : ndarray of float64, shape (I,)
        Share of the stiffness of each face, above 0 and at most 1.
    closed : ndarray of bool, shape (I,)
        Faces under pressure, whose normal spring is whole whatever is left of the others: cracks carry pressure.
    """

    left: FloatArray
    closed: BoolArray


@dataclass(frozen=True, eq=False)
class Lattice:
    """Rigid cells joined by springs over their common faces.

    Attributes
    ----------
    cells : Solid
        N cells.
    faces : CellFaces
        The I faces between them.
    speed_number : float
        s = pi L / (t c), for contacts of duration t. The response to a force is (K + s² M)⁻¹: with the mass term a
        body that flies freely needs no support, and a body that is struck faster than it can answer moves less.
    """

    cells: Solid
    faces: CellFaces
    speed_number: float

    def __len__(self) -> int:
        """N, the number of cells."""
        return len(self.cells.volumes)

    def __getstate__(self) -> dict[str, Any]:
        # What goes to another process: all but the factorisation, which does not pickle and is made again there.
        return {name: value for name, value in vars(self).items() if name != "intact"}

    # Mass

    @cached_property
    def centroids(self) -> FloatArray:
        """(N, 3) of the cells."""
        return self.cells.centroids

    @cached_property
    def inertia(self) -> FloatArray:
        """(N, 3, 3), of each cell about its centroid, at density 1."""
        volume, first, second = self.cells.moments()
        central = second - np.einsum("ni,nj->nij", first, first) / volume[:, None, None]
        trace = np.trace(central, axis1=1, axis2=2)
        return np.asarray(trace[:, None, None] * np.eye(3) - central)

    @cached_property
    def mass_matrix(self) -> sp.csc_matrix:
        """(6 N, 6 N), at density 1."""
        blocks = np.zeros((len(self), 6, 6))
        blocks[:, range(3), range(3)] = self.cells.volumes[:, None]
        blocks[:, 3:, 3:] = self.inertia
        return sp.csc_matrix(sp.block_diag(list(blocks), format="csc"))

    @cached_property
    def rigid_motions(self) -> FloatArray:
        """(6 N, 6): the motions of the cells when the whole body moves or turns about the origin."""
        motions = np.zeros((len(self), 6, 6))
        motions[:, :3, :3] = motions[:, 3:, 3:] = np.eye(3)
        motions[:, :3, 3:] = -cross_matrices(self.centroids)
        return motions.reshape(-1, 6)

    @cached_property
    def rigid_mass(self) -> FloatArray:
        """(6, 6): the mass matrix of the body as one rigid body."""
        return np.asarray(self.rigid_motions.T @ (self.mass_matrix @ self.rigid_motions))

    # Springs

    @cached_property
    def jump_matrices(self) -> FloatArray:
        """(I, 6, 12): from the motions of a face's two cells to the jump across it (``lattice_springs``)."""
        return jump_matrices(self.faces, self.centroids)

    @cached_property
    def unknowns(self) -> IntArray:
        """(I, 12): where the motions of each face's two cells stand among the 6 N unknowns."""
        return np.asarray((6 * self.faces.pairs[:, :, None] + np.arange(6)).reshape(-1, 12))

    @cached_property
    def torsion_share(self) -> FloatArray:
        """(I,): the torsional stiffness of each face over that of its springs (``lattice_springs``)."""
        return torsion_share(self.faces)

    @cached_property
    def springs(self) -> FloatArray:
        """(I, 6, 6): from the jump across a face to the force and moment at its centroid."""
        return springs(self.faces, self.torsion_share)

    @cached_property
    def normal_springs(self) -> FloatArray:
        """(I, 6, 6): the part of the springs that carries pressure."""
        return normal_springs(self.faces)

    @cached_property
    def whole(self) -> Stiffness:
        """All springs, undamaged."""
        count = len(self.faces.areas)
        return Stiffness(np.ones(count), np.zeros(count, dtype=bool))

    # Solving

    @cached_property
    def _place(self) -> IntArray:
        """Where each unknown (6 N,) stands in the ordered system."""
        return np.asarray((6 * filling_least(self.faces.pairs, len(self))[:, None] + np.arange(6)).ravel())

    @cached_property
    def _pattern(self) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """Where each face's entries go in the ordered system: CSC indices, pointers, slots, and s² M's data."""
        n = 6 * len(self)
        place = self._place
        at = place[self.unknowns]
        rows, columns = np.repeat(at, 12, axis=1).ravel(), np.tile(at, (1, 12)).ravel()
        mass = self.mass_matrix.tocoo()
        key = np.concatenate([columns * n + rows, place[mass.col] * n + place[mass.row]])
        unique, slot = np.unique(key, return_inverse=True)
        slot = slot.reshape(-1)
        fixed = np.bincount(slot[len(rows) :], self.speed_number**2 * mass.data, minlength=len(unique)).astype(
            np.float64
        )
        pointers = np.searchsorted(unique, np.arange(n + 1) * n)
        return np.asarray(unique % n), np.asarray(pointers), np.asarray(slot[: len(rows)]), fixed

    @cached_property
    def _face_entries(self) -> tuple[FloatArray, FloatArray]:
        """(I, 144) each: the entries of each face's springs, and of its normal spring, in the system."""
        jump = self.jump_matrices
        turned = np.swapaxes(jump, 1, 2)
        count = len(jump)
        return (turned @ self.springs @ jump).reshape(count, -1), (turned @ self.normal_springs @ jump).reshape(
            count, -1
        )

    def factorise(self, stiffness: Stiffness | None = None) -> Factor:
        """Factorise K + s² M for what is left of the springs.

        Parameters
        ----------
        stiffness : Stiffness, optional
            All springs by default.

        Returns
        -------
        Factor
            It solves for any force.
        """
        stiffness = stiffness or self.whole
        indices, pointers, slot, fixed = self._pattern
        every, normal = self._face_entries
        entries = every * stiffness.left[:, None]
        shut = np.flatnonzero(stiffness.closed)
        entries[shut] += normal[shut] * (1.0 - stiffness.left[shut])[:, None]
        data = fixed + np.bincount(slot, entries.ravel(), minlength=len(indices))
        n = len(pointers) - 1
        system = sp.csc_matrix((data, indices, pointers), shape=(n, n))
        return factorise(system, self._place)

    @cached_property
    def intact(self) -> Factor:
        """The factorisation with all springs."""
        return self.factorise()

    # Forces

    @cached_property
    def _spread(self) -> FloatArray:
        """(N, N): distances from cell to cell along the body."""
        first, second = self.faces.pairs.T
        length = np.linalg.norm(self.centroids[first] - self.centroids[second], axis=1)
        graph = sp.coo_matrix((length, (first, second)), shape=(len(self), len(self)))
        return np.asarray(dijkstra(graph.tocsr(), directed=False))

    @cached_property
    def _outside(self) -> tuple[IntArray, IntArray, IntArray]:
        """Outer triangles in the order of their input faces: corners, cells, and where each face's begin."""
        outer = np.flatnonzero(self.cells.source >= 0)
        outer = outer[np.argsort(self.cells.source[outer], kind="stable")]
        begin = np.searchsorted(self.cells.source[outer], np.arange(self.cells.source.max() + 2))
        return self.cells.triangles[outer], self.cells.sides[outer, 0], begin

    def cell_at(self, face: int, point: FloatArray) -> int:
        """Find the cell at a point of the surface.

        Parameters
        ----------
        face : int
            The face of the surface that it lies on.
        point : ndarray of float64, shape (3,)
            The point.

        Returns
        -------
        int
            The cell.
        """
        triangles, cells, begin = self._outside
        rows = slice(begin[face], begin[face + 1])
        corner = self.cells.points[triangles[rows]]
        _, square = closest_on_triangles(np.broadcast_to(point, (1, 3)), corner[None])
        return int(cells[rows][np.argmin(square[0])])

    def force(self, cell: int, point: FloatArray, direction: FloatArray) -> FloatArray:
        """Spread a unit force at a point of the surface over the cells around it.

        Parameters
        ----------
        cell : int
            The cell at the point.
        point : ndarray of float64, shape (3,)
            Where it acts.
        direction : ndarray of float64, shape (3,)
            Unit vector.

        Returns
        -------
        ndarray of float64, shape (6 N,)
            Forces and moments on the cells. Their resultant is that of the force at the point. The patch is a
            Gaussian whose width does not depend on the cells; if it did, the load at which a first crack opens would
            halve with every refinement.
        """
        near = np.flatnonzero(self._spread[cell] <= PATCH_REACH * PATCH)
        square = ((self.centroids[near] - point) ** 2).sum(axis=1)
        weight = self.cells.volumes[near] * np.exp((square.min() - square) / (2.0 * PATCH**2))
        weight /= weight.sum()
        result = np.zeros((len(self), 6))
        result[near, :3] = weight[:, None] * direction
        result[near, 3:] = weight[:, None] * np.cross(point - weight @ self.centroids[near], direction)
        return result.ravel()

    def compliances(self, cells: IntArray, points: FloatArray, directions: FloatArray) -> FloatArray:
        """Compute how far a body gives way to a unit force at each of several points.

        Parameters
        ----------
        cells : ndarray of int64, shape (P,)
            The cell at each point.
        points : ndarray of float64, shape (P, 3)
            Where the forces act.
        directions : ndarray of float64, shape (P, 3)
            Unit vectors.

        Returns
        -------
        ndarray of float64, shape (P,)
            In 1 / (E L), without the motion of the body as a whole.
        """
        result = np.empty(len(points))
        for begin in range(0, len(points), BLOCK):
            rows = slice(begin, begin + BLOCK)
            contacts = zip(cells[rows].tolist(), points[rows], directions[rows], strict=True)
            forces = np.array([self.force(*contact) for contact in contacts])
            result[rows] = self.answer(forces, self.intact.solve(forces.T).T)[1]
        return result

    def forces(self, impacts: Impacts, points: FloatArray) -> FloatArray:
        """Spread the forces of impacts over the cells.

        Parameters
        ----------
        impacts : Impacts
            N impacts of up to K contacts; severities are forces.
        points : ndarray of float64, shape (N, K, 3)
            Where their contacts are.

        Returns
        -------
        ndarray of float64, shape (N, 6 C)
            Forces and moments on the C cells.
        """
        result = np.zeros((len(impacts), 6 * len(self)))
        for row, contact in np.argwhere(impacts.severities > 0.0).tolist():
            point = points[row, contact]
            cell = self.cell_at(int(impacts.faces[row, contact]), point)
            result[row] += impacts.severities[row, contact] * self.force(cell, point, impacts.directions[row, contact])
        return result

    def effective_mass(self, force: FloatArray) -> float:
        """Compute the mass that a unit force feels that moves the body as a rigid one.

        Parameters
        ----------
        force : ndarray of float64, shape (6 N,)
            The force, spread over the cells.

        Returns
        -------
        float
            At density 1.
        """
        whole = self.rigid_motions.T @ force
        return float(1.0 / (whole @ np.linalg.solve(self.rigid_mass, whole)))

    def answer(self, forces: FloatArray, motions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute how a body answers forces as a whole, and how far it gives way to them.

        Parameters
        ----------
        forces : ndarray of float64, shape (..., 6 N)
            On the cells.
        motions : ndarray of float64, shape (..., 6 N)
            What they make, u = (K + s² M)⁻¹ f.

        Returns
        -------
        moved : ndarray of float64, shape (...,)
            uᵀ M u. A body that moves as one has 1 / (s⁴ m) under a unit force, m the mass that the force feels.
        compliance : ndarray of float64, shape (...,)
            uᵀ K u: twice the energy in the springs.
        """
        rows = motions.reshape(-1, motions.shape[-1])
        moved = np.einsum("rn,rn->r", rows, (self.mass_matrix @ rows.T).T).reshape(motions.shape[:-1])
        work = np.einsum("...n,...n->...", forces, motions)
        return moved, np.maximum(work - self.speed_number**2 * moved, 0.0)

    # What a motion does to the faces

    def jumps(self, motions: FloatArray) -> FloatArray:
        """Compute the jump across every face.

        Parameters
        ----------
        motions : ndarray of float64, shape (6 N,)
            Of the cells.

        Returns
        -------
        ndarray of float64, shape (I, 6)
            Displacement at the face's centroid, and rotation.
        """
        return np.asarray(np.matmul(self.jump_matrices, motions[self.unknowns][:, :, None])[:, :, 0])

    def tractions(self, jumps: FloatArray, stiffness: Stiffness) -> FloatArray:
        """Compute the force that every face carries.

        Parameters
        ----------
        jumps : ndarray of float64, shape (I, 6)
            Across the faces.
        stiffness : Stiffness
            What is left of their springs.

        Returns
        -------
        ndarray of float64, shape (I, 3)
            On the first cell by the second.
        """
        faces = self.faces
        per_jump = faces.areas / faces.spring_lengths
        result = (per_jump * stiffness.left)[:, None] * jumps[:, :3]
        shut = np.flatnonzero(stiffness.closed)
        normal = faces.normals[shut]
        kept = (per_jump[shut] * (1.0 - stiffness.left[shut])) * np.einsum("fi,fi->f", normal, jumps[shut, :3])
        result[shut] += kept[:, None] * normal
        return np.asarray(result)

    @cached_property
    def _virial(self) -> tuple[sp.csr_matrix, FloatArray]:
        """Turns the faces' forces into mean stresses: incidence (N, 2 I) over volumes, and arms (2 I, 3)."""
        faces, count = self.faces, len(self.faces.areas)
        cell = faces.pairs.T.ravel()
        arm = np.concatenate([faces.centroids, faces.centroids]) - self.centroids[cell]
        arm[count:] *= -1.0
        over = 1.0 / self.cells.volumes[cell]
        return sp.csr_matrix((over, (cell, np.arange(2 * count))), shape=(len(self), 2 * count)), arm

    def cell_stresses(self, tractions: FloatArray) -> FloatArray:
        """Compute the mean stress of every cell.

        Parameters
        ----------
        tractions : ndarray of float64, shape (I, 3)
            The forces that the faces carry.

        Returns
        -------
        ndarray of float64, shape (N, 6)
            xx, yy, zz, yz, xz, xy; tension is positive.

        Notes
        -----
        The virial: the sum of force times arm over the faces of a cell, over its volume.
        """
        incidence, arm = self._virial
        force = np.concatenate([tractions, tractions])
        product = np.empty((len(force), 6))
        product[:, :3] = arm * force
        for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1)), start=3):
            product[:, k] = 0.5 * (arm[:, i] * force[:, j] + arm[:, j] * force[:, i])
        return np.asarray(incidence @ product)

    def tension(self, jumps: FloatArray, stiffness: Stiffness) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Compute how hard tension pulls on every face.

        Parameters
        ----------
        jumps : ndarray of float64, shape (I, 6)
            Across the faces.
        stiffness : Stiffness
            What is left of their springs.

        Returns
        -------
        tension : ndarray of float64, shape (I,)
            The largest principal stress times the cosine between its direction and the face's normal; 0 where it is
            no tension.
        cosine : ndarray of float64, shape (I,)
            That cosine.
        pressure : ndarray of bool, shape (I,)
            Faces whose force is a pressure.

        Notes
        -----
        The stress is the mean of the two cells', by volume, corrected so that its traction on the face is the
        springs' own at the corner where they are pulled hardest. The mean alone would miss bending within one cell;
        the springs alone know no stress along the face.
        """
        faces = self.faces
        force = self.tractions(jumps, stiffness)
        stress = self.cell_stresses(force)
        first, second = faces.pairs.T
        volume = self.cells.volumes
        share = (volume[first] / (volume[first] + volume[second]))[:, None]
        mean = share * stress[first] + (1.0 - share) * stress[second]
        normal = faces.normals
        turn = jumps[:, 3:]
        turn = turn - (np.einsum("fi,fi->f", turn, normal) * (1.0 - self.torsion_share))[:, None] * normal
        # The normal opening at corner y is n·(δ + ω × y) = n·δ + (n × ω)·y.
        arm = np.cross(normal, turn)
        opening = np.einsum("fki,fi->fk", faces.corners, arm)
        hardest = np.argmax(opening, axis=1)
        row = np.arange(len(hardest))
        corner = jumps[:, :3] + np.cross(turn, faces.corners[row, hardest])
        rate = 1.0 / faces.spring_lengths
        across = np.einsum("fi,fi->f", corner, normal)
        shut = stiffness.closed & (across < 0.0)
        traction = (rate * stiffness.left)[:, None] * corner
        traction[shut] += (rate * (1.0 - stiffness.left) * across)[shut, None] * normal[shut]
        pulled = across > 0.0
        value, vector = principal_on(mean, traction, normal)
        cosine = np.abs(np.einsum("fi,fi->f", vector, normal))
        tension = np.where(pulled & (value > 0.0), value * cosine, 0.0)
        return tension, cosine, np.einsum("fi,fi->f", force, normal) < 0.0
