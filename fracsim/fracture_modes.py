"""Fracture modes and what they make of a solid: atoms, the interfaces between them, and how a blow spreads.

After Sellán et al. 2022, *Breaking Good: Fracture Modes for Realtime Destruction*. Offline only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh, splu

from .errors import BakeError, MissingExtraError
from .solid import Solid, join_small, shared_faces, sums

try:
    import clarabel
except ImportError as error:
    raise MissingExtraError("clarabel", "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

JUMP = 0.1  # of a mode's largest jump: cells that no mode separates by more belong to one atom
ATOM_FLOOR = 4e-3  # of the body's volume; smaller atoms join the neighbour they share most area with
SETTLED = 1e-3  # change of a mode between iterations, in the mass norm, at which it has converged
ITERATIONS = 10
# Three times the paper's h and a wider patch: a small h drives the atoms under the contact so much harder than
# the rest that an object chips long before it breaks (benchmarks/calibration.py reports both heights).
DIFFUSION_TIME = 0.1  # h of Breaking Good, Eq. 22, lengths in units of the largest extent
PATCH_RADIUS = 0.1  # standard deviation of the contact patch, in units of the largest extent


@dataclass(frozen=True, eq=False)
class Modes:
    """Fracture modes of a solid.

    values: (K, C), one scalar per cell, orthonormal in the mass inner product.
    objectives: per mode, the fracture energy after each iteration (never increasing).
    """

    values: FloatArray
    objectives: tuple[tuple[float, ...], ...]


def neighbours(solid: Solid) -> tuple[IntArray, FloatArray, FloatArray]:
    """Pairs (I, 2) of cells that share faces, their areas (I,) and diffusion conductances area/distance (I,)."""
    pairs, areas, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    distance = np.linalg.norm(solid.centroids[pairs[:, 0]] - solid.centroids[pairs[:, 1]], axis=1)
    return pairs, areas, areas / distance


def laplacian(pairs: IntArray, weights: FloatArray, count: int) -> sp.csc_matrix:
    """The positive semi-definite graph Laplacian of weighted pairs."""
    difference = sp.csr_matrix(
        (np.tile([1.0, -1.0], len(pairs)), (np.repeat(np.arange(len(pairs)), 2), pairs.ravel())),
        shape=(len(pairs), count),
    )
    return sp.csc_matrix(difference.T @ sp.diags(weights) @ difference)


def fracture_modes(solid: Solid, count: int, progress: Callable[[float], None] = lambda _: None) -> Modes:
    """The ``count`` first non-trivial scalar fracture modes (Breaking Good, Algorithm 1).

    Each minimises the area-weighted jumps between cells, orthogonal to those before and to the constants,
    of unit length along its own previous iterate; it starts from the Laplacian's eigenvector. Raises
    BakeError if the solver fails.
    """
    pairs, areas, conductance = neighbours(solid)
    cells, faces = len(solid.volumes), len(pairs)
    mass = solid.volumes / solid.volumes.sum()
    count = min(count, cells - 2)
    root = sp.diags(1.0 / np.sqrt(mass))
    scaled = root @ laplacian(pairs, conductance, cells) @ root
    # Shifted inverse power finds the smallest eigenvalues; the first is the constant's zero.
    start = np.ones(cells) / np.sqrt(cells)
    _, vectors = eigsh(scaled, k=count + 1, sigma=-1e-2, v0=start)
    guesses = (root @ vectors).T[1:]

    # Units in which costs and unknowns are about 1 keep the interior-point method well conditioned.
    cost = areas / areas.mean() / faces
    difference = sp.csr_matrix(
        (np.tile([1.0, -1.0], faces), (np.repeat(np.arange(faces), 2), pairs.ravel())), shape=(faces, cells)
    )
    identity = sp.identity(faces, format="csr")
    jumps = sp.vstack([sp.hstack([difference, -identity]), sp.hstack([-difference, -identity])])
    objective = np.concatenate([np.zeros(cells), cost])
    settings = clarabel.DefaultSettings()
    settings.verbose = False

    found = [np.ones(cells)]
    history = []
    for k in range(count):
        c = guesses[k]
        energies: list[float] = []
        for _ in range(ITERATIONS):
            c = _orthogonal(c, found, mass)
            rows = np.vstack([found, [c]]) * mass
            equalities = sp.hstack([sp.csr_matrix(rows), sp.csr_matrix((len(rows), faces))])
            right = np.concatenate([np.zeros(len(found)), [1.0], np.zeros(2 * faces)])
            solver = clarabel.DefaultSolver(
                sp.csc_matrix((cells + faces, cells + faces)),
                objective,
                sp.csc_matrix(sp.vstack([equalities, jumps])),
                right,
                [clarabel.ZeroConeT(len(rows)), clarabel.NonnegativeConeT(2 * faces)],
                settings,
            )
            solution = solver.solve()
            if "Solved" not in str(solution.status):
                raise BakeError(f"fracture mode {k}: the solver ended with {solution.status}")
            u = np.asarray(solution.x[:cells])
            u /= np.sqrt(mass @ u**2)
            change = np.sqrt(mass @ (u - c) ** 2)
            c = u
            energies.append(float(areas @ np.abs(u[pairs[:, 0]] - u[pairs[:, 1]])))
            if change < SETTLED or (len(energies) > 1 and energies[-1] > (1 - SETTLED) * energies[-2]):
                break
        found.append(_orthogonal(c, found, mass))
        history.append(tuple(energies))
        progress((k + 1) / count)
    return Modes(np.array(found[1:]).reshape(-1, cells), tuple(history))


def _orthogonal(c: FloatArray, found: list[FloatArray], mass: FloatArray) -> FloatArray:
    basis = np.array(found)
    c = c - (basis * mass @ c) @ basis
    return np.asarray(c / np.sqrt(mass @ c**2))


def atoms(solid: Solid, modes: Modes) -> IntArray:
    """(C,) the atom of each cell: cells that no mode separates, crumbs joined to their neighbour."""
    pairs, areas, _ = neighbours(solid)
    jump = np.abs(modes.values[:, pairs[:, 0]] - modes.values[:, pairs[:, 1]])
    joined = (jump <= JUMP * jump.max(axis=1, keepdims=True)).all(axis=0)
    cells = len(solid.volumes)
    graph = sp.coo_matrix((np.ones(int(joined.sum())), (pairs[joined, 0], pairs[joined, 1])), shape=(cells, cells))
    count, label = connected_components(graph, directed=False)
    volumes = sums(label, solid.volumes, count)
    ends = label[pairs]
    between = ends[:, 0] != ends[:, 1]
    joints, inverse = np.unique(np.sort(ends[between], axis=1), axis=0, return_inverse=True)
    bond = sums(inverse.reshape(-1), areas[between], len(joints))
    return join_small(volumes, joints, bond, ATOM_FLOOR * float(solid.volumes.sum()))[label]


def impact_field(solid: Solid, atom: IntArray, points: FloatArray) -> FloatArray:
    """How a unit blow at each point spreads: (N, A), per atom, of volume-weighted mean 1 over each row.

    A Gaussian patch on the solid diffused for DIFFUSION_TIME with the finite-volume heat equation
    (Breaking Good, Eq. 22, momentum for heat); implicit, so it conserves the total exactly: the body's
    velocity field ``impulse / mass * row * direction`` carries exactly the momentum of the impulse.
    """
    pairs, _, conductance = neighbours(solid)
    cells = len(solid.volumes)
    mass = sp.diags(solid.volumes)
    factor = splu(sp.csc_matrix(mass + DIFFUSION_TIME * laplacian(pairs, conductance, cells)))
    count = int(atom.max()) + 1
    # The diffusion is symmetric, so diffusing the atoms instead of every patch gives the same matrix.
    member = sp.csr_matrix((solid.volumes, (np.arange(cells), atom)), shape=(cells, count)).toarray()
    spread = factor.solve(member) / sums(atom, solid.volumes, count)  # (C, A)
    result = np.empty((len(points), count))
    for start in range(0, len(points), 512):
        block = points[start : start + 512]
        square = ((block[:, None] - solid.centroids[None]) ** 2).sum(axis=2)
        # Subtracting the nearest keeps a row's largest weight at 1 however coarse the cells are.
        patch = np.exp(-(square - square.min(axis=1, keepdims=True)) / (2 * PATCH_RADIUS**2)) * solid.volumes
        result[start : start + 512] = patch / patch.sum(axis=1, keepdims=True) @ spread
    return result * solid.volumes.sum()
