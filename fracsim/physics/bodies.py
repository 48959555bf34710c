"""From solids to rigid bodies: exact mass properties, convex parts, and the frame that ties them to an asset.

The world and the replacement put bodies into the simulation with `spawn`.
"""

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
    """What an asset and a piece have in common: a closed surface with mass properties and convex parts."""

    @property
    def vertices(self) -> FloatArray:
        """Vertices of the surface, shape (V, 3), m."""

    @property
    def faces(self) -> IntArray:
        """Triangles of the surface, shape (F, 3)."""

    @property
    def mass(self) -> float:
        """Mass, kg."""

    @property
    def center_of_mass(self) -> FloatArray:
        """Centre of mass, shape (3,), m."""

    @property
    def inertia(self) -> FloatArray:
        """Inertia about the centre of mass along the frame's axes, shape (3, 3), kg·m²."""

    @property
    def convex_parts(self) -> ConvexParts:
        """Convex parts that the engine collides."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the frame of an asset is and how it moves: world = position + rotation @ asset.

    Attributes
    ----------
    position : ndarray of float64, shape (3,)
        Origin, m.
    rotation : ndarray of float64, shape (3, 3)
        Axes as columns.
    linear : ndarray of float64, shape (3,)
        Velocity of the origin, m/s.
    angular : ndarray of float64, shape (3,)
        Angular velocity, rad/s.
    """

    position: FloatArray
    rotation: FloatArray
    linear: FloatArray
    angular: FloatArray


@dataclass(frozen=True, eq=False)
class Body:
    """A solid in the simulation, and how the engine's frame of it sits in the asset's.

    The engine's frame has its origin at the centre of mass and the principal axes as its axes.

    Attributes
    ----------
    id : int
        PyBullet's id.
    token : str
        Tag that no other body has, since ids are handed out again.
    mass : float
        kg.
    center : ndarray of float64, shape (3,)
        Centre of mass, m, in the frame of the asset.
    axes : ndarray of float64, shape (3, 3)
        Principal axes as columns, in the frame of the asset.
    moments : ndarray of float64, shape (3,)
        Principal moments of inertia, kg·m².
    """

    id: int
    token: str
    mass: float
    center: FloatArray
    axes: FloatArray
    moments: FloatArray

    def pose(self, placement: Placement, motion: Motion) -> Pose:
        """Compute where the frame of the asset is, from what the engine says of the body.

        Parameters
        ----------
        placement : Placement
            Where the body is.
        motion : Motion
            How it moves.

        Returns
        -------
        Pose
            The frame of the asset.
        """
        rotation = rotation_of(placement[1]) @ self.axes.T
        arm = rotation @ self.center
        angular = np.array(motion[1])
        return Pose(placement[0] - arm, rotation, motion[0] - cross(angular, arm), angular)

    def pose_now(self, engine: Engine) -> Pose:
        """Read where the frame of the asset is now.

        Parameters
        ----------
        engine : Engine
            Engine that the body is in.

        Returns
        -------
        Pose
            The frame of the asset.
        """
        return self.pose(engine.placement(self.id), engine.motion(self.id))


def spawn(
    engine: Engine,
    solids: Sequence[RigidSolid],
    pose: Pose,
    surface: ContactProperties,
    colors: Sequence[Color] | None,
    mass_factor: float = 1.0,
) -> list[Body]:
    """Put solids into the simulation, moving with a frame.

    Parameters
    ----------
    engine : Engine
        Engine to put them into.
    solids : sequence of RigidSolid
        The solids, all in one frame.
    pose : Pose
        Where that frame is and how it moves.
    surface : ContactProperties
        How they touch.
    colors : sequence of tuple of float, optional
        Red, green, blue and opacity, taken in turn; None leaves the bodies invisible.
    mass_factor : float
        What their mass and inertia are multiplied by.

    Returns
    -------
    list of Body
        The bodies, in the order of the solids.
    """
    moments, axes = np.linalg.eigh(mass_factor * np.array([solid.inertia for solid in solids]))  # (n, 3), (n, 3, 3)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]  # right-handed
    centers = np.array([solid.center_of_mass for solid in solids])  # (n, 3)
    arms = centers @ pose.rotation.T
    velocities = pose.linear + cross(pose.angular, arms)
    turns = Rotation.from_matrix(axes)
    part_frames = turns.inv().as_quat().tolist()
    orientations = (Rotation.from_matrix(pose.rotation) * turns).as_quat().tolist()
    positions = (pose.position + arms).tolist()
    spin = tuple(pose.angular.tolist())
    bodies = []
    for k, solid in enumerate(solids):
        visual = None
        if colors is not None:
            local = (solid.vertices - centers[k]) @ axes[k]
            visual = engine.shapes.visual(local, solid.faces, colors[k % len(colors)])
        parts = solid.convex_parts
        frame = tuple(((parts.offset - centers[k]) @ axes[k]).tolist()), tuple(part_frames[k])
        motion = tuple(velocities[k].tolist()), spin
        mass = mass_factor * float(solid.mass)
        place = positions[k], orientations[k]
        body = engine.shapes.create_body(parts, frame, mass, moments[k].tolist(), place, motion, surface, visual)
        bodies.append(Body(body, engine.mark(body), mass, centers[k], axes[k], moments[k]))
    return bodies
