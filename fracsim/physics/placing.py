"""Where and how an object enters a world, from what somebody gave to `World.add`, checked.

Only `World.add` uses it.
"""

from __future__ import annotations

import numpy as np

from ..common.checks import Vector, at_least, finite_vector, is_number
from ..common.errors import PhysicsError
from .bodies import Pose
from .breakable import BreakableObject
from .rotations import rotation_of
from .states import ContactProperties

# Collision margin as a share of an object's largest extent: the gap between the convex parts of two pieces is 1.5e-3,
# and margins must not fill it.
COLLISION_MARGIN = 5e-4


def scaled(asset: BreakableObject, scale: float) -> BreakableObject:
    """Scale an object.

    Parameters
    ----------
    asset : BreakableObject
        The object.
    scale : float
        Of lengths, positive.

    Returns
    -------
    BreakableObject
        The object, `scale` times as large.

    Raises
    ------
    PhysicsError
        Where the scale is no positive number.
    """
    if not is_number(scale) or scale <= 0.0:
        raise PhysicsError(f"scale must be a positive number, got {scale!r}")
    return asset if scale == 1.0 else asset.scaled(scale)


def pose_of(
    asset: BreakableObject,
    position: Vector,
    orientation: Vector,
    linear_velocity: Vector,
    angular_velocity: Vector,
) -> Pose:
    """Put together where an object's frame is and how it moves.

    Parameters
    ----------
    asset : BreakableObject
        The object.
    position : sequence of float, shape (3,)
        Of its frame, m.
    orientation : sequence of float, shape (4,)
        Of its frame, a quaternion (x, y, z, w) of any length but zero.
    linear_velocity : sequence of float, shape (3,)
        Of its centre of mass, m/s.
    angular_velocity : sequence of float, shape (3,)
        World frame, rad/s.

    Returns
    -------
    Pose
        Of the frame, whose origin moves as part of the object.

    Raises
    ------
    PhysicsError
        Where an argument is not so many finite numbers, or the quaternion is zero.
    """
    quaternion = finite_vector(orientation, "orientation", 4)
    if not quaternion.any():
        raise PhysicsError("orientation is the zero quaternion; no rotation is (0, 0, 0, 1)")
    rotation = rotation_of((quaternion / np.linalg.norm(quaternion)).tolist())
    angular = finite_vector(angular_velocity, "angular_velocity", 3)
    linear = finite_vector(linear_velocity, "linear_velocity", 3)
    linear = linear - np.cross(angular, rotation @ asset.center_of_mass)
    return Pose(finite_vector(position, "position", 3), rotation, linear, angular)


def contact_properties_of(asset: BreakableObject, linear_damping: float, angular_damping: float) -> ContactProperties:
    """Put together what an object's contacts and damping are made of.

    Parameters
    ----------
    asset : BreakableObject
        The object, with its material.
    linear_damping, angular_damping : float
        Share of the velocity lost per second, at least 0.

    Returns
    -------
    ContactProperties
        Of the object when it enters the world.

    Raises
    ------
    PhysicsError
        Where a damping is negative.
    """
    return ContactProperties(
        friction=asset.material.friction,
        restitution=asset.material.restitution,
        margin=COLLISION_MARGIN * asset.size,
        linear_damping=at_least(linear_damping, 0.0, "linear_damping"),
        angular_damping=at_least(angular_damping, 0.0, "angular_damping"),
    )
