"""What tests of the world share: a box that breaks into slabs, a floor, a ball, and the momentum of what there is."""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pybullet as p

import fracsim
from fracsim.fracture.pieces import ConvexParts

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)

QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]

CUBE_FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def block(low, high, density, parts):
    """A box, its convex parts 0.75 mm (of a 1 m object) inside it."""
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    extent = high - low
    mass = density * extent.prod()
    inertia = mass / 12 * np.diag((extent**2).sum() - extent**2)
    edges = np.linspace(low[1], high[1], parts + 1)
    gap = 0.75e-3 * extent[2]
    hulls = [
        CUBE * (np.array([high[0], b, high[2]]) - [low[0], a, low[2]] - 2 * gap) + [low[0], a, low[2]] + gap
        for a, b in itertools.pairwise(edges)
    ]
    return SimpleNamespace(
        vertices=CUBE * extent + low,
        faces=CUBE_FACES,
        mass=mass,
        center_of_mass=(low + high) / 2,
        inertia=inertia,
        convex_parts=ConvexParts.of(hulls),
        atoms=np.arange(1),
    )


class SlabMaterial(NamedTuple):
    """What contacts and cracks need to know of a material."""

    name: str = "ceramic"
    friction: float = 0.5
    restitution: float = 0.0
    fracture_energy: float = 0.0  # J/m²


@dataclasses.dataclass(frozen=True, eq=False)
class SlabBox:
    """A box with its frame at a corner, as a user's own breakable object.

    It breaks into slabs across x when hit with `toughness` N·s.
    """

    size: float = 1.0
    slabs: int = 4
    toughness: float = 1.0
    density: float = 10.0
    restitution: float = 0.0
    energy: float = 0.0  # J/m²
    queries: list = dataclasses.field(default_factory=list)

    name = "slab box"
    volume_fraction = 1.0

    def __post_init__(self):
        whole = block((0, 0, 0), [self.size] * 3, self.density, 2)
        for field in ("vertices", "faces", "mass", "center_of_mass", "inertia", "convex_parts"):
            object.__setattr__(self, field, getattr(whole, field))

    @property
    def material(self):
        return SlabMaterial(restitution=self.restitution, fracture_energy=self.energy)

    @property
    def reach(self):
        return self.size * 3**0.5 / 2

    @property
    def bearable_impulse(self):
        return self.toughness

    def prepare(self):
        pass

    @property
    def breaking_impulse(self):
        return np.full(len(self.vertices), self.toughness)

    def scaled(self, scale):
        return dataclasses.replace(self, size=self.size * scale, toughness=self.toughness * scale**3)

    def with_material(self, material):
        return self

    def may_break(self, impulses):
        return max(impulse.magnitude for impulse in impulses) >= self.toughness

    def fracture(self, impulses, predictor="field"):
        self.queries.append(impulses)
        edges = np.linspace(0, self.size, self.slabs + 1 if self.may_break(impulses) else 2)
        pieces = tuple(
            block((a, 0, 0), (b, self.size, self.size), self.density, 2) for a, b in itertools.pairwise(edges)
        )
        area = (len(pieces) - 1) * self.size**2
        return SimpleNamespace(pieces=pieces, labels=None, udf=None, timings={"field": 0.0}, crack_area=area)

    def breakable_piece(self, piece):
        raise NotImplementedError("its pieces are of one atom each, which breaks no more")

    def unbroken(self):
        return SimpleNamespace(pieces=(block((0, 0, 0), [self.size] * 3, self.density, 2),), timings={}, crack_area=0.0)


HARD = fracsim.Impulse((0.5, 0.5, 1.0), (0, 0, -1), 100.0)


def floor(client, restitution=0.0):
    shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
    body = p.createMultiBody(0, shape, physicsClientId=client)
    p.changeDynamics(body, -1, restitution=restitution, physicsClientId=client)
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    return body


def ball(client, mass, radius, position, velocity):
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=client)
    body = p.createMultiBody(mass, shape, -1, position, physicsClientId=client)
    p.changeDynamics(body, -1, linearDamping=0, angularDamping=0, maxJointVelocity=1e5, physicsClientId=client)
    p.resetBaseVelocity(body, velocity, physicsClientId=client)
    return body


def mechanics(client, bodies):
    """Mass, momentum, angular momentum about the origin, centre of mass, kinetic energy; as in the engine."""
    mass, momentum, spin, first, energy = 0.0, np.zeros(3), np.zeros(3), np.zeros(3), 0.0
    for body in bodies:
        info = p.getDynamicsInfo(body, -1, physicsClientId=client)
        position, orientation = p.getBasePositionAndOrientation(body, physicsClientId=client)
        linear, angular = map(np.array, p.getBaseVelocity(body, physicsClientId=client))
        rotation = np.reshape(p.getMatrixFromQuaternion(orientation), (3, 3))
        inertia = rotation @ np.diag(info[2]) @ rotation.T
        mass += info[0]
        momentum += info[0] * linear
        spin += np.cross(position, info[0] * linear) + inertia @ angular
        first += info[0] * np.array(position)
        energy += 0.5 * info[0] * linear @ linear + 0.5 * angular @ inertia @ angular
    return mass, momentum, spin, first / mass, energy


def tilted():
    return p.getQuaternionFromEuler((0.4, -0.7, 1.1))


def sliding_arm(client, position):
    """A post of 3 kg on a slide along x, whose motor drives it at 4 m/s."""
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.05, 0.05, 0.5), physicsClientId=client)
    arm = p.createMultiBody(
        0,
        basePosition=position,
        linkMasses=[3.0],
        linkCollisionShapeIndices=[shape],
        linkVisualShapeIndices=[-1],
        linkPositions=[(0, 0, 0)],
        linkOrientations=[(0, 0, 0, 1)],
        linkInertialFramePositions=[(0, 0, 0)],
        linkInertialFrameOrientations=[(0, 0, 0, 1)],
        linkParentIndices=[0],
        linkJointTypes=[p.JOINT_PRISMATIC],
        linkJointAxis=[(1, 0, 0)],
        physicsClientId=client,
    )
    p.resetJointState(arm, 0, 0.0, 4.0, physicsClientId=client)
    p.setJointMotorControl2(arm, 0, p.VELOCITY_CONTROL, targetVelocity=4.0, force=1e4, physicsClientId=client)
    return arm
