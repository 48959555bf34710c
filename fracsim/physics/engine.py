"""The only module that talks to PyBullet; every call carries its physics client id.

It moves numbers in and out of the engine and decides nothing. `Engine` sees a client that belongs to somebody
else, whose engine-wide parameters are read and never set; `Scene` is a client of one's own.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import numpy.typing as npt
import pybullet as p
from scipy.ndimage import uniform_filter

from ..errors import PhysicsError, RenderError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
ByteArray = npt.NDArray[np.uint8]
Hull = tuple[FloatArray, IntArray]
Triple = tuple[float, float, float]
Placement = tuple[Triple, tuple[float, float, float, float]]
Motion = tuple[Triple, Triple]  # linear velocity of the centre of mass, angular velocity; world frame

GRAVITY = 9.81  # m/s², of a Scene
_MEMORY = "/dev/shm"  # where compound shapes pass through, when there is such a place
_TOKENS = count()


@dataclass(frozen=True)
class Surface:
    """What a body's contacts and damping are made of; pieces take over their parent's."""

    friction: float
    restitution: float
    rolling_friction: float = 0.0
    spinning_friction: float = 0.0
    contact_damping: float = -1.0  # -1: rigid contact, the engine's default
    contact_stiffness: float = -1.0
    margin: float = 1e-3
    linear_damping: float = 0.04
    angular_damping: float = 0.04


@dataclass(frozen=True, eq=False)
class Rigid:
    """A rigid body, or one link of an articulated one, as a contact sees it. A static body has mass 0."""

    mass: float
    moments: FloatArray  # (3,) principal moments of inertia
    center: FloatArray  # (3,) centre of mass, world
    rotation: FloatArray  # (3, 3) principal axes as columns, world
    restitution: float
    jointed: bool


@dataclass(frozen=True)
class Contact:
    """A contact that carries force, as reported for the pose before the step."""

    other: int
    link: int  # of the other body; -1 is its base
    point: Triple  # on the body that was asked about, world
    normal: Triple  # unit, the way that body is pushed


class Engine:
    """A connected PyBullet client, seen through the calls that breaking needs."""

    def __init__(self, client: int) -> None:
        self.client = client
        self.require_connection()
        self._hidden = -1

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

    def clock(self) -> tuple[float, FloatArray]:
        """The time step in s and gravity (3,) in m/s²."""
        info = p.getPhysicsEngineParameters(physicsClientId=self.client)
        gravity = [info[f"gravityAcceleration{axis}"] for axis in "XYZ"]
        return float(info["fixedTimeStep"]), np.array(gravity)

    def step(self) -> None:
        p.stepSimulation(physicsClientId=self.client)

    def placement(self, body: int) -> Placement:
        """Centre of mass, and the quaternion of the principal axes; world."""
        placement: Placement = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
        return placement

    def motion(self, body: int) -> Motion:
        motion: Motion = p.getBaseVelocity(body, physicsClientId=self.client)
        return motion

    def motions(self) -> dict[tuple[int, int], Motion]:
        """(body, link) -> motion of everything in the world; link -1 is a body's base."""
        client, result = self.client, {}
        for index in range(p.getNumBodies(physicsClientId=client)):
            body = p.getBodyUniqueId(index, physicsClientId=client)
            try:
                result[body, -1] = p.getBaseVelocity(body, physicsClientId=client)
                links = p.getNumJoints(body, physicsClientId=client)
                if links:
                    states = p.getLinkStates(body, range(links), computeLinkVelocity=1, physicsClientId=client)
                    result.update({(body, link): (state[6], state[7]) for link, state in enumerate(states)})
            except p.error:  # a deformable body has no rigid motion
                continue
        return result

    def contacts(self, body: int) -> list[Contact]:
        """The contacts of the last step that pushed on the body."""
        points = p.getContactPoints(bodyA=body, physicsClientId=self.client)
        return [Contact(q[2], q[4], q[5], q[7]) for q in points or () if q[9] > 0.0]

    def rigid(self, body: int, link: int) -> Rigid:
        """A body or link as it is now."""
        info = p.getDynamicsInfo(body, link, physicsClientId=self.client)
        if link < 0:
            center, axes = self.placement(body)
        else:
            center, axes = p.getLinkState(body, link, physicsClientId=self.client)[:2]
        jointed = p.getNumJoints(body, physicsClientId=self.client) > 0
        return Rigid(info[0], np.array(info[2]), np.array(center), rotation_of(axes), info[5], jointed)

    def surface(self, body: int, linear_damping: float, angular_damping: float) -> Surface:
        """The body's contact properties as they are now; damping cannot be read back from the engine."""
        info = p.getDynamicsInfo(body, -1, physicsClientId=self.client)
        return Surface(info[1], info[5], info[6], info[7], info[8], info[9], info[11], linear_damping, angular_damping)

    def create(
        self,
        hulls: Sequence[Hull],
        mass: float,
        moments: FloatArray,
        position: FloatArray,
        orientation: FloatArray,
        motion: tuple[FloatArray, FloatArray],
        surface: Surface,
        visual: int,
    ) -> int:
        """A body of convex parts given along its principal axes about its centre of mass -> its id."""
        client = self.client
        path = ""
        try:
            if len(hulls) == 1:
                shape = p.createCollisionShape(p.GEOM_MESH, vertices=hulls[0][0].tolist(), physicsClientId=client)
            else:
                path = _write_parts(hulls)
                shape = p.createCollisionShape(p.GEOM_MESH, fileName=path, physicsClientId=client)
            body: int = p.createMultiBody(
                mass, shape, visual, position.tolist(), orientation.tolist(), physicsClientId=client
            )
        except p.error as error:
            raise PhysicsError(f"PyBullet rejected a body of {len(hulls)} convex parts: {error}") from error
        finally:
            if path:
                os.unlink(path)
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
        p.changeDynamics(body, -1, localInertiaDiagonal=moments.tolist(), physicsClientId=client)
        p.resetBaseVelocity(body, motion[0].tolist(), motion[1].tolist(), physicsClientId=client)
        return body

    def hidden(self) -> int:
        """The visual shape that shows nothing: without one the engine would draw the collision shape."""
        if self._hidden < 0:
            self._hidden = p.createVisualShape(
                p.GEOM_MESH,
                vertices=[[0.0, 0.0, 0.0]] * 3,
                indices=[0, 1, 2],
                rgbaColor=[0, 0, 0, 0],
                physicsClientId=self.client,
            )
        return self._hidden

    def visual(self, vertices: FloatArray, faces: IntArray, color: Sequence[float]) -> int:
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

    def remove(self, body: int) -> None:
        p.removeBody(body, physicsClientId=self.client)


