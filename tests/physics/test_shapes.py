"""Shapes in the engine: made once, used again, seen where they should be, and never another's after a reset."""

from __future__ import annotations

import os

import numpy as np
import pybullet as p
import pytest
from scenes import HARD, SlabBox

import fracsim


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def test_shapes_leave_no_files_behind(client, monkeypatch, tmp_path):
    monkeypatch.setattr("fracsim.physics.shapes.MEMORY", str(tmp_path))
    unlink, unlinked = os.unlink, []
    monkeypatch.setattr(os, "unlink", lambda path: unlinked.append(path) or unlink(path))
    world = fracsim.World(client)
    world.fracture(world.add(SlabBox()), HARD)
    assert len(unlinked) == 5
    assert list(tmp_path.iterdir()) == []


def seen(client):
    """Share of an image that bodies cover."""
    view = p.computeViewMatrix((3, -3, 3), (0.5, 0.5, 0.5), (0, 0, 1))
    projection = p.computeProjectionMatrixFOV(40, 1, 0.1, 20)
    frame = p.getCameraImage(64, 64, view, projection, renderer=p.ER_TINY_RENDERER, physicsClientId=client)
    return (np.reshape(frame[4], (64, 64)) >= 0).mean()


def test_a_world_that_outlives_a_reset_uses_none_of_its_shapes(client):
    world = fracsim.World(client)
    asset = SlabBox()
    world.add(asset)
    p.resetSimulation(physicsClientId=client)
    p.createCollisionShape(p.GEOM_SPHERE, radius=0.3, physicsClientId=client)
    p.createCollisionShape(p.GEOM_SPHERE, radius=0.4, physicsClientId=client)
    body = world.add(asset)
    shapes = p.getCollisionShapeData(body, -1, physicsClientId=client)
    assert [shape[2] for shape in shapes] == [p.GEOM_MESH] * 2
    assert len(world.fracture(body, HARD).children) == 4


@pytest.mark.parametrize("is_same_asset", [True, False])
@pytest.mark.parametrize("visuals", [True, False])
def test_a_world_that_outlives_a_reset_shows_its_bodies_as_before(client, visuals, is_same_asset):
    world = fracsim.World(client, visuals=visuals)
    asset = SlabBox()
    world.add(asset)
    before = seen(client)
    assert (before > 0.1) == visuals
    p.resetSimulation(physicsClientId=client)
    for _ in range(3):  # which take the ids that the world's shapes had
        p.createVisualShape(p.GEOM_SPHERE, radius=2.0, physicsClientId=client)
    body = world.add(asset if is_same_asset else SlabBox())
    assert seen(client) == before
    world.fracture(body, HARD)
    assert seen(client) == pytest.approx(before, abs=0.01)
