"""How hard impacts are by what bodies are made of: the contact law in a world."""

from __future__ import annotations

import numpy as np
import pybullet as p
import pytest
from force_assets import counting_forces
from scenes import SlabBox, ball, floor, sliding_arm, tilted

import fracsim
from fracsim.common.contact import LOAD_DURATION, ContactLaw
from fracsim.common.material import ContactMaterial

TILTED = p.getQuaternionFromEuler((0.5, 0.3, 0.0))
STRONG = 1e9  # N, which nothing here reaches


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


@pytest.fixture(scope="module")
def strong():
    return counting_forces("vase", 0.3, STRONG)


def drop(client, asset, height, material=None, dt=1 / 240, stiffness=None, orientation=TILTED):
    """Let an asset fall on a new floor; the impacts of the step in which it lands, and what broke in it."""
    p.resetSimulation(physicsClientId=client)
    p.setTimeStep(dt, physicsClientId=client)
    ground = floor(client)
    if stiffness is not None:
        p.changeDynamics(ground, -1, contactStiffness=stiffness, contactDamping=1e3, physicsClientId=client)
    world = fracsim.World(client)
    if material is not None:
        world.set_material(ground, material)
    hits = []
    world.on_contact(hits.append)
    body = world.add(asset, (0, 0, 2), orientation)
    place, axes = p.getBasePositionAndOrientation(body, physicsClientId=client)
    above = p.getAABB(body, -1, physicsClientId=client)[0][2]
    lowered = (place[0], place[1], place[2] - above + height)
    p.resetBasePositionAndOrientation(body, lowered, axes, physicsClientId=client)
    world.wake()
    events = []
    while not hits and world.time < 2.0:
        events = world.step()
    return hits, events


def force_of(hits):
    return max(hit.impulse.peak_force for hit in hits)


# --- what a body is made of


def test_softer_floors_press_less(client, strong):
    forces = {
        name: force_of(drop(client, strong, 0.1, name)[0])
        for name in (None, "steel", "stone", "wood", "rubber", "carpet", "foam")
    }
    values = list(forces.values())
    assert values == sorted(values, reverse=True)
    assert forces["stone"] > 0.9 * forces[None]
    assert forces["wood"] > 2.0 * forces["rubber"]


def test_a_carpet_helps_more_in_a_low_fall_than_in_a_high_one(client, strong):
    low, high = (
        force_of(drop(client, strong, height, "carpet")[0]) / force_of(drop(client, strong, height)[0])
        for height in (0.1, 2.0)
    )
    assert low < 0.3
    assert high > 0.9


def test_the_force_is_the_contact_law_s(client, strong):
    for name in ("stone", "rubber"):
        [hit], _ = drop(client, strong, 0.5, name)
        other = fracsim.common.material.CONTACT_PRESETS[name]
        law = ContactLaw.of(
            strong.size,
            *(strong.material.youngs_modulus, strong.material.poisson_ratio),
            *(other.youngs_modulus, other.poisson_ratio, other.travel),
            compliance=float(strong.compliance_at(hit.impulse.point[None])[0]),
        )
        assert hit.impulse.peak_force == pytest.approx(float(law.peak_force(hit.energy)))
        assert hit.impulse.duration == pytest.approx(np.pi / 2 * hit.impulse.magnitude / hit.impulse.peak_force)


def test_an_asset_breaks_on_stone_and_lands_whole_on_rubber(client):
    for asset in (counting_forces("vase", 0.3, 5000.0), fracsim.load("vase").scaled(0.3)):
        assert drop(client, asset, 1.0, "stone")[1]
        hits, events = drop(client, asset, 1.0, "rubber")
        assert hits
        assert not events


def test_what_nobody_named_leaves_an_asset_that_counts_impulses_as_it_was(client):
    asset = fracsim.load("vase").scaled(0.3)
    [unnamed], [event] = drop(client, asset, 1.0)
    assert unnamed.impulse.duration is None
    [named], [again] = drop(client, asset, 1.0, "stone")
    assert named.impulse.magnitude == unnamed.impulse.magnitude
    assert named.impulse.peak_force * LOAD_DURATION > named.impulse.magnitude  # so that all of it counts
    np.testing.assert_array_equal(again.fracture.labels, event.fracture.labels)


