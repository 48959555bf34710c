"""PyBullet as a running simulation sees it: the calls that breaking needs, each with its client's id.

`Engine` moves numbers in and out of the engine and decides nothing. The client belongs to somebody else, so its
engine-wide parameters are read and never set.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import count
from typing import NoReturn

import numpy as np
import pybullet as p

from ..common.arrays import FloatArray
from ..common.errors import PhysicsError
from .client import client_id
from .constraints import Constraints
from .joints import Joints
from .rotations import integrate_rotation, rotation_of
from .shapes import Shapes
from .states import (
    BodyContacts,
    BodyLink,
    BodyState,
    Box,
    ContactForces,
    ContactProperties,
    JointRates,
    Motion,
    Placement,
    RigidBody,
    Triple,
)

_TOKENS = count()  # numbers of the tags of bodies in this process


class Engine:
    """A connected PyBullet client.

    In all methods, ``body`` is PyBullet's id of a body and ``link`` the index of one of its links, -1 being the base.
    A call about a body that is not there raises `BodyNotFound`. An engine cannot be copied or pickled: the copy would
    step the same simulation.

    Parameters
    ----------
    client : int or BulletClient
        What pybullet.connect returned.

    Attributes
    ----------
    client : int
        PyBullet's id of the client.
    shapes : Shapes
        Shapes of the bodies that were made here, and what makes them.
    joints : Joints
        Joints of articulated bodies.
    constraints : Constraints
        Constraints between bodies.

    Raises
    ------
    PhysicsError
        Where it is no client, or not connected.
    """

    def __init__(self, client: object) -> None:
        self.client = client_id(client)
        self.require_connection()
        self.shapes = Shapes(self.client)
        self.joints = Joints(self.client)
        self.constraints = Constraints(self.client)

    def __getstate__(self) -> NoReturn:
        """Refuse to be copied or pickled."""
        raise PhysicsError(
            "a World cannot be copied or pickled, as both would step one simulation; "
            "make another World in a client of its own"
        )

    def require_connection(self) -> None:
        """Make sure that the client is connected.

        Raises
        ------
        PhysicsError
            Where it is not.
        """
        if not p.getConnectionInfo(self.client)["isConnected"]:
            raise PhysicsError(
                f"physics client {self.client} is not connected; "
                "connect first: client = pybullet.connect(pybullet.DIRECT)"
            )

    @property
    def has_window(self) -> bool:
        """Whether somebody can watch."""
        return bool(p.getConnectionInfo(self.client)["connectionMethod"] == p.GUI)

    def clock(self) -> tuple[float, Triple]:
        """Read the clock.

        Returns
        -------
        time_step : float
            s.
        gravity : tuple of float
            (x, y, z), m/s².

        Raises
        ------
        PhysicsError
            Where the client is not connected or has substeps, of which PyBullet shows the last one's contacts only.
        """
        try:
            info = p.getPhysicsEngineParameters(physicsClientId=self.client)
        except p.error:
            self.require_connection()
            raise
        if info["numSubSteps"] > 1:
            raise PhysicsError(
                f"numSubSteps is {info['numSubSteps']}, and PyBullet shows the contacts of the last substep only: "
                "set it to 0 and make fixedTimeStep smaller instead"
            )
        gravity = (info["gravityAccelerationX"], info["gravityAccelerationY"], info["gravityAccelerationZ"])
        return info["fixedTimeStep"], gravity

    def step(self) -> None:
        """Advance the simulation by one time step."""
        p.stepSimulation(physicsClientId=self.client)

    # Which bodies there are

    def body_count(self) -> int:
        """Count the bodies.

        Returns
        -------
        int
            Their number.
        """
        return int(p.getNumBodies(physicsClientId=self.client))

    def body_count_and_last(self) -> tuple[int, int]:
        """Count the bodies and find the last: a change of either tells that some came or went.

        Returns
        -------
        count : int
            Their number.
        last : int
            Id of the last; -1 where there is none.
        """
        count = p.getNumBodies(physicsClientId=self.client)
        return count, p.getBodyUniqueId(count - 1, physicsClientId=self.client) if count else -1

    def body_ids(self) -> list[int]:
        """List the bodies.

        Returns
        -------
        list of int
            Their ids.
        """
        client = self.client
        return [p.getBodyUniqueId(k, physicsClientId=client) for k in range(p.getNumBodies(physicsClientId=client))]

    def mark(self, body: int) -> str:
        """Tag a body, since PyBullet hands the ids of removed bodies out again.

        Returns
        -------
        str
            The tag, which no other body gets.
        """
        token = f"fracsim-{next(_TOKENS)}"
        p.addUserData(body, token, "", physicsClientId=self.client)
        return token

    def is_marked(self, body: int, token: str) -> bool:
        """Tell whether the body with this id is still the one that got the tag.

        Parameters
        ----------
        body : int
            The body.
        token : str
            The tag.

        Returns
        -------
        bool
            False also where no body has this id.
        """
        return bool(p.getUserDataId(body, token, physicsClientId=self.client) >= 0)

    def mass(self, body: int) -> float:
        """Read the mass of a body's base.

        Returns
        -------
        float
            kg; 0 where it is static.
        """
        return float(p.getDynamicsInfo(body, -1, physicsClientId=self.client)[0])

    def is_static(self, body: int) -> bool:
        """Tell whether a body cannot move.

        Returns
        -------
        bool
            Whether it has no mass and no joints, or does not exist.
        """
        try:
            return self.mass(body) == 0.0 and not self.is_articulated(body)
        except p.error:
            return True

    def is_articulated(self, body: int) -> bool:
        """Tell whether a body has joints.

        Returns
        -------
        bool
            Whether it has, fixed ones included.
        """
        return bool(p.getNumJoints(body, physicsClientId=self.client) > 0)

    # How things move

    def placement(self, body: int) -> Placement:
        """Read where a body is.

        Returns
        -------
        Placement
            Centre of mass, m, and quaternion of the principal axes; world frame.
        """
        placement: Placement = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
        return placement

    def motion(self, body: int) -> Motion:
        """Read how a body moves.

        Returns
        -------
        Motion
            Velocity of the centre of mass, m/s, and angular velocity, rad/s; world frame.
        """
        motion: Motion = p.getBaseVelocity(body, physicsClientId=self.client)
        return motion

    def link_motion(self, body: int, link: int) -> Motion:
        """Read how a link moves.

        Returns
        -------
        Motion
            As `motion` gives it.
        """
        if link < 0:
            return self.motion(body)
        state = p.getLinkState(body, link, computeLinkVelocity=1, physicsClientId=self.client)
        return state[6], state[7]

    def motions(self, keys: Collection[BodyLink]) -> dict[BodyLink, Motion]:
        """Read how several things move, the links of a body by one call.

        Parameters
        ----------
        keys : collection of (int, int)
            Body and link of each.

        Returns
        -------
        dict of (int, int) to Motion
            Of each of these, and of the base of each of the bodies.
        """
        result = {(body, -1): self.motion(body) for body in {body for body, _ in keys}}
        links_of: dict[int, list[int]] = {}
        for body, link in keys:
            if link >= 0:
                links_of.setdefault(body, []).append(link)
        for body, links in links_of.items():
            states = p.getLinkStates(body, links, computeLinkVelocity=1, physicsClientId=self.client)
            result |= {(body, link): (state[6], state[7]) for link, state in zip(links, states, strict=True)}
        return result

    def set_velocity(self, body: int, linear: FloatArray, angular: FloatArray) -> None:
        """Give a body another velocity.

        Parameters
        ----------
        body : int
            The body.
        linear : ndarray of float64, shape (3,)
            Of the centre of mass, m/s, world frame.
        angular : ndarray of float64, shape (3,)
            rad/s, world frame.
        """
        p.resetBaseVelocity(body, linear.tolist(), angular.tolist(), physicsClientId=self.client)

    # Before the last step

    def placement_before(self, body: int, dt: float) -> Placement:
        """Compute where a body was before the last step.

        Parameters
        ----------
        body : int
            The body.
        dt : float
            Length of the step, s.

        Returns
        -------
        Placement
            As `placement` gives it, exact to rounding: the engine moves everything with the velocity that it ends a
            step with, so it follows from place and velocity now.
        """
        center, quaternion = self.placement(body)
        linear, angular = self.motion(body)
        x, y, z = (a - dt * b for a, b in zip(center, linear, strict=True))
        return (x, y, z), integrate_rotation(quaternion, angular, -dt)

    def state_before(self, body: int, motion: Motion, rates: JointRates | None, dt: float) -> BodyState:
        """Compute the state of a body before the last step.

        Parameters
        ----------
        body : int
            The body.
        motion : Motion
            How it moved then.
        rates : tuple of tuple of float, optional
            How its joints moved then; None keeps what they do now.
        dt : float
            Length of the step, s.

        Returns
        -------
        BodyState
            The state, as `restore` takes it.
        """
        place = self.placement_before(body, dt)
        return BodyState(body, place, motion, *self.joints.before(body, rates, dt))

    def restore(self, state: BodyState) -> None:
        """Put a body back.

        Parameters
        ----------
        state : BodyState
            Where, and how it moves there.
        """
        p.resetBasePositionAndOrientation(state.body, *state.placement, physicsClientId=self.client)
        p.resetBaseVelocity(state.body, *state.motion, physicsClientId=self.client)
        self.joints.restore(state)

    # What touches what

    def overlapping(self, low: Triple, high: Triple) -> tuple[BodyLink, ...]:
        """Find what met a box when the last step looked for contacts.

        Parameters
        ----------
        low, high : tuple of float
            Lowest and highest corner of the box, m.

        Returns
        -------
        tuple of (int, int)
            Body and link of everything whose bounding box met it.
        """
        return p.getOverlappingObjects(low, high, physicsClientId=self.client) or ()

    def bounding_box(self, body: int, link: int) -> Box:
        """Read the box around a body's base or a link, where it is now.

        Returns
        -------
        low, high : tuple of float
            Lowest and highest corner, m.
        """
        box: Box = p.getAABB(body, link, physicsClientId=self.client)
        return box

    def plane_of(self, body: int) -> tuple[FloatArray, float] | None:
        """Tell whether a body is an infinite plane, and which.

        Returns
        -------
        normal : ndarray of float64, shape (3,)
            Unit vector out of the solid side.
        height : float
            Along the normal, over the origin, m. The result is None where the body is no plane.
        """
        shapes = p.getCollisionShapeData(body, -1, physicsClientId=self.client)
        if not shapes or shapes[0][2] != p.GEOM_PLANE:
            return None
        center, quaternion = self.placement(body)
        normal = rotation_of(quaternion) @ np.array(shapes[0][3])
        return normal, float(normal @ center)

    def contacts(self, body: int) -> BodyContacts | None:
        """Read the contacts of a body in the last step.

        Returns
        -------
        BodyContacts or None
            Contacts that pushed on it, with those in which it overlaps something: the solver may leave what touched
            first without force for one beside it. None where nothing pushed.
        """
        contacts = p.getContactPoints(bodyA=body, physicsClientId=self.client) or ()
        if not any(q[9] > 0.0 for q in contacts):
            return None
        return BodyContacts([q for q in contacts if q[9] > 0.0 or q[8] < 0.0])

    def are_touching(self, body: int, other: int) -> bool:
        """Tell whether two bodies have a contact.

        Returns
        -------
        bool
            Whether they have, with force or without.
        """
        return bool(p.getContactPoints(bodyA=body, bodyB=other, physicsClientId=self.client))

    def contact_forces(self) -> ContactForces:
        """Read every contact that carried force in the last step.

        Returns
        -------
        ContactForces
            All of the simulation's.
        """
        # Asked for without naming a body, since only then normal and friction are of the same one.
        points = [q for q in p.getContactPoints(physicsClientId=self.client) or () if q[9] > 0.0]
        if not points:
            none = np.zeros((0, 3))
            return ContactForces(np.zeros((0, 2), dtype=np.int64), none, none, none, np.zeros(0))
        _, a, b, _, _, on_a, on_b, normal, gap, push, rub, way, other_rub, other_way = zip(*points, strict=True)
        force = sum(
            np.array(size)[:, None] * np.array(along)
            for size, along in ((push, normal), (rub, way), (other_rub, other_way))
        )
        return ContactForces(np.array([a, b]).T, np.asarray(force), np.array(on_a), np.array(on_b), -np.array(gap))

    def rigid_body(self, body: int, link: int) -> RigidBody:
        """Read a body or a link as a contact sees it.

        Returns
        -------
        RigidBody
            As it is now.
        """
        info = p.getDynamicsInfo(body, link, physicsClientId=self.client)
        if link < 0:
            center, axes = self.placement(body)
        else:
            center, axes = p.getLinkState(body, link, physicsClientId=self.client)[:2]
        jointed = self.is_articulated(body)
        turned = rotation_of(axes)
        return RigidBody(info[0], np.array(info[2]), np.array(center), turned, info[5], info[1], jointed, info[9])

    # What pieces take over, and what goes

    def contact_properties(self, body: int, linear_damping: float, angular_damping: float) -> ContactProperties:
        """Read the contact properties of a body as they are now.

        Parameters
        ----------
        body : int
            The body.
        linear_damping, angular_damping : float
            1/s; damping cannot be read back from the engine.

        Returns
        -------
        ContactProperties
            Both together.
        """
        info = p.getDynamicsInfo(body, -1, physicsClientId=self.client)
        return ContactProperties(
            info[1], info[5], info[6], info[7], info[8], info[9], info[11], linear_damping, angular_damping
        )

    def remove_body(self, body: int) -> None:
        """Remove a body."""
        p.removeBody(body, physicsClientId=self.client)
