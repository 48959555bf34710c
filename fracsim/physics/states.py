"""TODO physics.states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pybullet as p

from ..common.arrays import FloatArray, IntArray

Triple = tuple[float, float, float]
Placement = tuple[Triple, tuple[float, float, float, float]]
Motion = tuple[Triple, Triple]  # linear velocity of the centre of mass, angular velocity; world frame

BodyNotFound = p.error  # what a call about a body that is not there raises


@dataclass(frozen=True)
class ContactProperties:
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
class RigidBody:
    """A rigid body, or one link of an articulated one, as a contact sees it. A static body has mass 0."""

    mass: float
    moments: FloatArray  # (3,) principal moments of inertia
    center: FloatArray  # (3,) centre of mass, world
    rotation: FloatArray  # (3, 3) principal axes as columns, world
    restitution: float
    friction: float
    jointed: bool


class BodyContacts:
    """The n contacts of one body in the last step, as they were in the pose before it.

    others: (body, link) of what it touches, -1 being its base. pushing: of what pushes on it. force: N, the sum of
    their normal forces.
    """

    def __init__(self, points: Sequence[tuple[Any, ...]]) -> None:
        self._points = points
        self.others = tuple((q[2], q[4]) for q in points)
        self.pushing = {(q[2], q[4]) for q in points if q[9] > 0.0}
        self.force: float = sum(q[9] for q in points)

    def select(self, chosen: Sequence[int]) -> BodyContacts:
        """Only those."""
        return BodyContacts([self._points[k] for k in chosen])

    # As arrays only once something was hit.

    @cached_property
    def points(self) -> FloatArray:
        """(n, 3) on the body, world."""
        return np.array([q[5] for q in self._points])

    @cached_property
    def normals(self) -> FloatArray:
        """(n, 3) unit, the way the body is pushed."""
        return np.array([q[7] for q in self._points])

    @cached_property
    def depths(self) -> FloatArray:
        """(n,) m, how far the two were in each other."""
        return np.array([-q[8] for q in self._points])

    @cached_property
    def forces(self) -> FloatArray:
        """(n,) N, normal."""
        return np.array([q[9] for q in self._points])


class ContactForces(NamedTuple):
    """Contacts between any bodies."""

    bodies: IntArray  # (n, 2)
    forces: FloatArray  # (n, 3) N on the first, with friction
    on_first: FloatArray  # (n, 3) m, world
    on_second: FloatArray  # (n, 3)
    depths: FloatArray  # (n,) m, how far the two are in each other


@dataclass(frozen=True)
class BodyState:
    """Where a body is and how it moves: what it takes to put it back there."""

    body: int
    placement: Placement
    motion: Motion
    joints: tuple[int, ...] = ()
    angles: tuple[tuple[float, ...], ...] = ()
    rates: tuple[tuple[float, ...], ...] = ()
