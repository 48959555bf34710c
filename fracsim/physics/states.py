"""What the engine's answers look like in this room: plain tuples and frozen records with their units.

Every module of physics may use it; it asks the engine nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pybullet as p

from ..common.arrays import FloatArray, IntArray

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w
Placement = tuple[Triple, Quaternion]  # centre of mass, m, and principal axes; world frame
Motion = tuple[Triple, Triple]  # velocity of the centre of mass, m/s, and angular velocity, rad/s; world frame
BodyLink = tuple[int, int]  # PyBullet's id of a body, and the index of its link; -1 is the base
Box = tuple[Triple, Triple]  # lowest and highest corner of a box along the world's axes, m
JointRates = tuple[tuple[float, ...], ...]  # velocities of the joints of a body, one tuple a joint

AT_REST: Motion = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

BodyNotFound: type[Exception] = p.error  # what a call about a body that is not in the engine raises


class ContactPoint(NamedTuple):
    """A contact as ``pybullet.getContactPoints`` returns it, field by field; of body a.

    Attributes
    ----------
    flag : int
        Reserved by PyBullet.
    body, other : int
        Ids of body a and of body b, which it touches.
    link, other_link : int
        Their links; -1 is the base.
    position, other_position : tuple of float
        Point on the surface of each, m, world frame.
    normal : tuple of float
        Unit vector from b to a, the way a is pushed; world frame.
    distance : float
        Gap between the two, m; negative where they overlap.
    force : float
        Normal force of the last step, N.
    friction, other_friction : float
        Friction forces along the two directions below, N.
    friction_direction, other_friction_direction : tuple of float
        Unit vectors, world frame.
    """

    flag: int
    body: int
    other: int
    link: int
    other_link: int
    position: Triple
    other_position: Triple
    normal: Triple
    distance: float
    force: float
    friction: float
    friction_direction: Triple
    other_friction: float
    other_friction_direction: Triple


class ConstraintInfo(NamedTuple):
    """A constraint, in the order of ``pybullet.getConstraintInfo`` and ``createConstraint``.

    Attributes
    ----------
    parent, parent_link, child, child_link : int
        The bodies that it joins and their links. A child of -1 is the world.
    kind : int
        PyBullet's type of joint.
    axis : tuple of float
        Axis of the joint in the frame of the child.
    parent_pivot, child_pivot : tuple of float
        Where it holds, m, in the frame of the principal axes of each.
    parent_frame, child_frame : tuple of float
        Quaternions (x, y, z, w) of the joint in the same frames.
    max_force : float
        Largest force that it can exert, N.
    """

    parent: int
    parent_link: int
    child: int
    child_link: int
    kind: int
    axis: Triple
    parent_pivot: Triple
    child_pivot: Triple
    parent_frame: Quaternion
    child_frame: Quaternion
    max_force: float


@dataclass(frozen=True)
class ContactProperties:
    """How a body's surface touches and how its motion is damped; pieces take these over from what broke.

    Attributes
    ----------
    friction, rolling_friction, spinning_friction : float
        Coefficients; the engine multiplies those of two bodies.
    restitution : float
        Coefficient of restitution, multiplied in the same way.
    contact_damping, contact_stiffness : float
        Of soft contacts, N·s/m and N/m; -1 is rigid contact, the engine's default.
    margin : float
        Distance at which the engine begins to see contacts, m.
    linear_damping, angular_damping : float
        Share of the velocity lost per second, 1/s.
    """

    friction: float
    restitution: float
    rolling_friction: float = 0.0
    spinning_friction: float = 0.0
    contact_damping: float = -1.0
    contact_stiffness: float = -1.0
    margin: float = 1e-3
    linear_damping: float = 0.04
    angular_damping: float = 0.04


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid body, or one link of an articulated one, as a contact sees it.

    Attributes
    ----------
    mass : float
        kg; 0 where it is static.
    moments : ndarray of float64, shape (3,)
        Principal moments of inertia, kg·m².
    center : ndarray of float64, shape (3,)
        Centre of mass, m, world frame.
    rotation : ndarray of float64, shape (3, 3)
        Principal axes as columns, world frame.
    restitution, friction : float
        Coefficients.
    jointed : bool
        Whether it has joints, which hold it up.
    contact_stiffness : float
        Of soft contacts with it, N/m; 0 or less where nobody has set it.
    """

    mass: float
    moments: FloatArray
    center: FloatArray
    rotation: FloatArray
    restitution: float
    friction: float
    jointed: bool
    contact_stiffness: float = 0.0


