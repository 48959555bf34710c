"""What a world asks of the engine: as little as a scene needs, and enough to miss nothing."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pybullet as p
import pytest
from scenes import HARD, SlabBox, ball, floor, tilted

import fracsim
from fracsim.bench.idle import counted
from fracsim.common.contact import LOAD_DURATION


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def calls_a_step(world, steps=160):
    """Engine calls a step beyond stepSimulation, those of things seldom asked for apart."""
    with counted() as calls:
        for _ in range(steps):
            assert world.step() == []
    assert calls.pop("stepSimulation") == steps
    return {name: count / steps for name, count in calls.items()}


def sturdy(**options):
    return SlabBox(toughness=1e9, **options)


# --- counts


def test_a_body_that_touches_and_moves_costs_two_calls_a_step(client):
    body = floor(client)
    p.changeDynamics(body, -1, lateralFriction=0.0, physicsClientId=client)
    world = fracsim.World(client)
    for k in range(4):
        world.add(sturdy(), (2 * k, 0, 0), linear_velocity=(0, 1, 0), linear_damping=0.0)
    for _ in range(120):
        world.step()
    calls = calls_a_step(world)
    assert calls["getBaseVelocity"] == 4.0
    assert calls["getContactPoints"] <= 1 / 16  # of all of them together
    each = "getBaseVelocity", "getBasePositionAndOrientation", "getOverlappingObjects", "getContactPoints"
    assert sum(calls.pop(name, 0) for name in each) <= 1.5 * 4
    assert sum(calls.values()) <= 3.6  # what all share


def test_something_that_moves_nearby_costs_one_more(client):
    floor(client)
    world = fracsim.World(client)
    for k in range(4):
        world.add(sturdy(), (2 * k, 0, 0.003))
    near = ball(client, 1.0, 0.1, (0.5, 0.5, 1.2), (0, 0, 0))
    p.changeDynamics(near, -1, rollingFriction=0.1, spinningFriction=0.1, physicsClientId=client)
    for _ in range(240):
        world.step()
    calls = calls_a_step(world)
    assert calls["getContactPoints"] <= 1.0 + 1 / 16  # of the one that it lies on
    assert calls["getBaseVelocity"] <= 2.6  # of that one and the ball, and of a sleeper in its turn


@pytest.mark.parametrize("count", [1, 10])
def test_bodies_that_lie_still_cost_nothing_each(client, count):
    floor(client)
    world = fracsim.World(client)
    for k in range(count):
        world.add(sturdy(), (2 * k, 0, 0.003))
    for _ in range(240):
        world.step()
    calls = calls_a_step(world)
    shared = "getNumBodies", "getBodyUniqueId", "getUserDataId"  # who is there
    assert sum(calls.pop(name) for name in shared) <= 2.2 + 0.2 * count
    assert sum(calls.values()) <= 0.7 + 0.2 * count  # the sleepers every few steps, the clock, what there is


@pytest.mark.parametrize("count", [1, 10])
def test_bodies_that_fly_where_nothing_is_cost_next_to_nothing_each(client, count):
    floor(client)
    p.setGravity(0, 0, -0.1, physicsClientId=client)
    world = fracsim.World(client)
    for k in range(count):
        world.add(sturdy(), (3 * k, 0, 20), tilted(), (0, 1, 0), (1, 0, 1))
    for _ in range(60):
        world.step()
    calls = calls_a_step(world)
    shared = "getNumBodies", "getBodyUniqueId", "getUserDataId"
    assert sum(calls.pop(name) for name in shared) <= 2.2 + 0.2 * count
    assert sum(calls.values()) <= 0.8 + 0.8 * count


def test_no_model_is_asked_below_the_local_breaking_impulse(client, shipped, monkeypatch):
    asked = []
    scores = type(shipped.model).scores
    monkeypatch.setattr(type(shipped.model), "scores", lambda *a: asked.append(1) or scores(*a))
    asset = shipped.scaled(0.3)
    asset = asset.with_material(dataclasses.replace(asset.material, tensile_strength=1e12))
    floor(client)
    world = fracsim.World(client)
    hits = []
    world.on_contact(hits.append)
    world.add(asset, (0, 0, 0.5), tilted())
    asked.clear()
    while world.time < 1:
        world.step()
    assert hits
    assert asked == []


def test_a_simulation_with_breaking_loads_nothing_heavy():
    script = (
        "import sys, pybullet as p, fracsim\n"
        "c = p.connect(p.DIRECT); w = fracsim.World(c); a = fracsim.load('bunny')\n"
        "b = w.add(a); e = w.fracture(b, max(a.sample_impulses(50, 0), key=lambda i: i.magnitude))\n"
        "assert len(e.children) > 1\n"
        "for _ in range(50): w.step()\n"
        "heavy = {'torch', 'optuna', 'networkx', 'coacd', 'matplotlib', 'trimesh', 'sklearn', 'manifold3d'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_headless_break_draws_nothing_and_builds_no_inner_faces(client, shipped, monkeypatch):
    drawn = []
    make = p.createVisualShape
    monkeypatch.setattr(p, "createVisualShape", lambda *a, **k: drawn.append(1) or make(*a, **k))
    world = fracsim.World(client)
    body = world.add(shipped)
    event = world.fracture(body, max(shipped.sample_impulses(50, 0), key=lambda one: one.magnitude))
    assert len(event.children) > 1
    assert len(drawn) <= 1  # the shape that shows nothing
    assert not any({"surface", "hulls"} & set(vars(piece.shape)) for piece in event.fracture.pieces)
    assert not {"labels", "udf"} & set(vars(event.fracture.at_vertices))


def test_shapes_that_come_again_are_used_again(client):
    world = fracsim.World(client)
    asset = SlabBox()
    world.add(asset)
    with counted() as calls:
        world.add(asset, (3, 0, 0))
    assert calls["createCollisionShape"] == 0


# --- and misses nothing


def test_a_sleeper_is_broken_by_what_comes_at_once_and_fast(client):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(toughness=5.0), (0, 0, 0.003))
    for _ in range(240):
        world.step()
    ball(client, 1.0, 0.1, (-100, 0.5, 0.5), (200, 0, 0))
    events = []
    while not events and world.time < 3:
        events = world.step()
    assert events


def test_a_ball_that_got_the_id_of_what_broke_is_seen(client):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(toughness=5.0), (0, 0, 0))
    gone = world.add(SlabBox(), (9, 0, 0))
    world.fracture(gone, HARD)
    for _ in range(240):
        world.step()
    assert ball(client, 1.0, 0.1, (-100, 0.5, 0.5), (200, 0, 0)) == gone
    events = []
    while not events and world.time < 3:
        events = world.step()
    assert events


def test_a_sleeper_pinned_to_the_floor_feels_what_falls_on_it(client):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(toughness=2.0, density=1000.0), (0, 0, 0))
    for _ in range(240):
        world.step()
    ball(client, 1.0, 0.1, (0.5, 0.5, 3.0), (0, 0, 0))
    events = []
    while not events and world.time < 3:
        events = world.step()
    assert events


def test_a_body_in_flight_meets_a_wall(client):
    wall = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.1, 5, 5), physicsClientId=client)
    p.createMultiBody(0, wall, -1, (20, 0, 0), physicsClientId=client)
    world = fracsim.World(client)
    world.add(SlabBox(), orientation=tilted(), linear_velocity=(15, 0, 0))
    events = []
    while not events and world.time < 3:
        events = world.step()
    assert events


@pytest.mark.parametrize("speed", [8.0, 12.0, 20.0])
def test_two_bodies_in_flight_meet_wherever_they_come_from(client, speed):
    for gap in np.linspace(0.3, 3.0, 12):
        p.resetSimulation(physicsClientId=client)
        world = fracsim.World(client)
        world.add(SlabBox(), (-gap, 0, 0), linear_velocity=(speed, 0, 0))
        world.add(SlabBox(), (gap + 1, 0.1, 0.1), linear_velocity=(-speed, 0, 0))
        events = []
        while not events and world.time < 1:
            events = world.step()
        assert len(events) == 2, gap


def test_pieces_that_break_no_more_wake_what_they_fly_at(client):
    floor(client)
    world = fracsim.World(client, generations=1)
    sleeper = world.add(SlabBox(toughness=20.0, density=100.0), (0, 0, 0))
    for _ in range(240):
        world.step()
    bullet = world.add(SlabBox(size=0.3, density=1000.0), (-3, 0.3, 0.4), linear_velocity=(15, 0, 0))
    world.fracture(bullet, HARD)
    broken = set()
    while world.time < 3:
        broken |= {event.parent for event in world.step()}
    assert sleeper in broken


def test_a_body_pressed_among_ten_is_noticed(client):
    floor(client)
    world = fracsim.World(client)
    bodies = [world.add(SlabBox(toughness=2.0), (2 * k, 0, 0.003)) for k in range(10)]
    for _ in range(240):
        world.step()
    for body in bodies:
        begin, events = world.time, []
        while not events and world.time < begin + 3:
            place = p.getBasePositionAndOrientation(body, physicsClientId=client)[0]
            p.applyExternalForce(body, -1, (0, 0, -5e4), place, p.WORLD_FRAME, physicsClientId=client)
            events = world.step()
        assert [event.parent for event in events] == [body]


def test_sleepers_lifted_and_dropped_break(client):
    floor(client)
    p.setTimeStep(1 / 60, physicsClientId=client)
    world = fracsim.World(client)
    bodies = [world.add(SlabBox(), (2 * k, 0, 0.003)) for k in range(10)]
    for _ in range(120):
        world.step()
    for body in bodies:
        (x, y, z), turn = p.getBasePositionAndOrientation(body, physicsClientId=client)
        p.resetBasePositionAndOrientation(body, (x, y, z + 1), turn, physicsClientId=client)
    begin, broken = world.time, set()
    while world.time < begin + 1.5:
        broken |= {event.parent for event in world.step()}
    assert broken >= set(bodies)


@pytest.mark.parametrize("phase", range(13))
def test_a_body_in_flight_that_is_put_elsewhere_is_seen_to_land(client, phase):
    floor(client)
    world = fracsim.World(client)
    body = world.add(SlabBox(), (0, 0, 9))
    for _ in range(20 + phase):
        world.step()
    p.resetBasePositionAndOrientation(body, (0.5, 0.5, 1.0), (0, 0, 0, 1), physicsClientId=client)
    p.resetBaseVelocity(body, (0, 0, -8), (0, 0, 0), physicsClientId=client)
    assert any(world.step() for _ in range(40))


@pytest.mark.parametrize("phase", range(0, 40, 3))
def test_a_clock_changed_in_flight_hides_no_landing(client, phase):
    floor(client)
    p.setTimeStep(1 / 1000, physicsClientId=client)
    world = fracsim.World(client)
    world.add(SlabBox(), (0, 0, 1), linear_velocity=(0, 0, -6))
    for _ in range(13 + phase):
        world.step()
    p.setTimeStep(1 / 60, physicsClientId=client)
    assert any(world.step() for _ in range(60))


@pytest.mark.parametrize("phase", range(8))
def test_a_saved_state_put_back_is_seen_when_woken(client, phase):
    floor(client)
    world = fracsim.World(client)
    body = world.add(SlabBox(), (0, 0, 2.0))
    while p.getBasePositionAndOrientation(body, physicsClientId=client)[0][2] > 0.8 + 0.02 * phase:
        world.step()
    state = p.saveState(physicsClientId=client)
    p.resetBasePositionAndOrientation(body, (0, 0, 30), (0, 0, 0, 1), physicsClientId=client)
    for _ in range(60 + phase):
        world.step()
    p.restoreState(state, physicsClientId=client)
    world.wake()
    assert any(world.step() for _ in range(60))


@pytest.mark.parametrize("phase", range(16))
def test_what_takes_the_id_of_something_static_is_seen(client, phase):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(toughness=5.0), (0, 0, 0.003))
    post = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.1, 0.1, 0.1), physicsClientId=client)
    post = p.createMultiBody(0, post, -1, (-3, 0, 0.1), physicsClientId=client)
    for _ in range(240 + phase):
        world.step()
    p.removeBody(post, physicsClientId=client)
    assert ball(client, 1.0, 0.1, (-0.4, 0.5, 0.5), (30, 0, 0)) == post
    assert any(world.step() for _ in range(20))


def test_a_near_miss_costs_no_look(client, monkeypatch):
    floor(client)
    world = fracsim.World(client)
    for k in range(10):
        world.add(sturdy(), (2 * k, 0, 0.003))
    post = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.1, 0.1, 0.1), physicsClientId=client)
    mover = p.createMultiBody(1.0, post, -1, (9.0, 6.0, 0.5), physicsClientId=client)
    p.changeDynamics(mover, -1, linearDamping=0.0, physicsClientId=client)
    world.add(sturdy(), (9.0, 12.0, 0.003))  # so that the box around all has the mover in it
    for _ in range(240):
        world.step()
    p.resetBasePositionAndOrientation(mover, (3.0, 6.0, 0.5), (0, 0, 0, 1), physicsClientId=client)
    p.resetBaseVelocity(mover, (2, 0, 0), (0, 0, 0), physicsClientId=client)
    calls = calls_a_step(world)
    assert calls.get("getAABB", 0.0) == pytest.approx(1.0, abs=0.1)
    assert calls["getOverlappingObjects"] <= 1.3  # of the box around all, and each body's once it has jumped here
    assert calls["getBaseVelocity"] <= 2.0


# --- what is no hit


@pytest.mark.parametrize("rate", [60, 240, 1000])
def test_own_weight_at_rest_sliding_and_rolling_breaks_nothing(client, rate):
    floor(client)
    p.setTimeStep(1 / rate, physicsClientId=client)
    p.setPhysicsEngineParameter(fixedTimeStep=1 / rate, physicsClientId=client)
    world = fracsim.World(client)
    frail = SlabBox(toughness=1e-6, size=0.3)
    world.add(frail, (0, 0, 0))
    world.add(frail, (3, 0, 0), linear_velocity=(1, 0, 0))
    while world.time < 1.5:
        assert world.step() == []


def test_a_weight_in_a_narrow_wedge_is_no_load(client):
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    half = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.1, 2, 2), physicsClientId=client)
    for side in (-1, 1):
        turn = p.getQuaternionFromEuler((0, side * 0.15, 0))
        p.createMultiBody(0, half, -1, (side * 0.55, 0, 1), turn, physicsClientId=client)
    world = fracsim.World(client)
    asset = SlabBox(toughness=1e-3, size=0.5)
    body = world.add(asset, (-0.25, -0.25, 1.05))
    p.changeDynamics(body, -1, lateralFriction=0.0, physicsClientId=client)
    while world.time < 2:
        events = world.step()
        if world.time > 0.7:
            assert events == []


@pytest.mark.parametrize(("force", "breaks"), [(300.0, False), (3000.0, True)])
def test_a_grip_counts_as_its_force_for_the_time_stated(client, force, breaks):
    toughness = 1000.0 * LOAD_DURATION
    world = fracsim.World(client)
    world.add(SlabBox(toughness=toughness, density=100.0), (-0.5, -0.5, -0.5))
    jaw = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.05, 0.3, 0.3), physicsClientId=client)
    jaws = [p.createMultiBody(5.0, jaw, -1, (side * 0.555, 0, 0), physicsClientId=client) for side in (-1, 1)]
    events = []
    while not events and world.time < 1:
        for side, one in zip((1, -1), jaws, strict=True):
            place = p.getBasePositionAndOrientation(one, physicsClientId=client)[0]
            grown = force * min(1.0, 2 * world.time)
            p.applyExternalForce(one, -1, (side * grown, 0, 0), place, p.WORLD_FRAME, physicsClientId=client)
        events = world.step()
    assert bool(events) == breaks


def test_a_press_on_the_floor_counts_too(client):
    floor(client)
    world = fracsim.World(client)
    body = world.add(SlabBox(toughness=250.0 * LOAD_DURATION, density=0.1), (0, 0, 0))
    events = []
    while not events and world.time < 1:
        place = p.getBasePositionAndOrientation(body, physicsClientId=client)[0]
        p.applyExternalForce(body, -1, (0, 0, -5000.0 * world.time), place, p.WORLD_FRAME, physicsClientId=client)
        events = world.step()
    assert events
    assert 800.0 < 5000.0 * world.time < 1500.0  # N, of which the stub feels the strongest contact: a quarter


def test_a_thousand_taps_do_not_add_up_unless_fatigue_is_on(client):
    def taps(world, body, count):
        asset = world.asset(body)
        for k in range(count):
            p.resetBasePositionAndOrientation(body, (0.5, 0.5, 0.5 + 0.02), (0, 0, 0, 1), physicsClientId=client)
            p.resetBaseVelocity(body, (0, 0, -0.6), (0, 0, 0), physicsClientId=client)
            world.wake(body)
            for _ in range(12):
                if world.step():
                    return k
        assert asset is world.asset(body)
        return None

    floor(client)
    world = fracsim.World(client)
    assert taps(world, world.add(SlabBox(toughness=4.0)), 300) is None
    p.resetSimulation(physicsClientId=client)
    floor(client)
    world = fracsim.World(client, fatigue=4.0)
    assert taps(world, world.add(SlabBox(toughness=4.0)), 300) is not None


def test_the_corners_of_a_flat_landing_act_together(client):
    floor(client)
    world = fracsim.World(client)
    asset = SlabBox(toughness=1e9)
    world.add(asset, (0, 0, 0.5))
    hits = []
    world.on_contact(hits.append)
    while not hits:
        world.step()
    world.step()
    assert len(hits) >= 4
    assert sum(hit.impulse.magnitude for hit in hits) == pytest.approx(asset.mass * np.sqrt(2 * 9.81 * 0.5), rel=0.15)
    acting = world._state.activity.records[hits[0].body].recent_impacts
    assert len(acting) >= 4


# --- pieces break again, to a point


def test_pieces_break_again_down_to_the_limits(client, shipped):
    impulse = max(shipped.sample_impulses(50, 0), key=lambda one: one.magnitude)
    counts = []
    for options in ({"generations": 1}, {"generations": 2}, {"generations": 2, "smallest": 0.2}):
        p.resetSimulation(physicsClientId=client)
        world = fracsim.World(client, **options)
        event = world.fracture(world.add(shipped), impulse)
        again = 0
        for child, piece in zip(event.children, event.fracture.pieces, strict=True):
            if child not in world._state.activity.records:
                with pytest.raises(fracsim.PhysicsError, match="breaks no more"):
                    world.fracture(child, impulse)
                continue
            second = world.fracture(child, [impulse] * 3)
            again += 1
            assert second.generation == 1
            if second.children:
                parts = second.fracture.pieces
                assert sum(part.mass for part in parts) == pytest.approx(piece.mass, rel=1e-9)
                assert set(np.concatenate([part.atoms for part in parts])) == set(piece.atoms)
                for part in second.children:
                    with pytest.raises(fracsim.PhysicsError, match="breaks no more"):
                        world.fracture(part, impulse)
        counts.append(again)
    assert counts[0] == 0
    assert 1 <= counts[2] <= counts[1]


def test_a_piece_that_hits_the_floor_breaks_again(client):
    floor(client)
    world = fracsim.World(client)
    asset = fracsim.load("vase").scaled(0.3)
    body = world.add(asset, (0, 0, 6.0))
    light = min((i for i in asset.sample_impulses(200, 3)), key=lambda one: len(asset.fracture(one).pieces) != 2)
    first = world.fracture(body, light)
    assert len(first.children) == 2
    events = []
    while world.time < 2:
        events += world.step()
    assert events
    assert {event.parent for event in events} & set(first.children)
    assert all(event.generation >= 1 for event in events)


def test_a_budget_takes_the_smallest_and_stillest_debris(client, shipped):
    impulse = max(shipped.sample_impulses(50, 0), key=lambda one: one.magnitude)
    world = fracsim.World(client, budget=4)
    event = world.fracture(world.add(shipped), impulse)
    assert len(event.children) > 4
    assert len(world.pieces) == 4
    masses = dict(zip(event.children, [piece.mass for piece in event.fracture.pieces], strict=True))
    assert sorted(masses[body] for body in world.pieces) == sorted(masses.values())[-4:]


def test_options_out_of_range_are_refused(client):
    for options in ({"generations": 0}, {"smallest": -1}, {"budget": -1}, {"fatigue": 0.5}, {"generations": "many"}):
        with pytest.raises(fracsim.PhysicsError, match=next(iter(options))):
            fracsim.World(client, **options)


def test_a_clock_that_is_changed_is_noticed(client):
    floor(client)
    world = fracsim.World(client)
    world.add(SlabBox(), (0, 0, 5))
    for _ in range(24):
        world.step()
    assert world.time == pytest.approx(0.1)
    p.setTimeStep(1 / 1000, physicsClientId=client)
    for _ in range(800):
        world.step()
    assert world.time == pytest.approx(0.9, abs=8.01 * (1 / 240 - 1 / 1000))
