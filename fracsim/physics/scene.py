"""A PyBullet client of one's own with a floor, gravity, a clock and a camera: the stage of environments and examples.

What stands on a `Scene` takes everything of the physics from this module: it also gives what environments need of the
other modules of the room.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
import numpy.typing as npt
import pybullet as p
from scipy.ndimage import uniform_filter

from ..common.arrays import ByteArray, FloatArray
from ..common.errors import PhysicsError, RenderError
from .impacts import ContactImpulse
from .rotations import rotation_of
from .states import Motion, Placement

__all__ = [
    "CAMERA",
    "GRAVITY",
    "CameraSettings",
    "ContactImpulse",
    "Motion",
    "Placement",
    "Scene",
    "rotation_of",
]

GRAVITY = 9.81  # m/s², downwards in every Scene


@dataclass(frozen=True)
class CameraSettings:
    """How `Scene.image` draws.

    Attributes
    ----------
    field_of_view : float
        Vertical angle of the image, degrees.
    near, far : float
        Distances between which things are drawn, m.
    light : tuple of float
        Direction towards the light, world frame.
    light_distance : float
        Distance of the light, m.
    ambient, diffuse, specular : float
        Shares of the light of each kind.
    shadow_step : float
        Least darkening, of 255, that counts as shadow; rounding makes smaller ones.
    shadow_window : int
        Side of the square, in pixels, over which shadow is averaged: a few times the renderer's speckles.
    shadow_cover : tuple of float
        Share of the square in shadow from which shadow is drawn, and from which it is drawn in full.
    """

    field_of_view: float = 40.0
    near: float = 0.05
    far: float = 50.0
    light: tuple[float, float, float] = (-1.0, -1.5, 3.0)
    light_distance: float = 4.0
    ambient: float = 0.55
    diffuse: float = 0.5
    specular: float = 0.1
    shadow_step: float = 2.0
    shadow_window: int = 7
    shadow_cover: tuple[float, float] = (0.55, 0.85)


CAMERA = CameraSettings()


class Scene:
    """A client of one's own with a floor at z = 0, gravity, a clock and a camera.

    A scene cannot be copied or pickled: the copy would step the same simulation.

    Parameters
    ----------
    time_step : float
        Length of a time step, s.
    window : bool
        Whether to open a window.
    show : bool
        Whether there is anything to see, in the window or in an image.

    Attributes
    ----------
    client : int
        PyBullet's id of the client.
    time_step : float
        Length of a time step, s.
    show : bool
        Whether bodies have visual shapes.

    Raises
    ------
    RenderError
        Where a window is asked for and none can be opened.

    Examples
    --------
    >>> import fracsim
    >>> from fracsim.physics.scene import Scene
    >>> scene = Scene(1 / 240)
    >>> scene.reset()
    >>> world = fracsim.World(scene.client)
    >>> body = world.add(fracsim.load("vase"), position=(0, 0, 1))
    >>> scene.close()
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

    def __getstate__(self) -> NoReturn:
        """Refuse to be copied or pickled."""
        raise PhysicsError("a Scene cannot be copied or pickled, as both would step one simulation; make another Scene")

    def reset(self) -> None:
        """Empty the simulation, which also frees the shapes of removed bodies, and lay the floor."""
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
        # The engine multiplies the two restitutions, so that only the object's own counts here.
        p.changeDynamics(floor, -1, lateralFriction=1.0, restitution=1.0, physicsClientId=client)

    def placement(self, body: int) -> Placement:
        """Ask where a body is.

        Parameters
        ----------
        body : int
            PyBullet's id of the body.

        Returns
        -------
        Placement
            Centre of mass (x, y, z), m, and the quaternion (x, y, z, w) of its principal axes; world frame.
        """
        placement: Placement = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
        return placement

    def motion(self, body: int) -> Motion:
        """Ask how a body moves.

        Parameters
        ----------
        body : int
            PyBullet's id of the body.

        Returns
        -------
        Motion
            Velocity of the centre of mass, m/s, and angular velocity, rad/s; world frame.
        """
        motion: Motion = p.getBaseVelocity(body, physicsClientId=self.client)
        return motion

    def push(self, body: int, force: FloatArray, torque: FloatArray) -> None:
        """Act on a body's centre of mass during the next step.

        Parameters
        ----------
        body : int
            PyBullet's id of the body.
        force : ndarray of float64, shape (3,)
            N, world frame.
        torque : ndarray of float64, shape (3,)
            N·m, world frame.
        """
        center, _ = self.placement(body)
        p.applyExternalForce(body, -1, force.tolist(), center, p.WORLD_FRAME, physicsClientId=self.client)
        p.applyExternalTorque(body, -1, torque.tolist(), p.WORLD_FRAME, physicsClientId=self.client)

    def image(self, eye: Sequence[float], target: Sequence[float], width: int, height: int) -> ByteArray:
        """Draw what a camera sees, in software.

        Parameters
        ----------
        eye, target : sequence of float, length 3
            Where the camera is and what it looks at, m.
        width, height : int
            Size of the image, pixels.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3)
            Red, green and blue.

        Notes
        -----
        The renderer speckles lit surfaces with their own shadow. So the shadow is the difference of an image without
        any and one with them, kept where it is dense.
        """
        lit, dark = (self._draw(eye, target, width, height, shadow) for shadow in (0, 1))
        lost = lit - dark  # (height, width, 3)
        window = CAMERA.shadow_window
        begin, full = CAMERA.shadow_cover
        cover = uniform_filter((lost.max(axis=2) > CAMERA.shadow_step).astype(np.float32), window)[..., None]
        depth = uniform_filter(lost, (window, window, 1)) / np.maximum(cover, 1e-3)
        shaded = lit - depth * np.clip((cover - begin) / (full - begin), 0.0, 1.0)
        image: ByteArray = np.clip(np.rint(shaded), 0.0, 255.0).astype(np.uint8)
        return image

    def _draw(
        self, eye: Sequence[float], target: Sequence[float], width: int, height: int, shadow: int
    ) -> npt.NDArray[np.float32]:
        """Draw with or without shadows, shape (height, width, 3)."""
        pixels = p.getCameraImage(
            width,
            height,
            p.computeViewMatrix(eye, target, (0.0, 0.0, 1.0)),
            p.computeProjectionMatrixFOV(CAMERA.field_of_view, width / height, CAMERA.near, CAMERA.far),
            lightDirection=CAMERA.light,
            lightDistance=CAMERA.light_distance,
            shadow=shadow,
            lightAmbientCoeff=CAMERA.ambient,
            lightDiffuseCoeff=CAMERA.diffuse,
            lightSpecularCoeff=CAMERA.specular,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )[2]
        # An array, or a flat tuple where PyBullet was built without numpy (isNumpyEnabled() is 0).
        image = np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)
        return image[..., :3].astype(np.float32)

    def close(self) -> None:
        """Disconnect the client; a second time does nothing."""
        if p.getConnectionInfo(self.client)["isConnected"]:
            p.disconnect(self.client)


def _tiles(client: int, parity: int, count: int = 24, side: float = 0.25) -> int:
    """Make every second tile of a chequered floor, count × count tiles of `side` m, as one visual shape."""
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
