"""Rotations as quaternions and matrices, the way PyBullet has them; the whole room takes them from here."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pybullet as p
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray
from .states import Quaternion, Triple


def integrate_rotation(quaternion: Sequence[float], angular: Triple, time: float) -> Quaternion:
    """Turn a rotation on at a constant angular velocity.

    Parameters
    ----------
    quaternion : sequence of float, length 4
        Unit quaternion (x, y, z, w).
    angular : tuple of float
        Angular velocity (x, y, z), rad/s, world frame.
    time : float
        For how long, s; negative turns back.

    Returns
    -------
    tuple of float
        Unit quaternion (x, y, z, w).

    Notes
    -----
    In plain numbers: SciPy's checks of its arguments take longer than one rotation.

    Examples
    --------
    >>> import math
    >>> turned = integrate_rotation((0, 0, 0, 1), (0, 0, math.pi), 1.0)  # half a turn about z
    >>> [round(value, 6) for value in turned]
    [0.0, 0.0, 1.0, 0.0]
    """
    speed = math.hypot(*angular)
    half = 0.5 * speed * time
    share = math.sin(half) / speed if speed > 0.0 else 0.0
    a, b, c, d = angular[0] * share, angular[1] * share, angular[2] * share, math.cos(half)
    x, y, z, w = quaternion
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def rotation_of(quaternion: Sequence[float]) -> FloatArray:
    """Convert a quaternion to a matrix.

    Parameters
    ----------
    quaternion : sequence of float, length 4
        Unit quaternion (x, y, z, w).

    Returns
    -------
    ndarray of float64, shape (3, 3)
        Rotation matrix.
    """
    return np.array(p.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def quaternion_of(rotation: FloatArray) -> FloatArray:
    """Convert a matrix to a quaternion.

    Parameters
    ----------
    rotation : ndarray of float64, shape (3, 3)
        Rotation matrix.

    Returns
    -------
    ndarray of float64, shape (4,)
        Unit quaternion (x, y, z, w).
    """
    return np.asarray(Rotation.from_matrix(rotation).as_quat())
