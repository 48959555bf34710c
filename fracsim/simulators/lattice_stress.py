"""Principal stresses, in closed form for many stresses at once. ``lattice`` finds with them how hard faces are pulled.

Offline only.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray


def principal_on(mean: FloatArray, traction: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the largest principal stress where the traction on a plane is known better than the rest.

    Parameters
    ----------
    mean : ndarray of float64, shape (N, 6)
        Stresses: xx, yy, zz, yz, xz, xy.
    traction : ndarray of float64, shape (N, 3)
        What the corrected stresses give on the planes.
    normal : ndarray of float64, shape (N, 3)
        Unit normals of the planes.

    Returns
    -------
    value : ndarray of float64, shape (N,)
        The largest eigenvalue of the corrected stress.
    direction : ndarray of float64, shape (N, 3)
        Its unit eigenvector, of either sign.
    """
    xx, yy, zz, yz, xz, xy = mean.T
    nx, ny, nz = normal.T
    ex = traction[:, 0] - (xx * nx + xy * ny + xz * nz)
    ey = traction[:, 1] - (xy * nx + yy * ny + yz * nz)
    ez = traction[:, 2] - (xz * nx + yz * ny + zz * nz)
    en = ex * nx + ey * ny + ez * nz
    return principal(
        xx + (2.0 * ex - en * nx) * nx,
        yy + (2.0 * ey - en * ny) * ny,
        zz + (2.0 * ez - en * nz) * nz,
        yz + ey * nz + ez * ny - en * ny * nz,
        xz + ex * nz + ez * nx - en * nx * nz,
        xy + ex * ny + ey * nx - en * nx * ny,
    )


def principal(
    xx: FloatArray, yy: FloatArray, zz: FloatArray, yz: FloatArray, xz: FloatArray, xy: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Find the largest principal stress and its direction, in closed form.

    Parameters
    ----------
    xx, yy, zz, yz, xz, xy : ndarray of float64, shape (N,)
        Components of N stresses.

    Returns
    -------
    value : ndarray of float64, shape (N,)
        The largest eigenvalue.
    direction : ndarray of float64, shape (N, 3)
        Its unit eigenvector, of either sign; any where the three eigenvalues are equal.

    Notes
    -----
    Smith 1961, *Eigenvalues of a symmetric 3 × 3 matrix*.
    """
    third = (xx + yy + zz) / 3.0
    a, b, c = xx - third, yy - third, zz - third
    spread = np.sqrt(np.maximum((a * a + b * b + c * c + 2.0 * (yz * yz + xz * xz + xy * xy)) / 6.0, 1e-60))
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / (2.0 * spread**3), -1.0, 1.0)) / 3.0
    value = third + 2.0 * spread * np.cos(angle)
    # The rows of A - λ span the plane across the eigenvector; of their cross products the longest is taken.
    a, b, c = xx - value, yy - value, zz - value
    rows = np.array([[a, xy, xz], [xy, b, yz], [xz, yz, c]])  # (3, 3, N)
    products = np.stack([np.cross(rows[i], rows[j], axis=0) for i, j in ((0, 1), (0, 2), (1, 2))])  # (3, 3, N)
    square = (products**2).sum(axis=1)
    best = np.argmax(square, axis=0)
    column = np.arange(len(best))
    vector, length = products[best, :, column], np.sqrt(square[best, column])
    flat = length < 1e-30
    vector[flat] = (1.0, 0.0, 0.0)
    return value, vector / np.where(flat, 1.0, length)[:, None]
