"""What breaks in a world: assets, pieces and a user's own objects, and models that fail."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pybullet as p
import pytest
from scenes import HARD, SlabBox, floor, tilted

import fracsim
from fracsim.physics.breakable import require_breakable
from fracsim.physics.live_convex import asset_of


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def test_an_asset_and_an_object_of_one_s_own_are_breakable_and_a_piece_counts_its_share(shipped):
    require_breakable(shipped)
    require_breakable(SlabBox())
    impulse = max(shipped.sample_impulses(50, 0), key=lambda one: one.magnitude)
    pieces = [shipped.breakable_piece(piece) for piece in shipped.fracture(impulse).pieces]
    assert sum(piece.volume_fraction for piece in pieces) == pytest.approx(1.0)
    assert shipped.volume_fraction == 1.0
    assert all(asset_of(piece) is shipped for piece in pieces)


def test_what_an_object_lacks_is_named(client):
    class Half(SlabBox):
        bearable_impulse = property()

    class Nothing:
        name, size = "nothing", 1.0

    with pytest.raises(fracsim.PhysicsError, match="lacks bearable_impulse, breakable_piece, center_of_mass"):
        fracsim.World(client).add(Nothing())
    require_breakable(Half())  # a property is looked up and not worked out


def test_only_a_baked_asset_is_decomposed_as_it_breaks(client):
    pytest.importorskip("coacd")
    world = fracsim.World(client, decomposition="coacd")
    with pytest.raises(fracsim.PhysicsError, match="only baked assets can be decomposed"):
        world.add(SlabBox())
    assert p.getNumBodies(physicsClientId=client) == 0


def until(world, time):
    while world.time < time:
        world.step()


# --- models that fail


@pytest.mark.parametrize("error", [fracsim.FieldError("not finite"), fracsim.ModelError("no weights")])
def test_a_model_without_an_answer_leaves_the_body_whole_with_one_warning(client, error):
    class Broken(SlabBox):
        def fracture(self, impulses, predictor="field"):
            raise error

    floor(client)
    world = fracsim.World(client)
    body = world.add(Broken(), (0, 0, 1), tilted())
    with pytest.warns(RuntimeWarning, match="does not break: its model failed") as caught:
        event = world.fracture(body, HARD)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # one warning is enough
        while world.time < 1:
            assert world.step() == []
    assert event.children == ()
    assert len(event.fracture.pieces) == 1
    assert world.bodies == (body,)


@pytest.mark.parametrize("error", [TypeError("bug"), IndexError("bug"), ValueError("bug"), RuntimeError("bug")])
def test_a_fault_in_the_code_of_a_model_surfaces_and_leaves_the_world_usable(client, error):
    faults = [error]

    class Broken(SlabBox):
        def fracture(self, impulses, predictor="field"):
            if faults:
                raise faults.pop()
            return super().fracture(impulses)

    floor(client)
    world = fracsim.World(client)
    body = world.add(Broken(), (0, 0, 1), tilted())
    with pytest.raises(type(error), match="bug"):
        world.fracture(body, HARD)
    faults.append(error)
    with pytest.raises(type(error), match="bug"):
        until(world, 1.0)
    assert world.bodies == (body,)
    assert len(world.fracture(body, HARD).children) == 4


def test_a_fault_in_the_asset_s_own_code_surfaces(client, monkeypatch):
    asset = fracsim.load("vase")
    world = fracsim.World(client)
    body = world.add(asset)
    impulse = max(asset.sample_impulses(50, 0), key=lambda one: one.magnitude)
    with monkeypatch.context() as patch:
        patch.setattr("fracsim.fracture.query.merge_small_pieces", lambda *arguments: None + 1)
        with pytest.raises(TypeError, match="unsupported operand"):
            world.fracture(body, impulse)
    assert len(world.fracture(body, impulse).children) > 1


def test_a_model_that_fails_when_it_is_made_ready_is_one_that_fails(client):
    class Broken(SlabBox):
        def prepare(self):
            raise fracsim.FieldError("not finite")

    class Faulty(SlabBox):
        def prepare(self):
            raise TypeError("bug")

    world = fracsim.World(client)
    with pytest.warns(RuntimeWarning, match="does not break: its model failed"):
        assert world.add(Broken()) == 0
    with pytest.raises(TypeError, match="bug"):
        world.add(Faulty())


# --- events are plain data


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda event: pickle.loads(pickle.dumps(event))])
def test_an_event_can_be_copied_and_sent_to_another_process(client, shipped, copied):
    world = fracsim.World(client)
    impulse = max(shipped.sample_impulses(50, 0), key=lambda one: one.magnitude)
    event = world.fracture(world.add(shipped, angular_velocity=(0, 0, 1)), impulse)
    twin = copied(event)
    assert (twin.parent, twin.children, twin.time) == (event.parent, event.children, event.time)
    assert twin.timings == event.timings
    assert twin.energy == event.energy
    assert twin.impulse.magnitude == event.impulse.magnitude
    np.testing.assert_array_equal(twin.fracture.labels, event.fracture.labels)
    for ours, theirs in zip(event.fracture.pieces, twin.fracture.pieces, strict=True):
        np.testing.assert_array_equal(theirs.vertices, ours.vertices)
        assert theirs.mass == ours.mass
    taken = twin.energy.taken
    for _ in range(5):
        world.step()
    assert twin.energy.taken == taken
