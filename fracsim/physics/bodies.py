"""Solids to rigid bodies: exact mass properties, convex parts, and the frame that ties them to an asset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray, IntArray
from ..fracture.pieces import ConvexParts
from ..geometry.frames import cross
from .bullet import Engine
from .rotations import rotation_of
from .states import ContactProperties, Motion, Placement

Color = tuple[float, float, float, float]

WHOLE_COLOUR: Color = (0.93, 0.89, 0.81, 1.0)  # an unbroken object
PIECE_COLOURS: tuple[Color, ...] = (
    (0.91, 0.81, 0.66, 1.0),
    (0.79, 0.60, 0.48, 1.0),
    (0.70, 0.77, 0.72, 1.0),
    (0.88, 0.71, 0.58, 1.0),
    (0.62, 0.68, 0.74, 1.0),
    (0.94, 0.89, 0.80, 1.0),
    (0.76, 0.70, 0.58, 1.0),
    (0.84, 0.78, 0.75, 1.0),
)


class RigidSolid(Protocol):
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
    def convex_parts(self) -> ConvexParts: ...


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
        return Pose(placement[0] - arm, rotation, motion[0] - cross(angular, arm), angular)

    def pose_now(self, engine: Engine) -> Pose:
        """The asset's frame as the engine has it now."""
        return self.pose(engine.placement(self.id), engine.motion(self.id))


def spawn(
    engine: Engine,
    solids: Sequence[RigidSolid],
    pose: Pose,
    surface: ContactProperties,
    colors: Sequence[Color] | None,
    heavier: float = 1.0,
) -> list[Body]:
    """Put solids into the world where `pose` has the asset's frame, moving with it; without colors, unseen.

    heavier: how many times their own mass they have.
    """
    moments, axes = np.linalg.eigh(heavier * np.array([solid.inertia for solid in solids]))  # (n, 3), (n, 3, 3)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]
    centers = np.array([solid.center_of_mass for solid in solids])
    arms = centers @ pose.rotation.T
    speeds = pose.linear + cross(pose.angular, arms)
    turns = Rotation.from_matrix(axes)
    frames = turns.inv().as_quat().tolist()
    ways = (Rotation.from_matrix(pose.rotation) * turns).as_quat().tolist()
    places = (pose.position + arms).tolist()
    spin = tuple(pose.angular.tolist())
    bodies = []
    for k, solid in enumerate(solids):
        visual = None
        if colors is not None:
            local = (solid.vertices - centers[k]) @ axes[k]
            visual = engine.shapes.visual(local, solid.faces, colors[k % len(colors)])
        parts = solid.convex_parts
        frame = tuple(((parts.offset - centers[k]) @ axes[k]).tolist()), tuple(frames[k])
        motion = tuple(speeds[k].tolist()), spin
        mass = heavier * float(solid.mass)
        place = places[k], ways[k]
        body = engine.shapes.create_body(parts, frame, mass, moments[k].tolist(), place, motion, surface, visual)
        bodies.append(Body(body, engine.mark(body), mass, centers[k], axes[k], moments[k]))
    return bodies
