"""What somebody may do to a world between and within its steps: callbacks, bodies taken away, made anew and changed."""

from __future__ import annotations

import pybullet as p
import pytest
from scenes import HARD, SlabBox, ball, floor, mechanics, tilted

import fracsim


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def test_contact_callbacks_see_hits_until_they_are_unregistered(client):
    floor(client)
    world = fracsim.World(client)
    body = world.add(SlabBox(toughness=1e9), (0, 0, 0.2), tilted())
    hits = []
    unregister = world.on_contact(hits.append)
    for _ in range(240):
        world.step()
    assert hits
    assert hits[0].body == body
    assert hits[0].point.shape == hits[0].direction.shape == (3,)
    seen = len(hits)
    unregister()
    p.resetBaseVelocity(body, (0, 0, 3), physicsClientId=client)
    for _ in range(240):
        world.step()
    assert len(hits) == seen


def test_a_callback_may_remove_the_body_before_it_breaks(client):
    floor(client)
    world = fracsim.World(client)
    asset = SlabBox()
    world.add(asset, (0, 0, 1), tilted())
    world.on_contact(lambda hit: p.removeBody(hit.body, physicsClientId=client))
    while world.bodies:
        assert world.step() == []
    assert asset.queries == []


def test_a_body_removed_by_the_user_is_forgotten_even_if_its_id_lives_on(client):
    world = fracsim.World(client)
    body = world.add(SlabBox())
    p.removeBody(body, physicsClientId=client)
    assert ball(client, 1, 0.1, (0, 0, 0), (1, 0, 0)) == body
    assert world.step() == []
    assert world.bodies == ()
    with pytest.raises(fracsim.PhysicsError, match="not in this world"):
        world.fracture(body, HARD)


def test_what_takes_the_id_of_a_removed_piece_is_left_alone(client):
    world = fracsim.World(client)
    event = world.fracture(world.add(SlabBox(energy=50.0), angular_velocity=(0, 0, 3)), HARD)
    for child in event.children:
        p.removeBody(child, physicsClientId=client)
    other = ball(client, 1.0, 0.1, (0, 0, 9), (30, 0, 0))
    p.resetBaseVelocity(other, (30, 0, 0), (0, 0, 1000), physicsClientId=client)
    assert other in event.children
    for _ in range(10):
        world.step()
    linear, angular = p.getBaseVelocity(other, physicsClientId=client)
    assert linear == pytest.approx((30, 0, 0))
    assert angular == pytest.approx((0, 0, 1000))
    body = world.add(SlabBox())
    assert body in event.children
    assert world.bodies == (body,)
    assert len(world.fracture(body, HARD).children) == 4


def test_a_callback_may_put_another_body_in_one_s_place(client):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(), (0, 0, 0))
    hammer = ball(client, 1.0, 0.1, (0.5, 0.5, 1.3), (0, 0, -20))
    made = []

    def replace(hit):
        if hit.other == hammer and not made:
            p.removeBody(hammer, physicsClientId=client)
            made.append(ball(client, 1.0, 0.1, (9, 9, 9), (0, 0, 0)))

    world.on_contact(replace)
    assert any(world.step() for _ in range(20))
    assert made == [hammer]
    assert p.getBasePositionAndOrientation(hammer, physicsClientId=client)[0] == (9, 9, 9)
    assert p.getBaseVelocity(hammer, physicsClientId=client)[0] == (0, 0, 0)


def test_a_body_woken_and_removed_takes_nothing_from_the_next_of_its_id(client):
    world = fracsim.World(client)
    body = world.add(SlabBox())
    world.wake(body)
    world.remove(body)
    assert world.add(SlabBox()) == body
    world.step()
    assert world.bodies == (body,)


def test_pieces_weigh_what_the_body_did_when_it_broke(client):
    floor(client)
    p.setGravity(0, 0, 0, physicsClientId=client)
    world = fracsim.World(client)
    asset = SlabBox(toughness=0.1)
    body = world.add(asset, linear_velocity=(0, 0, 3))
    p.changeDynamics(body, -1, mass=3 * asset.mass, physicsClientId=client)
    before = mechanics(client, [body])
    hits = []
    world.on_contact(hits.append)
    ball(client, 1.0, 0.1, (0.5, 0.5, 1.2), (0, 0, -10))
    children = next(event.children for _ in range(20) for event in world.step())
    assert mechanics(client, children)[0] == pytest.approx(before[0])
    assert sum(hit.impulse.magnitude for hit in hits) == pytest.approx(13 / (1 + 1 / (3 * asset.mass)), rel=0.02)


def test_a_body_held_by_having_no_mass_breaks_into_pieces_that_have_some(client):
    world = fracsim.World(client)
    asset = SlabBox()
    body = world.add(asset)
    p.changeDynamics(body, -1, mass=0, physicsClientId=client)
    ball(client, 1.0, 0.1, (0.5, 0.5, 1.2), (0, 0, -10))
    children = next(event.children for _ in range(20) for event in world.step())
    assert mechanics(client, children)[0] == pytest.approx(asset.mass)


def test_remove_takes_bodies_and_pieces_out_of_the_engine(client):
    world = fracsim.World(client)
    keep = world.add(SlabBox(), (5, 0, 0))
    children = world.fracture(world.add(SlabBox()), HARD).children
    for child in children:
        world.remove(child)
    assert world.pieces == ()
    assert world.bodies == (keep,)
    assert p.getNumBodies(physicsClientId=client) == 1


def test_the_parent_id_is_not_handed_to_a_piece(client):
    world = fracsim.World(client)
    event = world.fracture(world.add(SlabBox()), HARD)
    assert event.parent not in event.children


def test_a_weak_impulse_on_command_leaves_the_body_whole(client):
    world = fracsim.World(client)
    body = world.add(SlabBox())
    event = world.fracture(body, fracsim.Impulse((0, 0, 0), (1, 0, 0), 1e-3))
    assert event.children == ()
    assert len(event.fracture.pieces) == 1
    assert world.bodies == (body,)
