"""The only module of a running simulation that talks to PyBullet; every call carries its physics client id.

It moves numbers in and out of the engine and decides nothing. `Engine` sees a client that belongs to somebody
else, whose engine-wide parameters are read and never set; `Scene` is a client of one's own.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Sequence
from itertools import count
from typing import Any

import numpy as np
import pybullet as p

from ..common.arrays import FloatArray, IntArray
from ..common.errors import PhysicsError
from ..fracture.pieces import ConvexParts
from .rotations import integrate_rotation, rotation_of
from .states import BodyContacts, BodyState, ContactForces, ContactProperties, Motion, Placement, RigidBody, Triple

_MEMORY = "/dev/shm"  # where compound shapes pass through, when there is such a place
_TOKENS = count()
_NOWHERE, _CORNERS = ((0.0, 0.0, 0.0),) * 3, (0, 1, 2)


class Engine:
    """A connected PyBullet client, seen through the calls that breaking needs."""

    def __init__(self, client: int) -> None:
        client = getattr(client, "_client", client)  # a pybullet_utils.bullet_client.BulletClient
        if isinstance(client, bool) or not isinstance(client, (int, np.integer)):
            raise PhysicsError(f"a physics client is the integer that pybullet.connect returns, got {client!r}")
        self.client = int(client)
        self.require_connection()
        self._hidden = -1
        self._shapes: dict[tuple[Any, ...], tuple[ConvexParts, int]] = {}
        self._joints: dict[int, tuple[int, ...]] = {}

    def require_connection(self) -> None:
        """Raise PhysicsError unless the client is connected."""
        if not p.getConnectionInfo(self.client)["isConnected"]:
            raise PhysicsError(
                f"physics client {self.client} is not connected; "
                "connect first: client = pybullet.connect(pybullet.DIRECT)"
            )

    @property
    def has_window(self) -> bool:
        return bool(p.getConnectionInfo(self.client)["connectionMethod"] == p.GUI)

    def clock(self) -> tuple[float, Triple]:
        """The time step in s and gravity in m/s²."""
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
        p.stepSimulation(physicsClientId=self.client)

    def body_count_and_last(self) -> tuple[int, int]:
        """The number of bodies, and the id of the last: a change of either tells that some came or went."""
        count = p.getNumBodies(physicsClientId=self.client)
        return count, p.getBodyUniqueId(count - 1, physicsClientId=self.client) if count else -1

    def body_count(self) -> int:
        """The number of bodies."""
        return int(p.getNumBodies(physicsClientId=self.client))

    def body_ids(self) -> list[int]:
        client = self.client
        return [p.getBodyUniqueId(k, physicsClientId=client) for k in range(p.getNumBodies(physicsClientId=client))]

    # How things move

    def placement(self, body: int) -> Placement:
        """Centre of mass, and the quaternion of the principal axes; world."""
        placement: Placement = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
        return placement

    def motion(self, body: int) -> Motion:
        motion: Motion = p.getBaseVelocity(body, physicsClientId=self.client)
        return motion

    def link_motion(self, body: int, link: int) -> Motion:
        """As ``motion``, of a link."""
        if link < 0:
            return self.motion(body)
        state = p.getLinkState(body, link, computeLinkVelocity=1, physicsClientId=self.client)
        return state[6], state[7]

    def motions(self, keys: Collection[tuple[int, int]]) -> dict[tuple[int, int], Motion]:
        """Of (body, link) each, and of the bases of these bodies; the links of a body by one call."""
        found = {(body, -1): self.motion(body) for body in {body for body, _ in keys}}
        links: dict[int, list[int]] = {}
        for body, link in keys:
            if link >= 0:
                links.setdefault(body, []).append(link)
        for body, some in links.items():
            states = p.getLinkStates(body, some, computeLinkVelocity=1, physicsClientId=self.client)
            found |= {(body, link): (state[6], state[7]) for link, state in zip(some, states, strict=True)}
        return found

    def joint_rates(self, body: int) -> tuple[tuple[float, ...], ...]:
        """The velocity of each joint that moves."""
        joints = self._movable(body)
        if not joints:
            return ()
        states = p.getJointStatesMultiDof(body, joints, physicsClientId=self.client)
        return tuple(state[1] for state in states)

    def _movable(self, body: int) -> tuple[int, ...]:
        joints = self._joints.get(body)
        if joints is None:
            client = self.client
            joints = tuple(
                joint
                for joint in range(p.getNumJoints(body, physicsClientId=client))
                if p.getJointInfo(body, joint, physicsClientId=client)[2] != p.JOINT_FIXED
            )
            self._joints[body] = joints
        return joints

    def forget_joints(self) -> None:
        """Read the joints of bodies anew, since ids of removed ones are handed out again."""
        self._joints.clear()

    def state_before(
        self, body: int, motion: Motion, rates: Sequence[tuple[float, ...]] | None, dt: float
    ) -> BodyState:
        """The state of a body before the last step, given how it moved then; rates: of its joints, None keeping what
        they are."""
        place = self.placement_before(body, dt)
        joints = self._movable(body)
        if not joints:
            return BodyState(body, place, motion)
        states = p.getJointStatesMultiDof(body, joints, physicsClientId=self.client)
        now = tuple(state[1] for state in states)
        # A ball joint's place is a quaternion, which a step backwards would have to compose; a step's worth is kept.
        angles = tuple((state[0][0] - dt * state[1][0],) if len(state[0]) == 1 else tuple(state[0]) for state in states)
        return BodyState(body, place, motion, joints, angles, now if rates is None else tuple(rates))

    def restore(self, state: BodyState) -> None:
        """Put a body back."""
        client = self.client
        p.resetBasePositionAndOrientation(state.body, *state.placement, physicsClientId=client)
        p.resetBaseVelocity(state.body, *state.motion, physicsClientId=client)
        for joint, angle, rate in zip(state.joints, state.angles, state.rates, strict=True):
            # One joint at a time: the call for several at once has crashed the engine.
            if len(angle) == 1:
                p.resetJointState(state.body, joint, angle[0], rate[0], physicsClientId=client)
            elif len(angle) == 4:
                p.resetJointStateMultiDof(state.body, joint, angle, rate, physicsClientId=client)

    def set_velocity(self, body: int, linear: FloatArray, angular: FloatArray) -> None:
        """Give a body another velocity."""
        p.resetBaseVelocity(body, linear.tolist(), angular.tolist(), physicsClientId=self.client)

    def is_articulated(self, body: int) -> bool:
        """Whether it is articulated."""
        return bool(p.getNumJoints(body, physicsClientId=self.client) > 0)

    def is_static(self, body: int) -> bool:
        """Whether it has no mass and no joints; a body that does not exist counts as static."""
        try:
            return self.mass(body) == 0.0 and not self.is_articulated(body)
        except p.error:
            return True

    # What touches what

    def overlapping(self, low: Triple, high: Triple) -> tuple[tuple[int, int], ...]:
        """(body, link) of everything whose bounding box met this one when the last step looked for contacts."""
        return p.getOverlappingObjects(low, high, physicsClientId=self.client) or ()

    def bounding_box(self, body: int, link: int) -> tuple[Triple, Triple]:
        """Of a body's base or a link, where it is now; axis-aligned."""
        box: tuple[Triple, Triple] = p.getAABB(body, link, physicsClientId=self.client)
        return box

    def plane_of(self, body: int) -> tuple[FloatArray, float] | None:
        """Normal (3,) and height over the origin of a body that is an infinite plane."""
        shapes = p.getCollisionShapeData(body, -1, physicsClientId=self.client)
        if not shapes or shapes[0][2] != p.GEOM_PLANE:
            return None
        center, quaternion = self.placement(body)
        normal = rotation_of(quaternion) @ np.array(shapes[0][3])
        return normal, float(normal @ center)

    def contacts(self, body: int) -> BodyContacts | None:
        """The contacts of a body in the last step, if any pushed on it. With them go those in which it is too deep for
        no hit: the solver may leave what touched first without force for one beside it."""
        found = p.getContactPoints(bodyA=body, physicsClientId=self.client) or ()
        points = [q for q in found if q[9] > 0.0 or q[8] < 0.0] if any(q[9] > 0.0 for q in found) else ()
        return BodyContacts(points) if points else None

    def are_touching(self, body: int, other: int) -> bool:
        """Whether the two have a contact, with force or without."""
        return bool(p.getContactPoints(bodyA=body, bodyB=other, physicsClientId=self.client))

    def contact_forces(self) -> ContactForces:
        """Every contact that carried force."""
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

    def constraints(self) -> list[tuple[int, tuple[Any, ...]]]:
        """(id, description) of the constraints between bodies."""
        client = self.client
        count = p.getNumConstraints(physicsClientId=client)
        ids = [p.getConstraintUniqueId(k, physicsClientId=client) for k in range(count)]
        return [(one, p.getConstraintInfo(one, physicsClientId=client)) for one in ids]

    def constrained_to(self, bodies: Collection[int]) -> list[int]:
        """The other bodies that constraints join to some of these."""
        if not p.getNumConstraints(physicsClientId=self.client):
            return []
        pairs = [(info[0], info[2]) for _, info in self.constraints() if info[2] >= 0]
        return sorted(
            {two for one, two in [*pairs, *((b, a) for a, b in pairs)] if one in bodies and two not in bodies}
        )

    def remove_constraint(self, constraint: int) -> None:
        p.removeConstraint(constraint, physicsClientId=self.client)

    def create_constraint(self, info: Sequence[Any]) -> int:
        """A constraint between two bodies, described as ``constraints`` does -> its id."""
        constraint: int = p.createConstraint(*info[:10], physicsClientId=self.client)
        p.changeConstraint(constraint, maxForce=info[10], physicsClientId=self.client)
        return constraint

    def placement_before(self, body: int, dt: float) -> Placement:
        """Where a body was before the last step: the engine moves everything with the velocity that it ends a step
        with, so that follows from place and velocity now, to rounding."""
        center, quaternion = self.placement(body)
        linear, angular = self.motion(body)
        x, y, z = (a - dt * b for a, b in zip(center, linear, strict=True))
        return (x, y, z), integrate_rotation(quaternion, angular, -dt)

    def rigid_body(self, body: int, link: int) -> RigidBody:
        """A body or link as it is now."""
        info = p.getDynamicsInfo(body, link, physicsClientId=self.client)
        if link < 0:
            center, axes = self.placement(body)
        else:
            center, axes = p.getLinkState(body, link, physicsClientId=self.client)[:2]
        jointed = p.getNumJoints(body, physicsClientId=self.client) > 0
        return RigidBody(info[0], np.array(info[2]), np.array(center), rotation_of(axes), info[5], info[1], jointed)

    def mass(self, body: int) -> float:
        """kg; 0 for one that is static."""
        return float(p.getDynamicsInfo(body, -1, physicsClientId=self.client)[0])

    def contact_properties(self, body: int, linear_damping: float, angular_damping: float) -> ContactProperties:
        """The body's contact properties as they are now; damping cannot be read back from the engine."""
        info = p.getDynamicsInfo(body, -1, physicsClientId=self.client)
        return ContactProperties(
            info[1], info[5], info[6], info[7], info[8], info[9], info[11], linear_damping, angular_damping
        )

    # Making and removing bodies

    def create_body(
        self,
        parts: ConvexParts,
        frame: Placement,
        mass: float,
        moments: Sequence[float],
        place: Placement,
        motion: Motion,
        surface: ContactProperties,
        visual: int,
    ) -> int:
        """A body of convex parts -> its id.

        frame: of the parts, seen from the body's, which is of its principal axes about its centre of mass.
        """
        client = self.client
        try:
            known = len(self._shapes)
            shape = self._shape(parts, frame)
            body: int = p.createMultiBody(mass, shape, visual, *place, physicsClientId=client)
            if len(self._shapes) == known and not self._has_shape(body, parts, frame):
                p.removeBody(body, physicsClientId=client)  # somebody has reset the simulation, and no id is ours now
                self._shapes.clear()
                self._hidden = -1
                shape = self._shape(parts, frame)
                body = p.createMultiBody(mass, shape, self.invisible_shape(), *place, physicsClientId=client)
        except p.error as error:
            raise PhysicsError(f"PyBullet rejected a body of {len(parts)} convex parts: {error}") from error
        options = {}
        if surface.contact_stiffness >= 0.0:
            options = {
                "contactStiffness": surface.contact_stiffness,
                "contactDamping": surface.contact_damping,
            }
        p.changeDynamics(
            body,
            -1,
            lateralFriction=surface.friction,
            restitution=surface.restitution,
            rollingFriction=surface.rolling_friction,
            spinningFriction=surface.spinning_friction,
            linearDamping=surface.linear_damping,
            angularDamping=surface.angular_damping,
            collisionMargin=surface.margin,
            contactProcessingThreshold=1e-4,  # the default 2 cm destroys restitution at small steps
            maxJointVelocity=1e5,  # otherwise 100 m/s and 100 rad/s
            physicsClientId=client,
            **options,
        )
        p.changeDynamics(body, -1, localInertiaDiagonal=moments, physicsClientId=client)
        p.resetBaseVelocity(body, *motion, physicsClientId=client)
        return body

    def _shape(self, parts: ConvexParts, frame: Placement) -> int:
        """A collision shape. The engine frees none before resetSimulation, so what comes again is used again."""
        key = parts.scale, frame[0], tuple(map(id, parts.points))
        if key in self._shapes:
            return self._shapes[key][1]
        # By a file even where it is one hull: the call that takes points leaks them.
        path = _pass_file(b"".join(parts.blocks))
        try:
            shape: int = p.createCollisionShape(
                p.GEOM_MESH,
                fileName=path,
                meshScale=[parts.scale] * 3,
                collisionFramePosition=frame[0],
                collisionFrameOrientation=frame[1],
                physicsClientId=self.client,
            )
        finally:
            os.unlink(path)
        self._shapes[key] = parts, shape  # with the parts, lest others get their identities
        return shape

    def _has_shape(self, body: int, parts: ConvexParts, frame: Placement) -> bool:
        """Whether a body is made of the parts."""
        shapes = p.getCollisionShapeData(body, -1, physicsClientId=self.client)
        return len(shapes) == len(parts) and shapes[0][2] == p.GEOM_MESH and bool(np.allclose(shapes[0][5], frame[0]))

    def invisible_shape(self) -> int:
        """The visual shape that shows nothing: without one the engine would draw the collision shape."""
        if self._hidden < 0:
            self._hidden = p.createVisualShape(
                p.GEOM_MESH,
                vertices=_NOWHERE,  # the engine keeps a reference to each of these for ever
                indices=_CORNERS,
                rgbaColor=(0, 0, 0, 0),
                physicsClientId=self.client,
            )
        return self._hidden

    def create_visual(self, vertices: FloatArray, faces: IntArray, color: Sequence[float]) -> int:
        """A flat-shaded visual shape: each face has its own three corners and one normal."""
        corners = vertices[faces]  # (F, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        shape: int = p.createVisualShape(
            p.GEOM_MESH,
            vertices=corners.reshape(-1, 3).tolist(),
            indices=list(range(corners.shape[0] * 3)),
            normals=np.repeat(normals, 3, axis=0).tolist(),
            rgbaColor=list(color),
            specularColor=[0.2, 0.2, 0.2],
            physicsClientId=self.client,
        )
        return shape

    def mark(self, body: int) -> str:
        """Tag a body, since PyBullet hands the ids of removed bodies out again -> the tag."""
        token = f"fracsim-{next(_TOKENS)}"
        p.addUserData(body, token, "", physicsClientId=self.client)
        return token

    def is_marked(self, body: int, token: str) -> bool:
        """Whether the body with this id is still the one that got the tag."""
        return bool(p.getUserDataId(body, token, physicsClientId=self.client) >= 0)

    def remove_body(self, body: int) -> None:
        p.removeBody(body, physicsClientId=self.client)


def _pass_file(data: bytes) -> str:
    """A file of shapes for the engine to read -> its path. The name is never used twice: PyBullet caches by name."""
    folder = _MEMORY if os.access(_MEMORY, os.W_OK) else tempfile.gettempdir()
    path = f"{folder}/fracsim-{os.getpid()}-{next(_TOKENS)}.obj"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        os.write(handle, data)
    finally:
        os.close(handle)
    return path
