"""TODO physics.scene."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pybullet as p
from scipy.ndimage import uniform_filter

from ..common.arrays import ByteArray, FloatArray
from ..common.errors import RenderError

GRAVITY = 9.81  # m/s², of a Scene


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
