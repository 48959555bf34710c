"""How a unit impact spreads through a body: momentum diffuses like heat. Offline only.

The modal simulator's loads are the jumps of this field between atoms; baking keeps it in the asset.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ..common.arrays import FloatArray, IntArray
from ..solids.solid import Solid, sum_by_index
from ..solids.spectrum import laplacian, neighbours

# Three times the paper's h and a wider patch: a small h loads the atoms under the contact so much harder than
# the rest that an object chips long before it breaks (benchmarks/calibration.py reports both heights).
DIFFUSION_TIME = 0.1  # h of Breaking Good, Eq. 22, lengths in units of the largest extent
PATCH_RADIUS = 0.1  # standard deviation of the contact patch, in units of the largest extent
# The diffused field is no elastic wave front, so its jumps need one dimensionless gauge before they can be held against
# the critical velocity: an interface breaks when its effective jump of velocity reaches GAUGE * critical_velocity. It
# is set by everyday experience, that a 0.1 m ceramic mug survives a fall from 0.2 m and breaks from 1 m;
# benchmarks/calibration.py measures it.
GAUGE = 0.24
BLOCK = 512  # points worked on at a time, for memory


def impact_field(solid: Solid, atom: IntArray, points: FloatArray) -> FloatArray:
    """Work out how a unit impact at each point spreads over the atoms.

    Parameters
    ----------
    solid : Solid
        Of C cells.
    atom : ndarray of int64, shape (C,)
        The atom of each cell.
    points : ndarray of float64, shape (N, 3)
        Where the impacts are, in units of the largest extent.

    Returns
    -------
    ndarray of float64, shape (N, A)
        For each atom, of volume-weighted mean 1 over each row. The velocity field
        ``impulse / mass * row * direction`` carries exactly the momentum of the impulse.

    Notes
    -----
    A Gaussian patch on the solid, diffused for DIFFUSION_TIME by one implicit step of the finite-volume heat equation,
    which conserves the total exactly (Sellán et al. 2022, *Breaking Good*, Eq. 22, with momentum for heat).
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
    for start in range(0, len(points), BLOCK):
        block = points[start : start + BLOCK]
        square = ((block[:, None] - solid.centroids[None]) ** 2).sum(axis=2)
        # Subtracting the nearest keeps a row's largest weight at 1 however coarse the cells are.
        patch = np.exp(-(square - square.min(axis=1, keepdims=True)) / (2 * PATCH_RADIUS**2)) * solid.volumes
        result[start : start + BLOCK] = patch / patch.sum(axis=1, keepdims=True) @ spread
    return result * solid.volumes.sum()
