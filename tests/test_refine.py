"""Convex parts made live or in the background: finer, in place, and the same in every run."""

from __future__ import annotations

import numpy as np
import pybullet as p
import pytest

import fracsim


def run(asset, decomposition, steps=60):
    """Break at once, step on -> (events, states of the children, parts of each) in the end."""
    client = p.connect(p.DIRECT)
    world = fracsim.World(client, decomposition=decomposition, refine_after=0.1)
    body = world.add(asset, linear_velocity=(1, 0, 0), linear_damping=0.0)
    impulse = next(one for one in asset.sample_impulses(100, 5) if 2 <= len(asset.fracture(one).pieces) <= 4)
    event = world.fracture(body, impulse)
    for _ in range(steps):
        world.step()
    assert set(world.pieces) == set(event.children)
    states = [
        (*p.getBasePositionAndOrientation(child, client), *p.getBaseVelocity(child, client)) for child in event.children
    ]
    parts = [len(p.getCollisionShapeData(child, -1, physicsClientId=client)) for child in event.children]
    masses = [p.getDynamicsInfo(child, -1, physicsClientId=client)[0] for child in event.children]
    p.disconnect(client)
    return event, np.array([np.concatenate(state) for state in states]), parts, masses


def test_parts_made_in_the_background_take_their_place_in_flight(slab):
    event, baked, _, _ = run(slab, "baked")
    _, refined, parts, masses = run(slab, "background")
    np.testing.assert_allclose(refined, baked, atol=2e-3)  # it flies on as it did
    np.testing.assert_allclose(masses, [piece.mass for piece in event.fracture.pieces], rtol=1e-12)
    _, live, live_parts, _ = run(slab, "coacd")
    assert parts == live_parts
    np.testing.assert_allclose(live, baked, atol=2e-3)
    _, again, _, _ = run(slab, "background")
    np.testing.assert_array_equal(refined, again)


def test_an_unknown_decomposition_is_refused():
    client = p.connect(p.DIRECT)
    with pytest.raises(fracsim.PhysicsError, match="unknown decomposition"):
        fracsim.World(client, decomposition="magic")
    p.disconnect(client)
