"""Eigenfunctions of a solid's Laplacian: smooth coordinates in which a model sees geometry. Offline only.

They are taken over the solid, not its surface: what happens to the front of a thin wall happens to its back, and two
limbs are as far apart as the body between them is long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh
from scipy.spatial.distance import cdist

from ..common.arrays import FloatArray, IntArray
from .solid import Solid, shared_faces, sum_by_index
from .surface import Surface


@dataclass(frozen=True, eq=False)
class Spectrum:
    """positions: (V, 3), centred, of unit mean square. functions: (V, R, K) averaged over patches of R radii about
    the surface's vertices, the first non-constant eigenfunctions, each of unit mean square over the solid.
    means: (K, A), over each atom. values: (K,), their eigenvalues."""

    positions: FloatArray
    functions: FloatArray
    means: FloatArray
    values: FloatArray

    @property
    def coordinates(self) -> FloatArray:
        """(V, 3 + R K): positions, then functions."""
        return np.hstack([self.positions, self.functions.reshape(len(self.positions), -1)])


def spectrum(solid: Solid, atom: IntArray, surface: Surface, count: int, radii: Sequence[float]) -> Spectrum:
    """The first ``count`` non-constant eigenfunctions of the finite-volume Laplacian of a solid's cells.

    atom: (C,), the atom of each cell. radii: standard deviations of the Gaussian patches, in units of the largest
    extent: a contact is no point, and how large it is is left to a model to find.
    """
    pairs, _, conductance = neighbours(solid)
    cells = len(solid.volumes)
    share = solid.volumes / solid.volumes.sum()
    root = sp.diags(1.0 / np.sqrt(share))
    stiffness = root @ laplacian(pairs, conductance, cells) @ root / solid.volumes.sum()
    count = min(count, cells - 3)
    guess = np.ones(cells)  # a fixed start makes the solver repeatable
    values, vectors = eigsh(stiffness, k=count + 1, sigma=-1e-2, v0=guess)
    functions = root @ vectors[:, 1:]
    weighted = np.hstack([functions, np.ones((cells, 1))]) * share[:, None]
    at_vertices = np.empty((len(surface.vertices), len(radii), functions.shape[1]))
    for start in range(0, len(surface.vertices), 512):
        block = surface.vertices[start : start + 512]
        square = cdist(block, solid.centroids, "sqeuclidean")
        square -= square.min(axis=1, keepdims=True)  # so that no patch underflows, however small
        for row, radius in enumerate(radii):
            total = np.exp(square / (-2 * radius**2)) @ weighted
            at_vertices[start : start + 512, row] = total[:, :-1] / total[:, -1:]
    atoms = int(atom.max()) + 1
    means = sum_by_index(atom, share[:, None] * functions, atoms) / sum_by_index(atom, share, atoms)[:, None]
    positions = surface.vertices - share @ solid.centroids
    positions /= np.sqrt((positions**2).mean())
    return Spectrum(positions, at_vertices, means.T, values[1:])


def neighbours(solid: Solid) -> tuple[IntArray, FloatArray, FloatArray]:
    """Pairs (I, 2) of cells that share faces, their areas (I,) and diffusion conductances area/distance (I,)."""
    pairs, areas, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    distance = np.linalg.norm(solid.centroids[pairs[:, 0]] - solid.centroids[pairs[:, 1]], axis=1)
    return pairs, areas, areas / distance


def laplacian(pairs: IntArray, weights: FloatArray, count: int) -> sp.csc_matrix:
    """The positive semi-definite graph Laplacian of weighted pairs."""
    difference = difference_operator(pairs, np.ones(len(pairs)), count)
    return sp.csc_matrix(difference.T @ sp.diags(weights) @ difference)


def difference_operator(pairs: IntArray, weights: FloatArray, count: int) -> sp.csr_matrix:
    """(F, C): the weighted jump across each of the pairs."""
    rows = np.repeat(np.arange(len(pairs)), 2)
    values = np.tile([1.0, -1.0], len(pairs)) * np.repeat(weights, 2)
    return sp.csr_matrix((values, (rows, pairs.ravel())), shape=(len(pairs), count))
