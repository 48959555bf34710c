"""Eigenfunctions of a solid's Laplacian: smooth coordinates in which a model sees geometry. Offline only.

They are taken over the solid, not its surface: what happens to the front of a thin wall happens to its back, and two
limbs are as far apart as the body between them is long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from .fracture_modes import laplacian, neighbours
from .mesh import Surface
from .solid import Solid, sums

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NEAREST = 8  # cells that a vertex takes its values from


@dataclass(frozen=True, eq=False)
class Spectrum:
    """positions: (V, 3), centred, of unit mean square. functions: (V, K) at the surface's vertices, the first
    non-constant eigenfunctions, each of unit mean square over the solid. means: (K, A), over each atom.
    values: (K,), their eigenvalues."""

    positions: FloatArray
    functions: FloatArray
    means: FloatArray
    values: FloatArray

    @property
    def coordinates(self) -> FloatArray:
        """(V, 3 + K): positions, then functions."""
        return np.hstack([self.positions, self.functions])


def spectrum(solid: Solid, atom: IntArray, surface: Surface, count: int) -> Spectrum:
    """The first ``count`` non-constant eigenfunctions of the finite-volume Laplacian of a solid's cells.

    atom: (C,), the atom of each cell.
    """
    pairs, _, conductance = neighbours(solid)
    cells = len(solid.volumes)
    share = solid.volumes / solid.volumes.sum()
    root = sp.diags(1.0 / np.sqrt(share))
    stiffness = root @ laplacian(pairs, conductance, cells) @ root / solid.volumes.sum()
    count = min(count, cells - 3)
    start = np.ones(cells)  # a fixed start makes the solver repeatable
    values, vectors = eigsh(stiffness, k=count + 1, sigma=-1e-2, v0=start)
    functions = root @ vectors[:, 1:]
    distance, near = cKDTree(solid.centroids).query(surface.vertices, k=min(NEAREST, cells))
    weight = 1.0 / np.maximum(distance, 1e-3)
    weight /= weight.sum(axis=1, keepdims=True)
    at_vertices = np.einsum("vn,vnk->vk", weight, functions[near])
    atoms = int(atom.max()) + 1
    means = sums(atom, share[:, None] * functions, atoms) / sums(atom, share, atoms)[:, None]
    positions = surface.vertices - share @ solid.centroids
    positions /= np.sqrt((positions**2).mean())
    return Spectrum(positions, at_vertices, means.T, values[1:])