def rotation_of(quaternion: Sequence[float]) -> FloatArray:
    """Quaternion (x, y, z, w) -> rotation matrix (3, 3)."""
    return np.array(p.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def _write_parts(hulls: Sequence[Hull]) -> str:
    """An OBJ file of one group a hull -> its path. The name is never used twice: PyBullet caches by name.

    Only the points matter to a convex part, so each is written with just the faces that name every point.
    """
    text, first = [], 1
    for points, _ in hulls:
        n = len(points)
        corners = np.arange(-(-n // 3) * 3) % n + first
        text.append("o part\n" + "v %.7g %.7g %.7g\n" * n % tuple(points.ravel().tolist()))
        text.append("f %d %d %d\n" * (len(corners) // 3) % tuple(corners.tolist()))
        first += n
    memory = _MEMORY if os.access(_MEMORY, os.W_OK) else None
    handle, path = tempfile.mkstemp(prefix="fracsim-", suffix=".obj", dir=memory)
    with os.fdopen(handle, "w") as file:
        file.write("".join(text))
    return path


class Scene:
    """A client of one's own with a floor at z = 0, gravity, a clock and a camera.

    window: whether to open one. show: whether there is anything to see, in the window or in an image.
    """

    def __init__(self, time_step: float, window: bool = False, show: bool = False) -> None:
        if window and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            raise RenderError("no display for a window: set DISPLAY, or use render_mode='rgb_array'")
        self.time_step, self.show = time_step, show or window
        self.client: int = p.connect(p.GUI if window else p.DIRECT)
        if self.client < 0:
            raise RenderError("PyBullet opens one window per process; close the other one first")
        if window:
            p.configureDebugVisualizer(p.COV_ENABLE_GUI, 0, physicsClientId=self.client)

    def reset(self) -> None:
        """Empty the world, which also frees the shapes of removed bodies, and lay the floor."""
        client = self.client
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=self.time_step,
            enableFileCaching=0,  # the cache would keep every compound shape's file for ever
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        p.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        visual = _tiles(client, 0) if self.show else -1
        floor = p.createMultiBody(0.0, shape, visual, physicsClientId=client)
        if self.show:
            p.createMultiBody(0.0, -1, _tiles(client, 1), physicsClientId=client)
        # The engine multiplies the two restitutions, so that the object's own is what counts here.
        p.changeDynamics(floor, -1, lateralFriction=1.0, restitution=1.0, physicsClientId=client)

    def push(self, body: int, force: FloatArray, torque: FloatArray) -> None:
        """Act on a body's centre of mass during the next step; N and N·m, world frame."""
        center, _ = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
        p.applyExternalForce(body, -1, force.tolist(), center, p.WORLD_FRAME, physicsClientId=self.client)
        p.applyExternalTorque(body, -1, torque.tolist(), p.WORLD_FRAME, physicsClientId=self.client)

    def image(self, eye: Sequence[float], target: Sequence[float], width: int, height: int) -> ByteArray:
        """(height, width, 3) what a camera at `eye` sees, drawn in software.

        The renderer speckles lit surfaces with their own shadow. So the shadow is what an image without any
        has over one with them, kept where it is dense.
        """
        lit, dark = (self._draw(eye, target, width, height, shadow) for shadow in (0, 1))
        lost = lit - dark  # (height, width, 3)
        cover = uniform_filter((lost.max(axis=2) > 2.0).astype(np.float32), 7)[..., None]
        depth = uniform_filter(lost, (7, 7, 1)) / np.maximum(cover, 1e-3)
        shaded = lit - depth * np.clip((cover - 0.55) / 0.3, 0.0, 1.0)
        image: ByteArray = np.clip(np.rint(shaded), 0.0, 255.0).astype(np.uint8)
        return image

    def _draw(
        self, eye: Sequence[float], target: Sequence[float], width: int, height: int, shadow: int
    ) -> npt.NDArray[np.float32]:
        pixels = p.getCameraImage(
            width,
            height,
            p.computeViewMatrix(eye, target, (0.0, 0.0, 1.0)),
            p.computeProjectionMatrixFOV(40.0, width / height, 0.05, 50.0),
            lightDirection=(-1.0, -1.5, 3.0),
            lightDistance=4.0,
            shadow=shadow,
            lightAmbientCoeff=0.55,
            lightDiffuseCoeff=0.5,
            lightSpecularCoeff=0.1,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )[2]
        return np.reshape(pixels, (height, width, 4))[..., :3].astype(np.float32)

    def close(self) -> None:
        if p.getConnectionInfo(self.client)["isConnected"]:
            p.disconnect(self.client)


def _tiles(client: int, parity: int, count: int = 24, side: float = 0.25) -> int:
    """Every second tile of a chequered floor, as one visual shape."""
    index = np.arange(count)
    i, j = (axis.ravel() for axis in np.meshgrid(index, index))
    origin = np.stack([i, j], axis=1)[(i + j) % 2 == parity] - count / 2
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = np.zeros((len(origin), 4, 3))
    corners[..., :2] = (origin[:, None] + square) * side
    faces = np.arange(len(origin))[:, None, None] * 4 + [[0, 1, 2], [0, 2, 3]]
    shade = (0.80, 0.82, 0.84) if parity else (0.92, 0.93, 0.94)
    shape: int = p.createVisualShape(
        p.GEOM_MESH,
        vertices=corners.reshape(-1, 3).tolist(),
        indices=faces.ravel().tolist(),
        normals=[[0.0, 0.0, 1.0]] * corners.shape[0] * 4,
        rgbaColor=[*shade, 1.0],
        specularColor=[0.0, 0.0, 0.0],
        physicsClientId=client,
    )
    return shape
