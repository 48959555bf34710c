"""Shapes in a PyBullet client, each made once, and the bodies that are made of them.

`spawn` makes bodies with it; nothing else does.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from itertools import count

import numpy as np
import pybullet as p

from ..common.arrays import FloatArray, IntArray
from ..common.errors import PhysicsError
from ..fracture.pieces import ConvexParts
from .states import ContactProperties, Motion, Placement

MEMORY = "/dev/shm"  # where shapes pass through to the engine, if there is such a place: a file there is no disk access
# m. The engine's default of 2 cm destroys restitution at small time steps.
CONTACT_PROCESSING_THRESHOLD = 1e-4
# m/s and rad/s. The engine's default is 100, which fast pieces exceed.
MAX_VELOCITY = 1e5

_FILES = count()  # numbers of the files of this process
_UNSEEN = (0.0, 0.0, 0.0, 0.0)  # red, green, blue, opacity
_POINT, _TRIANGLE = ((0.0, 0.0, 0.0),) * 3, (0, 1, 2)  # a triangle without extent, which shows nothing

ShapeKey = tuple[float, Placement, tuple[int, ...]]


class Shapes:
    """The shapes that one client was given.

    The engine frees no shape before resetSimulation, so one that comes again is used again.

    Parameters
    ----------
    client : int
        PyBullet's id of the client.
    """

    def __init__(self, client: int) -> None:
        self._client = client
        self._invisible = -1
        # With the convex parts, lest others get their identities, which are part of the key.
        self._collision: dict[ShapeKey, tuple[ConvexParts, int]] = {}

    def _forget(self) -> None:
        """Make every shape anew, since somebody has reset the simulation."""
        self._collision.clear()
        self._invisible = -1

    def _collision_shape(self, parts: ConvexParts, frame: Placement) -> tuple[int, bool]:
        """Give the collision shape of convex parts.

        Parameters
        ----------
        parts : ConvexParts
            The parts.
        frame : Placement
            Frame of the parts, seen from the body's.

        Returns
        -------
        shape : int
            Its id.
        is_new : bool
            Whether it was made just now. An older one is gone if somebody has reset the simulation since.
        """
        key = parts.scale, frame, tuple(map(id, parts.points))
        known = self._collision.get(key)
        if known is not None:
            return known[1], False
        # By a file even where it is one hull: the call that takes points leaks them.
        path = _pass_file(b"".join(parts.blocks))
        try:
            shape: int = p.createCollisionShape(
                p.GEOM_MESH,
                fileName=path,
                meshScale=[parts.scale] * 3,
                collisionFramePosition=frame[0],
                collisionFrameOrientation=frame[1],
                physicsClientId=self._client,
            )
        finally:
            os.unlink(path)
        self._collision[key] = parts, shape
        return shape, True

    def _is_made_of(self, body: int, parts: ConvexParts, frame: Placement) -> bool:
        """Tell whether a body is made of these parts in this frame.

        Parameters
        ----------
        body : int
            Its id.
        parts : ConvexParts
            The parts.
        frame : Placement
            Frame of the parts, seen from the body's.

        Returns
        -------
        bool
            False where the shape was another one's, from before a reset.
        """
        shapes = p.getCollisionShapeData(body, -1, physicsClientId=self._client)
        if len(shapes) != len(parts) or shapes[0][2] != p.GEOM_MESH:
            return False
        position, quaternion = shapes[0][5:7]
        # A quaternion and its negative are one rotation.
        turned = abs(float(np.dot(quaternion, frame[1])))
        return bool(np.allclose(position, frame[0]) and turned > 1.0 - 1e-9)

    def _shows_nothing(self, body: int) -> bool:
        """Tell whether a body has the invisible shape; after a reset its id may be that of another shape."""
        shapes = p.getVisualShapeData(body, physicsClientId=self._client)
        return len(shapes) == 1 and shapes[0][2] == p.GEOM_MESH and tuple(shapes[0][7]) == _UNSEEN

    def _invisible_shape(self) -> int:
        """Give the visual shape that shows nothing; without any the engine would draw the collision shape.

        Returns
        -------
        int
            Its id.
        """
        if self._invisible < 0:
            self._invisible = p.createVisualShape(
                p.GEOM_MESH,
                vertices=_POINT,  # the engine keeps a reference to each of these for ever
                indices=_TRIANGLE,
                rgbaColor=_UNSEEN,
                physicsClientId=self._client,
            )
        return self._invisible

    def visual(self, vertices: FloatArray, faces: IntArray, color: Sequence[float]) -> int:
        """Make a flat-shaded visual shape: each face has three corners of its own, and one normal.

        Parameters
        ----------
        vertices : ndarray of float64, shape (V, 3)
            m, in the body's frame.
        faces : ndarray of int64, shape (F, 3)
            Triangles.
        color : sequence of float, length 4
            Red, green, blue and opacity, 0 to 1.

        Returns
        -------
        int
            Its id.
        """
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
            physicsClientId=self._client,
        )
        return shape

    def create_body(
        self,
        parts: ConvexParts,
        frame: Placement,
        mass: float,
        moments: Sequence[float],
        place: Placement,
        motion: Motion,
        surface: ContactProperties,
        visual: int | None,
    ) -> int:
        """Make a body of convex parts.

        Parameters
        ----------
        parts : ConvexParts
            The parts.
        frame : Placement
            Frame of the parts, seen from the body's, which has its origin at the centre of mass and the principal
            axes as its axes.
        mass : float
            kg.
        moments : sequence of float, length 3
            Principal moments of inertia, kg·m².
        place : Placement
            Where it is.
        motion : Motion
            How it moves.
        surface : ContactProperties
            How it touches.
        visual : int, optional
            Id of a visual shape; None makes the body invisible.

        Returns
        -------
        int
            Id of the body.

        Raises
        ------
        PhysicsError
            Where the engine rejects it.
        """
        client = self._client
        try:
            shape, is_new = self._collision_shape(parts, frame)
            seen = self._invisible_shape() if visual is None else visual
            body: int = p.createMultiBody(mass, shape, seen, *place, physicsClientId=client)
            is_ours = is_new or self._is_made_of(body, parts, frame)
            if not is_ours or (visual is None and not self._shows_nothing(body)):
                # Somebody has reset the simulation, and no shape from before is ours now. A visual one is new.
                p.removeBody(body, physicsClientId=client)
                self._forget()
                shape, _ = self._collision_shape(parts, frame)
                seen = self._invisible_shape() if visual is None else visual
                body = p.createMultiBody(mass, shape, seen, *place, physicsClientId=client)
        except p.error as error:
            raise PhysicsError(f"PyBullet rejected a body of {len(parts)} convex parts: {error}") from error
        soft = {}
        if surface.contact_stiffness >= 0.0:
            soft = {"contactStiffness": surface.contact_stiffness, "contactDamping": surface.contact_damping}
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
            contactProcessingThreshold=CONTACT_PROCESSING_THRESHOLD,
            maxJointVelocity=MAX_VELOCITY,  # of the base too, whatever its name says
            physicsClientId=client,
            **soft,
        )
        p.changeDynamics(body, -1, localInertiaDiagonal=moments, physicsClientId=client)
        p.resetBaseVelocity(body, *motion, physicsClientId=client)
        return body


def _pass_file(data: bytes) -> str:
    """Write shapes for the engine to read; no name is used twice, since PyBullet caches files by name."""
    folder = MEMORY if os.access(MEMORY, os.W_OK) else tempfile.gettempdir()
    path = f"{folder}/fracsim-{os.getpid()}-{next(_FILES)}.obj"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        os.write(handle, data)
    finally:
        os.close(handle)
    return path
