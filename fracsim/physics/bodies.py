"""Solids to rigid bodies: exact mass properties, convex parts, and the frame that ties them to an asset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from .engine import Engine, Hull, Motion, Placement, Surface, rotation_of

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Color = tuple[float, float, float, float]

GLAZE: Color = (0.93, 0.89, 0.81, 1.0)  # an unbroken object
SHARDS: tuple[Color, ...] = (
    (0.91, 0.81, 0.66, 1.0),
    (0.79, 0.60, 0.48, 1.0),
    (0.70, 0.77, 0.72, 1.0),
    (0.88, 0.71, 0.58, 1.0),
    (0.62, 0.68, 0.74, 1.0),
    (0.94, 0.89, 0.80, 1.0),
    (0.76, 0.70, 0.58, 1.0),
    (0.84, 0.78, 0.75, 1.0),
)


class Solid(Protocol):
    """What both an asset and a piece are: a closed surface with mass properties and convex parts."""

    @property
    def vertices(self) -> FloatArray: ...
    @property
    def faces(self) -> IntArray: ...
    @property
    def mass(self) -> float: ...
    @property
    def center_of_mass(self) -> FloatArray: ...
    @property
    def inertia(self) -> FloatArray: ...
    @property
    def hulls(self) -> tuple[Hull, ...]: ...


@dataclass(frozen=True, eq=False)
class Pose:
    """Where an asset's frame is and how it moves: world = position + rotation @ asset."""

    position: FloatArray  # (3,)
    rotation: FloatArray  # (3, 3)
    linear: FloatArray  # (3,) m/s, of the origin
    angular: FloatArray  # (3,) rad/s


@dataclass(frozen=True, eq=False)
class Body:
    """A spawned solid: its id and how the engine's frame (principal axes) sits in the asset's."""

    id: int
    token: str
    mass: float
    center: FloatArray  # (3,) centre of mass, asset frame
    axes: FloatArray  # (3, 3) principal axes as columns, asset frame
    moments: FloatArray  # (3,) principal moments

    def pose(self, placement: Placement, motion: Motion) -> Pose:
        """The asset's frame, from what the engine says of the body."""
        rotation = rotation_of(placement[1]) @ self.axes.T
        arm = rotation @ self.center
        angular = np.array(motion[1])
        return Pose(placement[0] - arm, rotation, motion[0] - np.cross(angular, arm), angular)

    def pose_now(self, engine: Engine) -> Pose:
        """The asset's frame as the engine has it now."""
        return self.pose(engine.placement(self.id), engine.motion(self.id))


def spawn(engine: Engine, solid: Solid, pose: Pose, surface: Surface, color: Color | None) -> Body:
    """Put a solid into the world where `pose` has the asset's frame, moving with it; color None hides it."""
    moments, axes = np.linalg.eigh(solid.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    center = np.asarray(solid.center_of_mass)
    arm = pose.rotation @ center
    visual = engine.hidden() if color is None else engine.visual((solid.vertices - center) @ axes, solid.faces, color)
    body = engine.create(
        [((points - center) @ axes, faces) for points, faces in solid.hulls],
        float(solid.mass),
        moments,
        pose.position + arm,
        quaternion_of(pose.rotation @ axes),
        (pose.linear + np.cross(pose.angular, arm), pose.angular),
        surface,
        visual,
    )
    return Body(body, engine.mark(body), float(solid.mass), center, axes, moments)


def quaternion_of(rotation: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) -> unit quaternion (x, y, z, w), from its largest component."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    squares = np.array([2 * m[0, 0] - trace, 2 * m[1, 1] - trace, 2 * m[2, 2] - trace, trace])
    i = int(squares.argmax())
    q = np.empty(4)
    q[i] = 1 + squares[i]
    if i == 3:
        q[:3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[j], q[k], q[3] = m[j, i] + m[i, j], m[k, i] + m[i, k], m[k, j] - m[j, k]
    normal: FloatArray = q / np.linalg.norm(q)
    return normal