def test_an_object_of_ones_own_counts_as_rigid(client):
    [*hits], _ = drop(client, SlabBox(toughness=1e9), 0.5)
    assert all(hit.impulse.duration is None for hit in hits)
    [*hits], _ = drop(client, SlabBox(toughness=1e9), 0.5, "wood")
    law = ContactLaw.of(1.0, np.inf, 0.0, 1.1e9, 0.35)
    assert force_of(hits) == pytest.approx(float(law.peak_force(max(hit.energy for hit in hits))))


def test_engine_stiffness_counts_as_a_spring(client, strong):
    [hard], _ = drop(client, strong, 0.5)
    [soft], _ = drop(client, strong, 0.5, stiffness=1e5)
    own = float(strong.compliance_at(soft.impulse.point[None])[0])
    law = ContactLaw.of(0.3, strong.material.youngs_modulus, strong.material.poisson_ratio, compliance=own + 1.0 / 1e5)
    assert soft.impulse.peak_force == pytest.approx(float(law.peak_force(soft.energy)))
    assert soft.impulse.peak_force < 0.3 * hard.impulse.peak_force
    modal = fracsim.load("vase").scaled(0.3)
    assert drop(client, modal, 1.0)[1]
    assert not drop(client, modal, 1.0, stiffness=1e4)[1]


def test_two_breakable_bodies_are_of_their_assets_materials(client, strong):
    def meet(other):
        p.resetSimulation(physicsClientId=client)
        world = fracsim.World(client)
        hits = []
        world.on_contact(hits.append)
        world.add(strong, (0, 0, 0), linear_velocity=(0, 0, 3))
        world.add(other, (0, 0, 0.4))
        while not hits and world.time < 1.0:
            world.step()
        return force_of(hit for hit in hits if hit.body == 0)

    import dataclasses

    soft = dataclasses.replace(strong.material, youngs_modulus=1e8)
    assert meet(strong.with_material(soft)) < 0.3 * meet(strong)


def test_what_only_leans_carries_the_blow_on(client):
    ground = floor(client)
    world = fracsim.World(client)
    world.set_material(ground, "steel")
    world.add(SlabBox(toughness=1e9), (-0.5, -0.5, 0.0))
    for _ in range(30):
        world.step()
    hits = []
    world.on_contact(hits.append)
    hammer = ball(client, 5.0, 0.1, (0, 0, 1.15), (0, 0, -8.0))
    world.set_material(hammer, "wood")
    while not hits:
        world.step()
    blow, *same = [hit for hit in hits if hit.other == hammer]
    held = [hit for hit in hits if hit.other == ground and hit.delay == blow.delay]
    assert held
    assert all(hit.impulse.duration == blow.impulse.duration for hit in (*same, *held))


# --- energy and forces


@pytest.mark.parametrize("orientation", [TILTED, (0, 0, 0, 1), tilted()])
def test_no_landing_takes_more_energy_than_the_body_has(client, strong, orientation):
    for asset in (strong, SlabBox(toughness=1e9)):
        hits, _ = drop(client, asset, 0.5, "stone", orientation=orientation)
        first = [hit for hit in hits if hit.delay == hits[0].delay]
        assert 0.0 < sum(hit.energy for hit in first) <= asset.mass * 9.81 * 0.5 * 1.02


def test_forces_hardly_depend_on_the_time_step(client, strong):
    forces = [force_of(drop(client, strong, 0.5, "stone", dt)[0]) for dt in (1 / 120, 1 / 240, 1 / 1000)]
    np.testing.assert_allclose(forces, forces[-1], rtol=0.03)


