"""Eigenfunctions of a solid's Laplacian, the smooth coordinates in which a model sees geometry. Offline only.

The fracture modes begin with the same Laplacian. It is the solid's, not its surface's: what happens to the front of a
thin wall happens to its back, and two limbs are as far apart as the body between them is long.
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

BLOCK = 512  # vertices worked on at a time, for memory


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Smooth functions on a solid, at the vertices of its surface.

    Attributes
    ----------
    positions : ndarray of float64, shape (V, 3)
        Of the vertices, about the body's centre, scaled to unit mean square.
    functions : ndarray of float64, shape (V, R, K)
        The first K non-constant eigenfunctions, each of unit mean square over the solid, averaged over patches of R
        radii about each vertex.
    means : ndarray of float64, shape (K, A)
        Their means over each atom.
    values : ndarray of float64, shape (K,)
        Their eigenvalues.
    """

    positions: FloatArray
    functions: FloatArray
    means: FloatArray
    values: FloatArray

    @property
    def coordinates(self) -> FloatArray:
        """Positions, then functions, (V, 3 + R K)."""
        return np.hstack([self.positions, self.functions.reshape(len(self.positions), -1)])


def spectrum(solid: Solid, atom: IntArray, surface: Surface, count: int, radii: Sequence[float]) -> Spectrum:
    """Work out the first non-constant eigenfunctions of the finite-volume Laplacian of a solid's cells.

    Parameters
    ----------
    solid : Solid
        Of C cells.
    atom : ndarray of int64, shape (C,)
        The atom of each cell.
    surface : Surface
        The solid's outside.
    count : int
        How many eigenfunctions.
    radii : sequence of float
        Standard deviations of the Gaussian patches, in units of the largest extent. A contact is no point; a model
        finds out which size of patch tells it most.

    Returns
    -------
    Spectrum
        At the surface's vertices.
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
    for start in range(0, len(surface.vertices), BLOCK):
        block = surface.vertices[start : start + BLOCK]
        square = cdist(block, solid.centroids, "sqeuclidean")
        square -= square.min(axis=1, keepdims=True)  # so that no patch underflows, however small
        for row, radius in enumerate(radii):
            total = np.exp(square / (-2 * radius**2)) @ weighted
            at_vertices[start : start + BLOCK, row] = total[:, :-1] / total[:, -1:]
    atoms = int(atom.max()) + 1
    means = sum_by_index(atom, share[:, None] * functions, atoms) / sum_by_index(atom, share, atoms)[:, None]
    positions = surface.vertices - share @ solid.centroids
    positions /= np.sqrt((positions**2).mean())
    return Spectrum(positions, at_vertices, means.T, values[1:])


def neighbours(solid: Solid) -> tuple[IntArray, FloatArray, FloatArray]:
    """Find the cells that share faces.

    Parameters
    ----------
    solid : Solid
        Of C cells.

    Returns
    -------
    pairs : ndarray of int64, shape (I, 2)
        Neighbours, the smaller index first.
    areas : ndarray of float64, shape (I,)
        What they share.
    conductances : ndarray of float64, shape (I,)
        Area over distance of the centroids, for finite-volume diffusion.
    """
    pairs, areas, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    distance = np.linalg.norm(solid.centroids[pairs[:, 0]] - solid.centroids[pairs[:, 1]], axis=1)
    return pairs, areas, areas / distance


def laplacian(pairs: IntArray, weights: FloatArray, count: int) -> sp.csc_matrix:
    """Assemble the graph Laplacian of weighted pairs.

    Parameters
    ----------
    pairs : ndarray of int64, shape (I, 2)
        Neighbours.
    weights : ndarray of float64, shape (I,)
        Of the pairs.
    count : int
        C, the number of nodes.

    Returns
    -------
    scipy.sparse.csc_matrix, shape (C, C)
        Positive semi-definite.
    """
    difference = difference_operator(pairs, np.ones(len(pairs)), count)
    return sp.csc_matrix(difference.T @ sp.diags(weights) @ difference)


def difference_operator(pairs: IntArray, weights: FloatArray, count: int) -> sp.csr_matrix:
    """Assemble the jumps across pairs.

    Parameters
    ----------
    pairs : ndarray of int64, shape (I, 2)
        Neighbours.
    weights : ndarray of float64, shape (I,)
        Of the pairs.
    count : int
        C, the number of nodes.

    Returns
    -------
    scipy.sparse.csr_matrix, shape (I, C)
        Its product with u is ``weights * (u[pairs[:, 0]] - u[pairs[:, 1]])``.
    """
    rows = np.repeat(np.arange(len(pairs)), 2)
    values = np.tile([1.0, -1.0], len(pairs)) * np.repeat(weights, 2)
    return sp.csr_matrix((values, (rows, pairs.ravel())), shape=(len(pairs), count))
