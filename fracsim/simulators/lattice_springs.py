"""The springs over the faces of a lattice, and the jumps that strain them. ``lattice`` is built of them. Offline only.

Stresses are in units of Young's modulus, lengths in units of the body's largest extent.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray
from .lattice_faces import CellFaces


def jump_matrices(faces: CellFaces, centroids: FloatArray) -> FloatArray:
    """Make the matrices from the motions of each face's two cells to the jump across it.

    Parameters
    ----------
    faces : CellFaces
        I faces.
    centroids : ndarray of float64, shape (N, 3)
        Of the cells, about which they turn.

    Returns
    -------
    ndarray of float64, shape (I, 6, 12)
        A jump is the displacement at the face's centroid and the rotation of the second cell seen from the first.
    """
    result = np.zeros((len(faces.areas), 6, 12))
    for side, sign in ((0, -1.0), (1, 1.0)):
        arm = faces.centroids - centroids[faces.pairs[:, side]]
        result[:, :3, 6 * side : 6 * side + 3] = sign * np.eye(3)
        result[:, 3:, 6 * side + 3 : 6 * side + 6] = sign * np.eye(3)
        result[:, :3, 6 * side + 3 : 6 * side + 6] = -sign * cross_matrices(arm)
    return result


def torsion_share(faces: CellFaces) -> FloatArray:
    """Compute the torsional stiffness of each face over that of its springs.

    Parameters
    ----------
    faces : CellFaces
        I faces.

    Returns
    -------
    ndarray of float64, shape (I,)
        At most 1.

    Notes
    -----
    The springs' is the polar moment of the face's area, with which plates one cell thick would lock. It is lowered to
    I_min (1 + I_min / I_max): right for such a plate, and the polar moment itself for square faces.
    """
    low, high = np.maximum(np.linalg.eigvalsh(faces.second_moments)[:, 1:], 1e-30).T
    return np.asarray(low * (1.0 + low / high) / (low + high))


def springs(faces: CellFaces, torsion: FloatArray) -> FloatArray:
    """Make the stiffness of each face.

    Parameters
    ----------
    faces : CellFaces
        I faces.
    torsion : ndarray of float64, shape (I,)
        ``torsion_share`` of them.

    Returns
    -------
    ndarray of float64, shape (I, 6, 6)
        From the jump across a face to the force and moment at its centroid: E over the distance of the cells, per
        area, normal and tangential alike.
    """
    result = np.zeros((len(faces.areas), 6, 6))
    result[:, :3, :3] = (faces.areas / faces.spring_lengths)[:, None, None] * np.eye(3)
    trace = np.trace(faces.second_moments, axis1=1, axis2=2)
    turning = (trace[:, None, None] * np.eye(3) - faces.second_moments) / faces.spring_lengths[:, None, None]
    lost = np.einsum("fi,fij,fj->f", faces.normals, turning, faces.normals) * (1.0 - torsion)
    result[:, 3:, 3:] = turning - lost[:, None, None] * outer_products(faces.normals)
    return result


def normal_springs(faces: CellFaces) -> FloatArray:
    """Make the part of each face's stiffness that carries pressure.

    Parameters
    ----------
    faces : CellFaces
        I faces.

    Returns
    -------
    ndarray of float64, shape (I, 6, 6)
        From the jump across a face to the force along its normal.
    """
    result = np.zeros((len(faces.areas), 6, 6))
    result[:, :3, :3] = (faces.areas / faces.spring_lengths)[:, None, None] * outer_products(faces.normals)
    return result


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Make the matrices of a × ·.

    Parameters
    ----------
    vectors : ndarray of float64, shape (N, 3)
        Each a.

    Returns
    -------
    ndarray of float64, shape (N, 3, 3)
        One for each.
    """
    result = np.zeros((len(vectors), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    return result - np.swapaxes(result, 1, 2)


def outer_products(vectors: FloatArray) -> FloatArray:
    """Make the matrices a aᵀ.

    Parameters
    ----------
    vectors : ndarray of float64, shape (N, 3)
        Each a.

    Returns
    -------
    ndarray of float64, shape (N, 3, 3)
        One for each.
    """
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])
