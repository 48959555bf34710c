"""The shipped assets in the engine: they break, keep what they carried, and do not fly apart on their own."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pybullet as p
import pytest

import fracsim


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def broken(shipped, world, body, at_least=2):
    """The event of the first sampled impulse that leaves at least that many pieces."""
    for impulse in shipped.sample_impulses(100, 11):
        if len(shipped.fracture(impulse).pieces) >= at_least:
            return world.fracture(body, impulse)
    raise AssertionError("no sampled impulse broke it")


def carried(client, ids):
    """Mass, momentum, and angular momentum about the origin, from what the engine says of the bodies."""
    mass, momentum, angular = 0.0, np.zeros(3), np.zeros(3)
    for body in ids:
        info = p.getDynamicsInfo(body, -1, physicsClientId=client)
        position, orientation = p.getBasePositionAndOrientation(body, physicsClientId=client)
        linear, spin = map(np.array, p.getBaseVelocity(body, physicsClientId=client))
        axes = np.reshape(p.getMatrixFromQuaternion(orientation), (3, 3))
        mass += info[0]
        momentum += info[0] * linear
        angular += info[0] * np.cross(position, linear) + axes @ (np.array(info[2]) * (axes.T @ spin))
    return mass, momentum, angular


def test_a_break_conserves_mass_momentum_and_angular_momentum(shipped, client):
    world = fracsim.World(client)
    body = world.add(
        shipped,
        (1.0, 2.0, 3.0),
        (0.1, 0.7, -0.2, 0.3),
        linear_velocity=(1, -2, 3),
        angular_velocity=(2, 1, -4),
        scale=0.3,
    )
    before = carried(client, [body])
    event = broken(world.asset(body), world, body, at_least=4)
    after = carried(client, event.children)
    for mine, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other, mine, rtol=1e-9, atol=1e-9 * np.abs(mine).max())


@pytest.mark.parametrize("at_least", [2, 6])
def test_a_body_broken_at_rest_stays_where_it_is(shipped, client, at_least):
    world = fracsim.World(client)
    event = broken(shipped, world, world.add(shipped), at_least)
    for _ in range(240):
        p.stepSimulation(physicsClientId=client)
    speeds = [np.linalg.norm(p.getBaseVelocity(body, physicsClientId=client)[0]) for body in event.children]
    assert max(speeds) <= 1e-3


def test_pieces_replace_the_parent_and_their_masses_sum_to_its(shipped, client):
    world = fracsim.World(client)
    body = world.add(shipped)
    event = broken(shipped, world, body)
    assert body not in world.bodies
    assert set(event.children) == set(world.pieces)
    assert p.getNumBodies(physicsClientId=client) == len(event.children) == len(event.fracture.pieces)
    assert sum(piece.mass for piece in event.fracture.pieces) == pytest.approx(shipped.mass, rel=1e-12)


@pytest.mark.parametrize("mesh", ["bunny", "chair", "vase"])
def test_a_drop_from_three_metres_breaks_it(mesh):
    env = gym.make("fracsim:FractureDrop-v0", mesh=mesh, goal="shatter", drop_height=3.0)
    env.reset(seed=0)
    done, pieces, events = False, 1, []
    while not done:
        _, _, terminated, truncated, info = env.step(np.zeros(6, np.float32))
        pieces, done = max(pieces, info["pieces"]), terminated or truncated
        events += info["events"]
    assert len(events[0].children) >= 2
    assert pieces == 1 + sum(len(event.children) - 1 for event in events)  # pieces may have broken again
    env.close()


@pytest.mark.parametrize("mesh", ["bunny", "chair", "vase"])
def test_standing_on_the_floor_breaks_nothing(mesh, client):
    asset = fracsim.load(mesh).scaled(0.3)
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    shape = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
    p.createMultiBody(0, shape, physicsClientId=client)
    world = fracsim.World(client)
    body = world.add(asset, (0, 0, 1e-3 - asset.vertices[:, 2].min()))
    assert [event for _ in range(480) for event in world.step()] == []
    assert world.bodies == (body,)


def test_two_processes_with_one_seed_agree_to_the_last_bit():
    script = (
        "import gymnasium as gym, numpy as np, hashlib\n"
        "e = gym.make('fracsim:FractureDrop-v0', mesh='vase', drop_height=3.0)\n"
        "o, _ = e.reset(seed=5); h = hashlib.sha256(o.tobytes()); e.action_space.seed(5); done = False\n"
        "while not done:\n"
        "    o, r, t, u, i = e.step(e.action_space.sample()); h.update(o.tobytes()); done = t or u\n"
        "print(i['pieces'], h.hexdigest())\n"
    )
    runs = [
        subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True) for _ in range(2)
    ]
    last = [run.stdout.splitlines()[-1] for run in runs]
    assert last[0] == last[1]
    assert int(last[0].split()[0]) >= 2