@pytest.mark.parametrize("dt", [1 / 120, 1 / 240, 1 / 1000])
def test_a_grip_has_its_force_whatever_the_time_step(client, dt):
    force = 900.0
    p.setTimeStep(dt, physicsClientId=client)
    world = fracsim.World(client)
    world.add(SlabBox(toughness=1000.0 * LOAD_DURATION, density=100.0), (-0.5, -0.5, -0.5))
    hits = []
    world.on_contact(hits.append)
    jaw = p.createCollisionShape(p.GEOM_BOX, halfExtents=(0.05, 0.3, 0.3), physicsClientId=client)
    jaws = [p.createMultiBody(500.0, jaw, -1, (side * 0.551, 0, 0), physicsClientId=client) for side in (-1, 1)]
    while world.time < 1.2 or (not hits and world.time < 2.0):
        hits.clear()  # of the time in which the grip grows
        for side, one in zip((1, -1), jaws, strict=True):
            place = p.getBasePositionAndOrientation(one, physicsClientId=client)[0]
            grown = force * min(1.0, world.time)
            p.applyExternalForce(one, -1, (side * grown, 0, 0), place, p.WORLD_FRAME, physicsClientId=client)
        world.step()
    for one in jaws:
        grip = [hit.impulse.peak_force for hit in hits if hit.sustained and hit.other == one]
        assert sum(grip) == pytest.approx(force, rel=0.06)


# --- naming materials


def test_a_material_outlives_a_saved_state(client, strong):
    hits, _ = drop(client, strong, 0.5, "rubber")
    soft = force_of(hits)
    p.resetSimulation(physicsClientId=client)
    ground = floor(client)
    world = fracsim.World(client)
    body = world.add(strong, (0, 0, 0.5), TILTED)
    world.set_material(ground, "rubber")
    state = p.saveState(physicsClientId=client)
    for _ in range(3):
        hits = []
        end = world.on_contact(hits.append)
        start = world.time
        while not hits and world.time < start + 2.0:
            world.step()
        end()
        assert force_of(hits) < 2.0 * soft
        p.restoreState(state, physicsClientId=client)
        world.wake(body)


def test_a_material_does_not_pass_to_another_body_of_the_same_id(client, strong):
    ground = floor(client)
    world = fracsim.World(client)
    world.set_material(ground, "rubber")
    p.removeBody(ground, physicsClientId=client)
    box = p.createCollisionShape(p.GEOM_BOX, halfExtents=(1, 1, 0.5), physicsClientId=client)
    other = p.createMultiBody(0, box, -1, (0, 0, -0.5), physicsClientId=client)
    world.add(strong, (0, 0, 0.3), TILTED)
    hits = []
    world.on_contact(hits.append)
    while not hits and world.time < 1.0:
        world.step()
    own = float(strong.compliance_at(hits[0].impulse.point[None])[0])
    hard = ContactLaw.of(0.3, strong.material.youngs_modulus, strong.material.poisson_ratio, compliance=own)
    assert other == ground or hits[0].other == other
    assert force_of(hits) == pytest.approx(float(hard.peak_force(hits[0].energy)), rel=1e-6)


def test_links_can_be_named_apart_and_forgotten(client):
    arm = sliding_arm(client, (0, 0, 0))
    world = fracsim.World(client)
    gel = ContactMaterial("gel", 1e5, 0.49)
    materials = world._state.materials
    world.set_material(arm, "steel")
    world.set_material(arm, gel, link=0)
    assert materials.of(arm, 0) is gel
    assert materials.of(arm, -1).name == "steel"
    world.set_material(arm, None, link=0)
    assert materials.of(arm, 0).name == "steel"
    world.set_material(arm, gel, link=0)
    world.set_material(arm, None)
    assert materials.of(arm, 0) is materials.of(arm, -1) is None


def test_wrong_names_are_typed_errors(client, strong):
    ground = floor(client)
    world = fracsim.World(client)
    body = world.add(strong, (0, 0, 1))
    with pytest.raises(fracsim.MaterialError, match="unknown material 'cheese'; use carpet"):
        world.set_material(ground, "cheese")
    with pytest.raises(fracsim.PhysicsError, match="there is no body 77 to be of rubber"):
        world.set_material(77, "rubber")
    with pytest.raises(fracsim.PhysicsError, match="of its asset's material"):
        world.set_material(body, "rubber")