class BodyContacts:
    """The n contacts of one body in the last step, as they were in the pose before it.

    Parameters
    ----------
    points : sequence of ContactPoint
        The contacts, the body being body a.

    Attributes
    ----------
    others : tuple of (int, int), length n
        Body and link that each contact is with; link -1 is the base.
    pushing : set of (int, int)
        Those of them that push on the body.
    force : float
        Sum of the normal forces, N.

    Notes
    -----
    Most are looked at once and dropped, so the arrays are made when first asked for.
    """

    def __init__(self, points: Sequence[ContactPoint]) -> None:
        self._points = points
        self.others: tuple[BodyLink, ...] = tuple((q[2], q[4]) for q in points)
        self.pushing: set[BodyLink] = {(q[2], q[4]) for q in points if q[9] > 0.0}
        self.force: float = sum(q[9] for q in points)

    def select(self, chosen: Sequence[int]) -> BodyContacts:
        """Keep some of the contacts.

        Parameters
        ----------
        chosen : sequence of int
            Their indices.

        Returns
        -------
        BodyContacts
            Those contacts, in that order.
        """
        return BodyContacts([self._points[k] for k in chosen])

    @cached_property
    def points(self) -> FloatArray:
        """Points on the body, shape (n, 3), m, world frame."""
        return np.array([q[5] for q in self._points])

    @cached_property
    def normals(self) -> FloatArray:
        """Unit vectors the way the body is pushed, shape (n, 3), world frame."""
        return np.array([q[7] for q in self._points])

    @cached_property
    def depths(self) -> FloatArray:
        """How far the two overlap, shape (n,), m; negative where there is a gap."""
        return np.array([-q[8] for q in self._points])

    @cached_property
    def forces(self) -> FloatArray:
        """Normal forces, shape (n,), N."""
        return np.array([q[9] for q in self._points])


class ContactForces(NamedTuple):
    """All n contacts of the simulation that carried force in the last step.

    Attributes
    ----------
    bodies : ndarray of int64, shape (n, 2)
        Ids of the two bodies.
    forces : ndarray of float64, shape (n, 3)
        Force on the first, friction included, N, world frame.
    on_first, on_second : ndarray of float64, shape (n, 3)
        Points on each, m, world frame.
    depths : ndarray of float64, shape (n,)
        How far the two overlap, m.
    """

    bodies: IntArray
    forces: FloatArray
    on_first: FloatArray
    on_second: FloatArray
    depths: FloatArray


@dataclass(frozen=True)
class BodyState:
    """Where a body is and how it moves: all it takes to put it back there.

    Attributes
    ----------
    body : int
        Its id.
    placement : Placement
        Centre of mass, m, and quaternion of the principal axes; world frame.
    motion : Motion
        Velocity, m/s, and angular velocity, rad/s; world frame.
    joints : tuple of int
        Indices of the joints that can move.
    angles : tuple of tuple of float
        Position of each: rad or m, or a quaternion where it is a ball joint.
    rates : tuple of tuple of float
        Velocity of each, rad/s or m/s.
    """

    body: int
    placement: Placement
    motion: Motion
    joints: tuple[int, ...] = ()
    angles: tuple[tuple[float, ...], ...] = ()
    rates: JointRates = ()
