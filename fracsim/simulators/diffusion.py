"""TODO simulators.diffusion."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ..common.arrays import FloatArray, IntArray
from ..solids.solid import Solid, sum_by_index
from ..solids.spectrum import laplacian, neighbours

# Three times the paper's h and a wider patch: a small h drives the atoms under the contact so much harder than
# the rest that an object chips long before it breaks (benchmarks/calibration.py reports both heights).
DIFFUSION_TIME = 0.1  # h of Breaking Good, Eq. 22, lengths in units of the largest extent
PATCH_RADIUS = 0.1  # standard deviation of the contact patch, in units of the largest extent


def impact_field(solid: Solid, atom: IntArray, points: FloatArray) -> FloatArray:
    """How a unit impact at each point spreads: (N, A), per atom, of volume-weighted mean 1 over each row.

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
    spread = factor.solve(member) / sum_by_index(atom, solid.volumes, count)  # (C, A)
    result = np.empty((len(points), count))
    for start in range(0, len(points), 512):
        block = points[start : start + 512]
        square = ((block[:, None] - solid.centroids[None]) ** 2).sum(axis=2)
        # Subtracting the nearest keeps a row's largest weight at 1 however coarse the cells are.
        patch = np.exp(-(square - square.min(axis=1, keepdims=True)) / (2 * PATCH_RADIUS**2)) * solid.volumes
        result[start : start + 512] = patch / patch.sum(axis=1, keepdims=True) @ spread
    return result * solid.volumes.sum()
