"""Calls of PyBullet: whose client it is, shapes after a reset, and answers in the proper form."""

from __future__ import annotations

import copy
import pickle
from types import SimpleNamespace

import numpy as np
import pybullet as p
import pytest
from pybullet_utils.bullet_client import BulletClient
from scenes import HARD, SlabBox, ball

import fracsim
from fracsim.fracture.pieces import ConvexParts
from fracsim.physics.bullet import Engine
from fracsim.physics.client import client_id
from fracsim.physics.states import AT_REST, ContactProperties

CUBOID = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)])
SURFACE = ContactProperties(0.5, 0.0)
PLACE = ((0.0, 0.0, 5.0), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def test_a_client_is_an_integer_or_a_bullet_client_and_nothing_else(client):
    assert client_id(client) == client_id(np.int64(client)) == client
    wrapped = BulletClient(p.DIRECT)
    assert client_id(wrapped) == wrapped._client
    fracsim.World(wrapped)
    assert client_id(SimpleNamespace(_client=client)) == client  # panda-gym and others wrap a client of their own
    for thing in (True, None, "0", 1.0, object(), p):
        with pytest.raises(fracsim.PhysicsError, match=r"the integer that pybullet\.connect returns"):
            client_id(thing)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_neither_an_engine_nor_its_world_is_copied(client, duplicate):
    with pytest.raises(fracsim.PhysicsError, match="cannot be copied or pickled"):
        duplicate(Engine(client))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, pickle.dumps])
def test_a_world_is_not_copied(client, duplicate):
    world = fracsim.World(client)
    world.add(SlabBox())
    with pytest.raises(fracsim.PhysicsError, match="a World cannot be copied or pickled"):
        duplicate(world)


def test_parts_that_are_turned_in_the_body_get_a_shape_of_their_own(client):
    engine, parts = Engine(client), ConvexParts.of([CUBOID])
    boxes = []
    for quaternion in ((0.0, 0.0, 0.0, 1.0), (0.0, 2**-0.5, 0.0, 2**-0.5)):  # the long side along z, then along x
        frame = (0.0, 0.0, 0.0), quaternion
        body = engine.shapes.create_body(parts, frame, 1.0, [1.0] * 3, PLACE, AT_REST, SURFACE, None)
        boxes.append(np.diff(engine.bounding_box(body, -1), axis=0)[0])
    assert boxes[0][2] == pytest.approx(0.6, abs=0.05)
    assert boxes[1][0] == pytest.approx(0.6, abs=0.05)


def test_a_shape_is_not_another_one_of_the_same_id_from_before_a_reset(client):
    engine, parts = Engine(client), ConvexParts.of([CUBOID])
    turned = (0.0, 0.0, 0.0), (0.0, 2**-0.5, 0.0, 2**-0.5)
    engine.shapes.create_body(parts, turned, 1.0, [1.0] * 3, PLACE, AT_REST, SURFACE, None)
    p.resetSimulation(physicsClientId=client)
    straight = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    Engine(client).shapes.create_body(parts, straight, 1.0, [1.0] * 3, PLACE, AT_REST, SURFACE, None)
    body = engine.shapes.create_body(parts, turned, 1.0, [1.0] * 3, PLACE, AT_REST, SURFACE, None)
    assert np.diff(engine.bounding_box(body, -1), axis=0)[0][0] == pytest.approx(0.6, abs=0.05)


def test_bodies_stay_visible_after_a_reset(client):
    def opacity(body):
        return [shape[7][3] for shape in p.getVisualShapeData(body, physicsClientId=client)]

    world = fracsim.World(client, visuals=True)
    asset = SlabBox()
    first = opacity(world.add(asset))
    p.resetSimulation(physicsClientId=client)
    again = world.add(asset)
    assert opacity(again) == first == [1.0]
    p.resetSimulation(physicsClientId=client)
    ball(client, 1.0, 0.1, (9, 0, 0), (0, 0, 0))
    event = world.fracture(world.add(asset), HARD)
    assert [opacity(child) for child in event.children] == [[1.0]] * 4


def test_a_constraint_made_as_it_was_described_is_the_same(client):
    engine = Engine(client)
    a, b = (ball(client, 1.0, 0.1, (k, 0, 0), (0, 0, 0)) for k in range(2))
    made = p.createConstraint(
        a, -1, b, -1, p.JOINT_FIXED, (0, 0, 0), (0.5, 0, 0), (-0.5, 0, 0), (0, 0, 0, 1), physicsClientId=client
    )
    p.changeConstraint(made, maxForce=77.0, physicsClientId=client)
    [(key, info)] = engine.constraints.all()
    assert (key, info.parent, info.child, info.max_force) == (made, a, b, 77.0)
    assert engine.constraints.of(b) == [(key, info)]
    assert engine.constraints.pairs() == [(a, b)]
    assert engine.constraints.joined_to({a}) == [b]
    engine.constraints.remove(key)
    again = engine.constraints.create(info)
    assert engine.constraints.all() == [(again, info)]
