"""The world: bodies that break, keep what they carried, and leave everything else alone."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pybullet as p
import pytest
from scenes import HARD, SlabBox, ball, floor, mechanics, sliding_arm, tilted

import fracsim
from fracsim.physics.impacts import ContactImpulse
from fracsim.physics.verdicts import StruckBody


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    if p.getConnectionInfo(client)["isConnected"]:
        p.disconnect(client)


# --- what a break keeps


def test_a_break_on_command_conserves_mass_momentum_angular_momentum_centre_of_mass_and_energy(client):
    world = fracsim.World(client)
    body = world.add(SlabBox(), (1, 2, 3), tilted(), (3, -1, 2), (0.5, 4, -2))
    before = mechanics(client, [body])
    event = world.fracture(body, HARD)
    assert len(event.children) == 4
    for old, new in zip(before, mechanics(client, event.children), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-9, atol=1e-9 * np.abs(old).max())


def test_pieces_appear_where_they_were_in_the_body(client):
    world = fracsim.World(client)
    body = world.add(SlabBox(), (1, 2, 3), tilted())
    pose = world.pose(body)
    np.testing.assert_allclose(pose[0], (1, 2, 3), atol=1e-12)
    for child in world.fracture(body, HARD).children:
        for new, old in zip(world.pose(child), pose, strict=True):
            np.testing.assert_allclose(new, old, atol=1e-12)


def test_pieces_left_alone_stay_where_they_are(client):
    world = fracsim.World(client)
    children = world.fracture(world.add(SlabBox(), orientation=tilted()), HARD).children
    for _ in range(240):
        world.step()
    assert max(np.abs(p.getBaseVelocity(child, physicsClientId=client)).max() for child in children) < 1e-3


def test_the_pieces_of_a_small_object_stay_too(client):
    world = fracsim.World(client)
    children = world.fracture(world.add(SlabBox(), scale=0.1), HARD).children
    for _ in range(240):
        world.step()
    assert max(np.abs(p.getBaseVelocity(child, physicsClientId=client)).max() for child in children) < 1e-3


def test_pieces_inherit_friction_restitution_and_damping(client):
    world = fracsim.World(client)
    body = world.add(SlabBox(), linear_velocity=(1, 0, 0), linear_damping=0.0, angular_damping=0.0)
    p.changeDynamics(body, -1, lateralFriction=0.9, restitution=0.3, rollingFriction=0.01, physicsClientId=client)
    child = world.fracture(body, HARD).children[0]
    info = p.getDynamicsInfo(child, -1, physicsClientId=client)
    assert (info[1], info[5], info[6]) == (0.9, 0.3, 0.01)
    for _ in range(60):
        world.step()
    assert p.getBaseVelocity(child, physicsClientId=client)[0][0] == pytest.approx(1.0, abs=1e-9)


def test_bodies_and_pieces_may_be_faster_than_a_hundred_metres_a_second(client):
    world = fracsim.World(client)
    body = world.add(SlabBox(), linear_velocity=(150, 0, 0), linear_damping=0.0)
    world.step()
    child = world.fracture(body, HARD).children[0]
    world.step()
    assert p.getBaseVelocity(child, physicsClientId=client)[0][0] == pytest.approx(150)


def test_every_convex_part_collides(client):
    world = fracsim.World(client)
    body = world.add(SlabBox())
    assert len(p.getCollisionShapeData(body, -1, physicsClientId=client)) == 2
    low, high = p.getAABB(body, -1, physicsClientId=client)
    np.testing.assert_allclose((*low, *high), (0, 0, 0, 1, 1, 1), atol=3e-3)


def test_scale_scales_the_body(client):
    world = fracsim.World(client)
    body = world.add(SlabBox(), scale=0.5)
    assert p.getDynamicsInfo(body, -1, physicsClientId=client)[0] == pytest.approx(10 / 8)
    assert world.asset(body).size == 0.5


# --- hits


def test_a_hard_landing_breaks_the_body_and_energy_does_not_rise(client):
    floor(client)
    world = fracsim.World(client)
    asset = SlabBox()
    body = world.add(asset, (0, 0, 1), tilted())
    total = []
    events = []
    while not events and world.time < 2:
        total.append(_energy(client, [body]))
        events = world.step()
    [event] = events
    assert event.parent == body
    assert event.impulse.magnitude > asset.toughness
    assert world.bodies == ()
    assert world.pieces == event.children
    assert {"impulse", "fracture", "bodies"} <= event.timings.keys()
    for _ in range(240):
        assert _energy(client, event.children) < total[-1] * 1.002
        world.step()


def _energy(client, bodies):
    mass, _, _, center, kinetic = mechanics(client, bodies)
    return kinetic + 9.81 * mass * center[2]


@pytest.mark.parametrize("rate", [240, 1000])
def test_the_impulse_is_what_stops_the_corner_that_hits(client, rate):
    floor(client)
    p.setTimeStep(1 / rate, physicsClientId=client)
    world = fracsim.World(client)
    asset = SlabBox(toughness=1e9)
    rotation = np.reshape(p.getMatrixFromQuaternion(tilted()), (3, 3))
    lowest = (rotation @ asset.vertices.T)[2].min()
    world.add(asset, (0, 0, 0.5 - lowest), tilted(), (0, 0, -2), linear_damping=0.0)
    hits = []
    world.on_contact(hits.append)
    while not hits:
        world.step()
    hit = hits[0]
    arm = asset.vertices[np.linalg.norm(asset.vertices - hit.impulse.point, axis=1).argmin()] - asset.center_of_mass
    lever = np.cross(rotation @ arm, (0, 0, 1))
    inverse = 1 / asset.mass + lever @ np.linalg.solve(asset.inertia, lever)
    assert hit.impulse.magnitude == pytest.approx(np.sqrt(4 + 2 * 9.81 * 0.5) / inverse, rel=0.02)
    np.testing.assert_allclose(hit.direction, (0, 0, 1), atol=1e-6)


def test_a_ball_breaks_a_free_body_and_the_impact_is_not_lost(client):
    world = fracsim.World(client)
    world.add(SlabBox(), (-0.5, -0.5, -0.5), linear_damping=0.0, angular_damping=0.0)
    shot = ball(client, 2.0, 0.1, (-1, 0.1, 0.05), (10, 0, 0))
    momentum = np.array([20.0, 0, 0])
    events = []
    while not events and world.time < 1:
        events = world.step()
    bodies = [shot, *events[0].children]
    for _ in range(24):
        np.testing.assert_allclose(mechanics(client, bodies)[1], momentum, atol=2e-3 * 20)
        world.step()
    assert p.getBaseVelocity(events[0].children[0], physicsClientId=client)[0][0] > 0.5


def test_a_central_impact_is_predicted_to_a_percent(client):
    world = fracsim.World(client)
    world.add(SlabBox(toughness=1e9, restitution=0.5), (-0.5, -0.5, -0.5))
    shot = ball(client, 2.0, 0.1, (-1, 0, 0), (10, 0, 0))
    p.changeDynamics(shot, -1, restitution=0.5, physicsClientId=client)
    hits = []
    world.on_contact(hits.append)
    for _ in range(24):
        world.step()
    total = sum(hit.impulse.magnitude for hit in hits)
    assert total == pytest.approx(1.25 * 10 / (1 / 2 + 1 / 10), rel=0.01)
    assert hits[0].other == shot
    assert hits[0].moving


def test_two_breakables_that_meet_each_get_a_query(client):
    world = fracsim.World(client)
    left, right = SlabBox(), SlabBox()
    world.add(left, (-1.2, 0, 0), linear_velocity=(5, 0, 0))
    world.add(right, (0.2, 0.1, 0.1), linear_velocity=(-5, 0, 0))
    events = []
    while not events and world.time < 1:
        events = world.step()
    assert len(events) == 2
    assert len(left.queries) == len(right.queries) == 1


def test_all_contacts_of_a_step_are_one_query(client):
    world = fracsim.World(client)
    asset = SlabBox()
    world.add(asset, (-0.5, -0.5, -0.5))
    for side in (-1, 1):
        ball(client, 1.0, 0.1, (side * 0.7, 0.2, 0), (-side * 20, 0, 0))
    events = []
    while not events and world.time < 1:
        events = world.step()
    assert len(asset.queries) == 1
    assert len(asset.queries[0]) == 2


def test_a_hit_below_the_smallest_that_breaks_makes_no_query(client):
    floor(client)
    world = fracsim.World(client)
    asset = SlabBox(toughness=1e3)
    world.add(asset, (0, 0, 0.3), tilted())
    for _ in range(120):
        assert world.step() == []
    assert asset.queries == []


def test_a_resting_body_is_seldom_asked_for_contacts_and_never_for_the_model(client, monkeypatch):
    floor(client)
    world = fracsim.World(client)
    asset = SlabBox(toughness=1e9)
    world.add(asset, (0, 0, 0.01))
    for _ in range(240):
        world.step()
    object.__setattr__(asset, "toughness", 0.0)
    asked = []
    contacts = p.getContactPoints
    monkeypatch.setattr(p, "getContactPoints", lambda *a, **k: asked.append(1) or contacts(*a, **k))
    for _ in range(480):
        assert world.step() == []
    assert asset.queries == []
    assert len(asked) <= 480 // 16  # one body in its turn, lest a load press on it


def test_a_still_body_notices_what_flies_at_it(client):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(), (-0.5, -0.5, 0.002))
    ball(client, 5.0, 0.1, (-3, 0, 0.5), (20, 0, 0))
    events = []
    while not events and world.time < 1:
        events = world.step()
    assert len(events) == 1


def test_a_link_of_a_moving_arm_breaks_what_it_hits(client):
    arm = sliding_arm(client, (-1.0, 0.5, 0.5))
    world = fracsim.World(client)
    world.add(SlabBox())
    hits = []
    world.on_contact(hits.append)
    events = []
    while not events and world.time < 1:
        events = world.step()
    assert events
    assert (hits[0].other, hits[0].other_link) == (arm, 0)
    assert hits[0].closing_speed == pytest.approx(4.0, rel=0.05)


# --- errors


def test_a_client_that_is_not_connected_is_refused(client):
    with pytest.raises(fracsim.PhysicsError, match="connect"):
        fracsim.World(client + 7)
    world = fracsim.World(client)
    world.add(SlabBox())
    p.disconnect(client)
    for call in (world.step, world.wake, lambda: world.bodies, lambda: world.pose(0), lambda: world.add(SlabBox())):
        with pytest.raises(fracsim.PhysicsError, match="not connected"):
            call()


def test_clients_and_assets_are_told_from_what_is_none(client):
    for wrong in (None, "0", 1.0, True):
        with pytest.raises(fracsim.PhysicsError, match="integer that"):
            fracsim.World(wrong)
    with pytest.raises(fracsim.PhysicsError, match=r"fracsim\.load.*'vase' lacks bearable_impulse"):
        fracsim.World(client).add("vase")


def test_substeps_are_refused(client):
    world = fracsim.World(client)
    world.add(SlabBox())
    p.setPhysicsEngineParameter(numSubSteps=4, physicsClientId=client)
    for _ in range(6):
        world.step()
    with pytest.raises(fracsim.PhysicsError, match="numSubSteps"):
        [world.step() for _ in range(2)]
    with pytest.raises(fracsim.PhysicsError, match="numSubSteps"):
        fracsim.World(client)


@pytest.mark.parametrize(
    "bad",
    [
        {"position": (0, 0)},
        {"position": (0, 0, float("nan"))},
        {"orientation": (0, 0, 0, 0)},
        {"linear_velocity": (0, 0, float("inf"))},
        {"scale": 0.0},
        {"scale": float("nan")},
    ],
)
def test_bad_placements_are_refused_and_leave_nothing_behind(client, bad):
    world = fracsim.World(client)
    with pytest.raises(fracsim.PhysicsError):
        world.add(SlabBox(), **bad)
    assert p.getNumBodies(physicsClientId=client) == 0


def test_a_weak_hit_come_again_does_not_hide_a_strong_one_beside_it(client):
    world = fracsim.World(client)
    body = world.add(SlabBox(toughness=5.0))
    record = world._state.activity.records[body]

    def hit(size, x):
        impulse = fracsim.Impulse((x, 0.5, 1.0), (0, 0, -1), size)
        return ContactImpulse(body, 7, -1, impulse.point, impulse.direction, 1.0, impulse, True)

    weak, strong = hit(1.0, 0.1), hit(10.0, 0.9)
    for hits in ([strong, weak], [weak, strong]):
        record.recent_impacts = [(-0.001, weak)]
        assert world._verdicts.judge(StruckBody(record, hits, 0.0)) is not None


# --- what a scene does not need


def test_headless_worlds_show_nothing_and_visual_worlds_do(client):
    def image():
        view = p.computeViewMatrix((3, -3, 3), (0.5, 0.5, 0.5), (0, 0, 1))
        projection = p.computeProjectionMatrixFOV(40, 1, 0.1, 20)
        args = (64, 64, view, projection)
        frame = p.getCameraImage(*args, renderer=p.ER_TINY_RENDERER, physicsClientId=client)
        return np.reshape(frame[4], (64, 64))

    headless = fracsim.World(client)
    assert not headless.visuals
    headless.fracture(headless.add(SlabBox()), HARD)
    assert (image() < 0).all()
    visible = fracsim.World(client, visuals=True)
    visible.fracture(visible.add(SlabBox()), HARD)
    assert (image() >= 0).mean() > 0.1


def test_a_world_touches_no_engine_wide_parameter(client):
    before = p.getPhysicsEngineParameters(physicsClientId=client)
    world = fracsim.World(client)
    world.fracture(world.add(SlabBox()), HARD)
    assert p.getPhysicsEngineParameters(physicsClientId=client) == before


def test_two_clients_do_not_mix(client):
    other = p.connect(p.DIRECT)
    try:
        here, there = fracsim.World(client), fracsim.World(other)
        here.fracture(here.add(SlabBox()), HARD)
        there.add(SlabBox())
        assert p.getNumBodies(physicsClientId=client) == 4
        assert p.getNumBodies(physicsClientId=other) == 1
    finally:
        p.disconnect(other)


def test_a_simulation_loads_nothing_that_only_baking_or_training_needs():
    script = (
        "import sys, pybullet as p, fracsim\n"
        "world = fracsim.World(p.connect(p.DIRECT), fatigue=4.0)\n"
        "asset = fracsim.load('vase')\n"
        "body = world.add(asset, (0, 0, 1), angular_velocity=(0, 0, 1))\n"
        "event = world.fracture(body, max(asset.sample_impulses(50, 0), key=lambda one: one.magnitude))\n"
        "assert len(event.children) > 1\n"
        "for _ in range(20): world.step()\n"
        "heavy = {'torch', 'optuna', 'networkx', 'coacd', 'matplotlib', 'trimesh', 'h5py'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_time_of_the_engine_s_own_step_is_told_when_asked_for(client, monkeypatch):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(toughness=1e9), (0, 0, 1))
    world.step()
    assert world.engine_seconds == 0.0
    world.times_engine = True
    step = p.stepSimulation
    monkeypatch.setattr(p, "stepSimulation", lambda **options: time.sleep(0.02) or step(**options))
    begin = time.perf_counter()
    world.step()
    assert 0.02 <= world.engine_seconds <= time.perf_counter() - begin


def test_a_world_tells_its_options_and_does_not_take_others_in_silence(client):
    world = fracsim.World(client, generations=2, smallest=0.1, budget=5, fatigue=2.0, refine_after=0.25)
    options = (world.generations, world.smallest, world.budget, world.fatigue, world.decomposition, world.refine_after)
    assert options == (2, 0.1, 5, 2.0, "baked", 0.25)
    with pytest.raises(AttributeError):
        world.budget = 7
