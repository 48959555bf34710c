"""What several benchmarks use: a mesh of ``meshes`` at its real size, and a world with a floor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet
import trimesh
from pybullet_utils.bullet_client import BulletClient

import fracsim

MESHES = Path(__file__).parent.parent / "meshes"
TIME_STEP = 1 / 240  # s


def thing(name: str, size: float) -> trimesh.Trimesh:
    """Read a mesh, its largest extent made ``size`` m."""
    mesh = trimesh.load_mesh(MESHES / f"{name}.obj", process=False)
    mesh.apply_scale(size / float(np.ptp(mesh.vertices, axis=0).max()))
    return mesh


def world_on(floor: str) -> tuple[BulletClient, fracsim.World]:
    """Make a world, without a screen, whose floor is at z = 0 and of a material."""
    client = BulletClient(pybullet.DIRECT)
    client.setGravity(0, 0, -9.81)
    client.setTimeStep(TIME_STEP)
    box = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(2, 2, 0.5))
    ground = client.createMultiBody(0, box, -1, (0, 0, -0.5))
    world = fracsim.World(client)
    world.set_material(ground, floor)
    return client, world
