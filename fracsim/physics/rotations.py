"""TODO physics.rotations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pybullet as p
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray
from ..geometry.frames import cross as cross
from .states import Triple


def integrate_rotation(quaternion: Sequence[float], angular: Triple, time: float) -> tuple[float, float, float, float]:
    """A unit quaternion (x, y, z, w) after turning for so long, in plain numbers: scipy's checks of its arguments take
    longer than one rotation."""
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
    """Quaternion (x, y, z, w) -> rotation matrix (3, 3)."""
    return np.array(p.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def quaternion_of(rotation: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) -> unit quaternion (x, y, z, w)."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat())
