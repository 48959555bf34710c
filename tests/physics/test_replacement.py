"""Replacement in a step: the impact is counted once, whoever takes part in it, and energy is only ever lost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pybullet as p
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes import HARD, SlabBox, ball, floor, mechanics, sliding_arm
from scipy.spatial.transform import Rotation

import fracsim
from fracsim.physics.bodies import Body
from fracsim.physics.bullet import Engine
from fracsim.physics.energy import PenetrationGuard, RigidStates, dissipate
from fracsim.physics.replacement import contact_island
from fracsim.physics.rotations import integrate_rotation
from fracsim.physics.spin import SETTINGS, GyroscopicCorrection


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def free(world, asset, position=(0.0, 0.0, 0.0), orientation=(0, 0, 0, 1), **motion):
    return world.add(asset, position, orientation, linear_damping=0.0, angular_damping=0.0, **motion)


def until_broken(world, seconds=1.0):
    while world.time < seconds:
        events = world.step()
        if events:
            return events
    raise AssertionError("nothing broke")


# --- the impact, relived


@pytest.mark.parametrize(("rate", "speed"), [(120, 10.0), (240, 10.0), (240, 40.0), (1000, 100.0)])
def test_pieces_and_projectile_keep_their_momentum_and_gain_no_energy(client, shipped, rate, speed):
    p.setTimeStep(1 / rate, physicsClientId=client)
    world = fracsim.World(client)
    asset = shipped.scaled(0.3)
    asset = asset.with_material(dataclasses.replace(asset.material, tensile_strength=4.5e6 * speed / 10))
    body = free(world, asset)
    shot = ball(client, 1.0, 0.06, asset.center_of_mass - (0.3 + 0.5 * speed / rate, 0, 0), (speed, 0, 0))
    _, momentum, _, _, energy = mechanics(client, [body, shot])
    events = until_broken(world)
    for _ in range(30):
        bodies = [*world.bodies, *world.pieces, shot]
        _, now, _, _, left = mechanics(client, bodies)
        np.testing.assert_allclose(now, momentum, atol=1e-6 * speed)
        assert left <= energy * (1 + 1e-9)
        world.step()
    assert events[0].children


def test_the_state_right_after_a_break_is_the_one_before_the_impact(client):
    world = fracsim.World(client)
    body = free(world, SlabBox(), (-0.5, -0.5, -0.5), linear_velocity=(0.5, 0.0, 0.1), angular_velocity=(0.1, 0.2, 0.3))
    shot = ball(client, 2.0, 0.1, (-1, 0.1, 0.05), (10, 0, 0))
    while True:
        before = [mechanics(client, [body]), mechanics(client, [shot])]
        events = world.step()
        if events:
            break
    for old, new in zip(before, [mechanics(client, events[0].children), mechanics(client, [shot])], strict=True):
        for a, b in zip(old, new, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9)


def test_the_piece_that_is_hit_takes_the_impact(client):
    world = fracsim.World(client)
    free(world, SlabBox(), (-0.5, -0.5, -0.5))
    ball(client, 2.0, 0.1, (-1, 0.1, 0.05), (10, 0, 0))
    [event] = until_broken(world)
    world.step()
    speeds = [p.getBaseVelocity(child, physicsClientId=client)[0][0] for child in event.children]
    assert speeds[0] > 1.0
    assert max(map(abs, speeds[1:])) < 0.2 * speeds[0]


def test_bystanders_are_not_stepped_twice(client):
    world = fracsim.World(client)
    free(world, SlabBox(), (-0.5, -0.5, -0.5))
    ball(client, 2.0, 0.1, (-1, 0.1, 0.05), (10, 0, 0))
    far = ball(client, 1.0, 0.1, (0, 5, 0), (0, 3, 0))
    until_broken(world)
    for _ in range(5):
        world.step()
    place = p.getBasePositionAndOrientation(far, physicsClientId=client)[0]
    assert place[1] == pytest.approx(5 + 3 * world.time, abs=1e-9)


def test_an_arm_goes_back_with_its_joints_and_moves_on(client):
    arm = sliding_arm(client, (-0.4, 0.5, 0.5))
    world = fracsim.World(client)
    world.add(SlabBox())
    while True:
        before = p.getJointState(arm, 0, physicsClientId=client)[:2]
        if world.step():
            break
    np.testing.assert_allclose(p.getJointState(arm, 0, physicsClientId=client)[:2], before, atol=1e-9)
    world.step()
    assert p.getJointState(arm, 0, physicsClientId=client)[0] > before[0] + 1e-3


def test_a_body_that_its_user_sped_up_between_two_steps_is_not_taken_back_to_what_it_was(client):
    floor(client)
    world = fracsim.World(client)
    body = free(world, SlabBox(), (0, 0, 0.002))
    for _ in range(60):
        world.step()
    p.resetBaseVelocity(body, (0, 0, -6), physicsClientId=client)
    world.wake(body)
    [event] = until_broken(world, world.time + 0.1)
    speeds = [p.getBaseVelocity(child, physicsClientId=client)[0][2] for child in event.children]
    np.testing.assert_allclose(speeds, -6, atol=0.1)


def test_a_constraint_goes_over_to_the_piece_that_it_holds(client):
    world = fracsim.World(client)
    body = free(world, SlabBox())
    center = p.getBasePositionAndOrientation(body, physicsClientId=client)[0]
    hold = p.createConstraint(
        body, -1, -1, -1, p.JOINT_POINT2POINT, (0, 0, 0), (-0.45, 0, 0), (0.05, 0.5, 0.5), physicsClientId=client
    )
    assert center == pytest.approx((0.5, 0.5, 0.5))
    assert world.constraint(hold) == hold
    event = world.fracture(body, HARD)
    assert p.getNumConstraints(physicsClientId=client) == 1
    assert event.constraints == {hold: p.getConstraintUniqueId(0, physicsClientId=client)}
    assert world.constraint(hold) == event.constraints[hold]
    held = p.getConstraintInfo(world.constraint(hold), physicsClientId=client)[0]
    assert held == event.children[0]
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    for _ in range(120):
        world.step()
    heights = [p.getBasePositionAndOrientation(child, physicsClientId=client)[0][2] for child in event.children]
    assert heights[0] > -0.2
    assert max(heights[1:]) < -0.5


def test_an_island_is_what_contacts_and_constraints_join_and_ends_at_what_is_static():
    assert contact_island([(1, 2), (2, 0), (0, 5), (3, 4), (2, 3)], [1], lambda body: body == 0) == [1, 2, 3, 4]


# --- what cracks take


def test_cracks_take_what_they_demand_and_report_it(client):
    world = fracsim.World(client)
    free(world, SlabBox(energy=2.0), (-0.5, -0.5, -0.5))
    shot = ball(client, 2.0, 0.1, (-1, 0.1, 0.05), (10, 0, 0))
    [event] = until_broken(world)
    assert event.energy.demand == pytest.approx(2.0 * 3)
    assert event.energy.taken == 0.0
    twin = mechanics(client, [shot, *event.children])
    for _ in range(3):
        world.step()
    assert event.energy.taken == pytest.approx(event.energy.demand)
    after = mechanics(client, [shot, *event.children])
    np.testing.assert_allclose(after[1], twin[1], atol=1e-9)
    assert after[4] <= twin[4] - event.energy.taken + 1e-9


def test_cracks_never_take_more_than_there_is(client):
    world = fracsim.World(client)
    free(world, SlabBox(energy=1e6), (-0.5, -0.5, -0.5), linear_velocity=(1, 2, 3), angular_velocity=(0, 1, 0))
    ball(client, 2.0, 0.1, (-1.5, 0.1, 0.05), (20, 0, 0))
    [event] = until_broken(world)
    for _ in range(10):
        world.step()
    assert 0.0 < event.energy.taken < event.energy.demand


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), demand=st.floats(0, 50))
def test_taking_energy_keeps_momentum_and_angular_momentum(client, seed, demand):
    rng = np.random.default_rng(seed)
    engine, bodies = Engine(client), []
    p.resetSimulation(physicsClientId=client)
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.1, 0.2, 0.3), physicsClientId=client)
    for _ in range(4):
        way = rng.normal(size=4)
        one = p.createMultiBody(
            rng.uniform(0.1, 3), shape, -1, rng.normal(size=3).tolist(), way / np.linalg.norm(way),
            physicsClientId=client,
        )  # fmt: skip
        p.resetBaseVelocity(one, rng.normal(size=3), 3 * rng.normal(size=3), physicsClientId=client)
        info = p.getDynamicsInfo(one, -1, physicsClientId=client)
        bodies.append(Body(one, "", info[0], np.zeros(3), np.eye(3), np.array(info[2])))
    ids = [body.id for body in bodies]
    before = mechanics(client, ids)
    taken, _ = dissipate(engine, bodies, demand)
    after = mechanics(client, ids)
    assert 0.0 <= taken <= demand
    np.testing.assert_allclose(after[1], before[1], atol=1e-9)
    np.testing.assert_allclose(after[2], before[2], atol=1e-9)
    assert after[4] == pytest.approx(before[4] - taken, abs=1e-9)


# --- pieces that stand in one another


@pytest.mark.parametrize("gravity", [0.0, -9.81])
def test_what_the_engine_makes_of_depth_is_taken_from_the_bodies_again(client, gravity):
    p.setGravity(0, 0, gravity, physicsClientId=client)
    p.setTimeStep(1 / 1000, physicsClientId=client)
    engine = Engine(client)
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.5, 0.5, 0.5), physicsClientId=client)
    bodies = []
    for x in (0.0, 0.97):  # 3 cm deep, and nearing one another slowly
        one = p.createMultiBody(1.0, shape, -1, (x, 0, 0), physicsClientId=client)
        p.changeDynamics(one, -1, linearDamping=0, angularDamping=0, physicsClientId=client)
        p.resetBaseVelocity(one, (0.05 - 0.1 * (x > 0), 0, 0), (0, 0, 0), physicsClientId=client)
        bodies.append(Body(one, "", 1.0, np.zeros(3), np.eye(3), np.full(3, 1 / 6)))
    down = (0.0, 0.0, gravity)
    guard = PenetrationGuard(bodies, RigidStates.now(engine, bodies).energy(down), 1.0)
    start, ids = guard.energy, [body.id for body in bodies]
    momentum, most = mechanics(client, ids)[1], 0.0
    for _ in range(100):
        p.stepSimulation(physicsClientId=client)
        guard.take_gain(engine, down)
        most = max(most, RigidStates.now(engine, bodies).energy(down) - start)
    assert most < 1e-6
    np.testing.assert_allclose(mechanics(client, ids)[1][:2], momentum[:2], atol=1e-12)


def test_energy_that_comes_from_outside_is_left_to_the_pieces(client):
    engine = Engine(client)
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.5, 0.5, 0.5), physicsClientId=client)
    one = p.createMultiBody(1.0, shape, -1, (0, 0, 0), physicsClientId=client)
    hammer = ball(client, 1.0, 0.1, (0, 0, 0.602), (0, 0, -5))
    body = Body(one, "", 1.0, np.zeros(3), np.eye(3), np.full(3, 1 / 6))
    guard = PenetrationGuard([body], 0.0, 1.0)
    p.stepSimulation(physicsClientId=client)
    assert guard.take_gain(engine, (0.0, 0.0, 0.0)) is None
    assert p.getBaseVelocity(one, physicsClientId=client)[0][2] < -1.0
    assert p.getBaseVelocity(hammer, physicsClientId=client)[0][2] > -5.0


# --- fast pieces


@pytest.mark.parametrize("rate", [240, 1000])
@pytest.mark.parametrize("speed", [10.0, 60.0, 200.0, 5000.0])
def test_a_piece_that_spins_keeps_its_angular_momentum_and_gains_no_energy(client, rate, speed):
    p.setTimeStep(1 / rate, physicsClientId=client)
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.02, 0.03, 0.01), physicsClientId=client)
    piece = p.createMultiBody(0.1, shape, -1, physicsClientId=client)
    p.changeDynamics(piece, -1, linearDamping=0, angularDamping=0, maxJointVelocity=1e5, physicsClientId=client)
    moments = np.array([1e-4, 2e-4, 2.5e-4])
    p.changeDynamics(piece, -1, localInertiaDiagonal=moments.tolist(), physicsClientId=client)
    spin = speed * np.array([0.3, 1.0, 0.2])
    p.resetBaseVelocity(piece, (1, 0, 0), spin.tolist(), physicsClientId=client)
    engine = Engine(client)
    correction = GyroscopicCorrection(engine)
    correction.add([Body(piece, engine.mark(piece), 0.1, np.zeros(3), np.eye(3), moments)], tuple(spin))
    correction.correct(1 / rate)  # in the step in which it comes to be
    *_, angular, _, energy = mechanics(client, [piece])
    for _ in range(rate):
        p.stepSimulation(physicsClientId=client)
        correction.correct(1 / rate)
        *_, now, _, left = mechanics(client, [piece])
        assert left <= energy * (1 + 2e-3)
        if speed < SETTINGS.largest_turn * rate:
            assert np.linalg.norm(now - angular) < (2e-3 if speed < 0.5 * rate else 2e-2) * np.linalg.norm(angular)
    linear, _ = p.getBaseVelocity(piece, physicsClientId=client)
    np.testing.assert_allclose(linear, (1, 0, 0), atol=1e-12)


@pytest.mark.parametrize(
    ("speed", "spin", "is_still"),
    [(0.008, 0.08, True), (0.011, 0.0, False), (0.0, 0.11, False), (0.0, 0.08, True)],
)
def test_a_piece_lies_still_below_a_limit_of_speed_and_one_of_spin(client, speed, spin, is_still):
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.02, 0.03, 0.01), physicsClientId=client)
    piece = p.createMultiBody(0.1, shape, -1, physicsClientId=client)
    p.resetBaseVelocity(piece, (speed, 0, 0), (0, 0, spin), physicsClientId=client)
    engine = Engine(client)
    correction = GyroscopicCorrection(engine)
    correction.add([Body(piece, engine.mark(piece), 0.1, np.zeros(3), np.eye(3), np.ones(3))], (0.0, 0.0, spin))
    for _ in range(3):
        correction.correct(1 / 240)
    assert correction.moving == (set() if is_still else {piece})


@given(st.lists(st.floats(-50, 50), min_size=3, max_size=3), st.floats(-1, 1), st.integers(0, 2**32 - 1))
def test_turning_a_quaternion_is_what_scipy_says(angular, time, seed):
    start = Rotation.random(rng=seed)
    expected = Rotation.from_rotvec(time * np.array(angular)) * start
    found = Rotation.from_quat(integrate_rotation(start.as_quat().tolist(), tuple(angular), time))
    assert (expected.inv() * found).magnitude() < 1e-7
