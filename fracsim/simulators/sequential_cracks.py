"""A lattice that loses its faces one by one, and how much load each of those that are left can bear.

``sequential`` runs impacts on it, and ``crack_ramp`` here static loads. Offline only.

Taking a face away changes the system of equations by a matrix of rank 6, so that its inverse, and every face's
compliance, follow by Woodbury's identity; nothing is factorised again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..fracture.rule import components
from .lattice import Lattice, Stiffness

WHOLE, PRESSED, OPEN = 0, 1, 2  # what has become of a face; a pressed one is broken and still carries pressure
LEAST_COSINE = 0.3  # between a crack and the direction that is pulled in, as far as the crack's energy is concerned
OPENS = 1e-9  # of the largest pressure on a crack: a pull below it is rounding
SINGULAR = 1e-11  # of springs that go: what the rest of the body adds to their hold, at least; less is a mechanism
REGULAR = 1e-9  # added to 1 where a face alone holds two parts together


@dataclass(frozen=True, eq=False)
class IntactBody:
    """What never changes about a lattice: the inverse of its system, dense, and the compliance of each face.

    Attributes
    ----------
    lattice : Lattice
        Of N cells and I faces.
    """

    lattice: Lattice

    @cached_property
    def inverse(self) -> FloatArray:
        """(6 N, 6 N): (K + s² M)⁻¹."""
        result = self.lattice.intact.solve(np.eye(6 * len(self.lattice)))
        return np.asarray(0.5 * (result + result.T))

    @cached_property
    def compliances(self) -> FloatArray:
        """(I, 6, 6): the jump across each face that a unit force and moment on both of its sides make."""
        at, jump = self.lattice.unknowns, self.lattice.jump_matrices
        return np.asarray(jump @ self.inverse[at[:, :, None], at[:, None, :]] @ np.swapaxes(jump, 1, 2))

    @cached_property
    def jump_table(self) -> sp.csr_matrix:
        """(6 I, 6 N): from motions to the jumps across all faces."""
        count = len(self.lattice.faces)
        pointers = np.arange(6 * count + 1) * 12
        columns = np.repeat(self.lattice.unknowns, 6, axis=0).ravel()
        shape = (6 * count, 6 * len(self.lattice))
        return sp.csr_matrix((self.lattice.jump_matrices.ravel(), columns, pointers), shape=shape)


class Cracks:
    """The cracks in a body, and its answer to a pattern of forces as they grow.

    Everything is linear in the forces while no face breaks: stresses grow with the load, energies with its square.

    Parameters
    ----------
    body : IntactBody
        Of N cells and I faces.
    brittleness : float
        E G_c / (strength² L).
    forces : ndarray of float64, shape (6 N,)
        On the cells, in strength times L².

    Attributes
    ----------
    state : ndarray of int64, shape (I,)
        WHOLE, PRESSED or OPEN.
    compliances : ndarray of float64, shape (I, 6, 6)
        Of the faces, as the body is now.
    forces, motions : ndarray of float64, shape (6 N,)
        The forces, and what they make.
    """

    def __init__(self, body: IntactBody, brittleness: float, forces: FloatArray) -> None:
        self.body, self.lattice, self.brittleness = body, body.lattice, brittleness
        self.state = np.zeros(len(self.lattice.faces), dtype=np.int64)
        self.compliances = body.compliances.copy()
        self.forces, self.motions = forces, self.lattice.intact.solve(forces)
        # The inverse now is the intact one's plus U Uᵀ, U the first columns of this.
        self._updates = np.empty((6 * len(self.lattice), 384), order="F")
        self._rank = 0

    @property
    def whole(self) -> BoolArray:
        """(I,): faces that hold."""
        return np.asarray(self.state == WHOLE)

    @property
    def stiffness(self) -> Stiffness:
        """What is left of each face's springs."""
        return Stiffness(self.whole.astype(float), self.state == PRESSED)

    @property
    def labels(self) -> IntArray:
        """(N,): the piece of each cell."""
        return components(self.whole[None], self.lattice.faces.pairs, len(self.lattice))[0]

    def push(self, forces: FloatArray) -> None:
        """Let other forces act.

        Parameters
        ----------
        forces : ndarray of float64, shape (6 N,)
            On the cells.
        """
        known = self._updates[:, : self._rank]
        self.forces, self.motions = forces, self.lattice.intact.solve(forces) + known @ (known.T @ forces)

    def jumps(self) -> FloatArray:
        """Compute the jump (I, 6) across every face; 0 across open ones, which carry nothing."""
        return np.asarray(self.body.jump_table @ self.motions).reshape(-1, 6) * (self.state != OPEN)[:, None]

    def release(self, face: int, pressed: bool = False) -> None:
        """Break a face.

        Parameters
        ----------
        face : int
            One that is whole, or one under pressure that opens.
        pressed : bool
            Whether pressure is still carried across it, by its normal spring.
        """
        lattice = self.lattice
        normal = lattice.faces.normals[face]
        if self.state[face] == PRESSED:  # only the normal spring is left
            modes = np.append(normal, np.zeros(3))[:, None]
            springs = modes.T @ lattice.normal_springs[face] @ modes
        else:
            modes = np.eye(6)
            if pressed:
                modes = np.zeros((6, 5))
                modes[:3, :2] = np.linalg.svd(normal[None])[2][1:].T
                modes[3:, 2:] = np.eye(3)
            springs = modes.T @ lattice.springs[face] @ modes
        at, pull = lattice.unknowns[face], lattice.jump_matrices[face].T @ modes  # (12,), (12, modes)
        known = self._updates[:, : self._rank]
        # In units in which each of the springs that go is 1, whatever the face's size.
        own, axes = np.linalg.eigh(_symmetric(springs))
        pull = pull @ (axes * np.sqrt(np.maximum(own, 0.0)))
        columns = self.body.inverse[:, at] @ pull + known @ (known[at].T @ pull)
        value, vector = np.linalg.eigh(_symmetric(np.eye(pull.shape[1]) - pull.T @ columns[at]))
        update = columns @ (vector / np.sqrt(np.maximum(value, SINGULAR)))
        self._append(update)
        self.motions = self.motions + update @ (update.T @ self.forces)
        jumped = np.asarray(self.body.jump_table @ update).reshape(len(self.state), 6, -1)
        self.compliances += jumped @ np.swapaxes(jumped, 1, 2)
        self.state[face] = PRESSED if pressed and self.state[face] == WHOLE else OPEN

    def open_cracks(self, jumps: FloatArray) -> bool:
        """Let go of the broken face whose pressure has turned into the hardest pull, if there is any.

        Parameters
        ----------
        jumps : ndarray of float64, shape (I, 6)
            Across the faces.

        Returns
        -------
        bool
            Whether there was one.
        """
        pressed = np.flatnonzero(self.state == PRESSED)
        if not len(pressed):
            return False
        faces = self.lattice.faces
        rate = faces.areas[pressed] / faces.spring_lengths[pressed]
        pull = rate * np.einsum("fi,fi->f", faces.normals[pressed], jumps[pressed, :3])
        hardest = int(np.argmax(pull))
        if pull[hardest] <= OPENS * np.abs(pull).max():
            return False
        self.release(int(pressed[hardest]))
        return True

    def fronts(self) -> BoolArray:
        """Find the whole faces (I,) that a crack can go on along: they meet an edge at which it ends."""
        triples = self.lattice.faces.fronts
        result = np.zeros(len(self.state), dtype=bool)
        result[triples[(~self.whole[triples]).sum(axis=1) == 1].ravel()] = True
        return result & self.whole

    def bearable(self, jumps: FloatArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Compute how many times the forces each face can bear.

        Parameters
        ----------
        jumps : ndarray of float64, shape (I, 6)
            Across the faces.

        Returns
        -------
        factors : ndarray of float64, shape (I,)
            Of the forces, at which each face breaks; infinite where none would break it.
        pressed : ndarray of bool, shape (I,)
            Whether it would go on carrying pressure.
        fronts : ndarray of bool, shape (I,)
            Faces in front of a crack.

        Notes
        -----
        In front of a crack a face breaks once the energy that its removal releases suffices for its area (Griffith);
        elsewhere it must be pulled to its strength besides (the coupled criterion of Leguillon 2002, *Strength or
        toughness? A criterion for crack onset at a notch*).
        """
        tension, cosine, pressure = self.lattice.tension(jumps, self.stiffness)
        pressed, fronts = np.asarray(pressure, dtype=np.bool_), self.fronts()
        factors = np.full(len(tension), np.inf)
        chosen = np.flatnonzero(self.whole & (tension > 0.0))
        released = self.released(chosen, jumps, pressed[chosen])
        price = self.brittleness * self.lattice.faces.areas[chosen] * np.maximum(cosine[chosen], LEAST_COSINE)
        energy = np.sqrt(price / np.maximum(released, 1e-300))
        factors[chosen] = np.where(fronts[chosen], energy, np.maximum(energy, 1.0 / tension[chosen]))
        return factors, pressed, fronts

    def released(self, faces: IntArray, jumps: FloatArray, pressed: BoolArray) -> FloatArray:
        """Compute the energy that the removal of each of some faces alone would release under the forces.

        Parameters
        ----------
        faces : ndarray of int64, shape (F,)
            Whole faces.
        jumps : ndarray of float64, shape (I, 6)
            Across all faces.
        pressed : ndarray of bool, shape (F,)
            Those that keep their normal spring.

        Returns
        -------
        ndarray of float64, shape (F,)
            ½ qᵀ k (I - C k)⁻¹ q, exact: q the jump, k the springs that go, C the face's compliance.
        """
        springs = self.lattice.springs[faces] - pressed[:, None, None] * self.lattice.normal_springs[faces]
        jump = jumps[faces, :, None]
        system = (1.0 + REGULAR) * np.eye(6) - self.compliances[faces] @ springs
        return np.asarray(0.5 * (springs @ jump * np.linalg.solve(system, jump)).sum(axis=(1, 2)))

    def _append(self, update: FloatArray) -> None:
        end = self._rank + update.shape[1]
        if end > self._updates.shape[1]:
            grown = np.empty((len(self._updates), 2 * self._updates.shape[1]), order="F")
            grown[:, : self._rank] = self._updates[:, : self._rank]
            self._updates = grown
        self._updates[:, self._rank : end] = update
        self._rank = end


@dataclass(frozen=True, eq=False)
class CrackPath:
    """How a body cracks under a load that grows.

    Attributes
    ----------
    faces : ndarray of int64, shape (B,)
        The faces that break, in order.
    factors : ndarray of float64, shape (B,)
        The load factor at which each does, never falling: cracks that run on at a lower load do so at once.
    at_front : ndarray of bool, shape (B,)
        Those that broke in front of a crack.
    separation : float
        The load factor at which the body comes apart; infinite where it does not.
    labels : ndarray of int64, shape (N,)
        The piece of each cell in the end.
    """

    faces: IntArray
    factors: FloatArray
    at_front: BoolArray
    separation: float
    labels: IntArray

    @property
    def first(self) -> float:
        """The load factor at which a first face breaks; infinite where none does."""
        return float(self.factors[0]) if len(self.factors) else np.inf


def crack_ramp(
    body: IntactBody,
    forces: FloatArray,
    brittleness: float,
    cracked: BoolArray | None = None,
    largest: float = np.inf,
    smallest: float = 0.0,
    breaks: int | None = None,
) -> CrackPath:
    """Crack a body by forces that grow in proportion and are held while cracks run, until it comes apart.

    Parameters
    ----------
    body : IntactBody
        Of N cells and I faces. Where its speed number is small the load is static; forces that do not balance each
        other are balanced by the inertia of the whole body.
    forces : ndarray of float64, shape (6 N,)
        The load of factor 1 on the cells, in strength times L².
    brittleness : float
        E G_c / (strength² L).
    cracked : ndarray of bool, shape (I,), optional
        Faces that are broken, and open, before the load comes.
    largest : float
        The ramp ends where more than this load factor would be needed.
    smallest : float
        Share of the body's volume that a part must have to count as one that came off.
    breaks : int, optional
        Faces that may break, at most; all by default.

    Returns
    -------
    CrackPath
        What breaks, and when.
    """
    cracks = Cracks(body, brittleness, forces)
    for face in [] if cracked is None else np.flatnonzero(cracked).tolist():
        cracks.release(face)
    volumes = body.lattice.cells.volumes
    before = count_parts(cracks.labels, volumes, smallest)
    faces: list[int] = []
    factors: list[float] = []
    at_front: list[bool] = []
    factor, separation = 0.0, np.inf
    while len(faces) < (len(cracks.state) if breaks is None else breaks):
        jumps = cracks.jumps()
        if cracks.open_cracks(jumps):
            continue
        bearable, pressed, fronts = cracks.bearable(jumps)
        face = int(np.argmin(bearable))
        if not bearable[face] <= largest:
            break
        factor = max(factor, float(bearable[face]))
        faces.append(face)
        factors.append(factor)
        at_front.append(bool(fronts[face]))
        cracks.release(face, bool(pressed[face]))
        if count_parts(cracks.labels, volumes, smallest) > before:
            separation = factor
            break
    found = np.array(faces, dtype=np.int64), np.array(factors), np.array(at_front, dtype=bool)
    return CrackPath(*found, separation, cracks.labels)


def count_parts(labels: IntArray, volumes: FloatArray, smallest: float) -> int:
    """Count the parts that have at least a share of the body's volume.

    Parameters
    ----------
    labels : ndarray of int64, shape (N,)
        The part of each cell.
    volumes : ndarray of float64, shape (N,)
        Of the cells.
    smallest : float
        That share.

    Returns
    -------
    int
        How many.
    """
    return int((np.bincount(labels, volumes) >= smallest * volumes.sum()).sum())


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))
