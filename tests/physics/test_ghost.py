"""No ghost energy: what stood stays standing when it breaks, and what falls over gains nothing."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pybullet as p
import pytest
from scenes import CUBE, CUBE_FACES, HARD, SlabBox, floor, mechanics

import fracsim
from fracsim.fracture.pieces import ConvexParts


@pytest.fixture
def client():
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


def boxes(cells, density=2400.0):
    """A piece of axis-aligned boxes [(low, high), ...], each its own convex part, 0.75 mm within it."""
    low, high = (np.array([cell[k] for cell in cells], dtype=float) for k in (0, 1))
    extent = high - low
    masses = density * extent.prod(axis=1)
    center = masses @ (low + high) / 2 / masses.sum()
    inertia = np.zeros((3, 3))
    for mass, size, middle in zip(masses, extent, (low + high) / 2, strict=True):
        arm = middle - center
        inertia += mass / 12 * np.diag((size**2).sum() - size**2)
        inertia += mass * ((arm @ arm) * np.eye(3) - np.outer(arm, arm))
    gap = 0.75e-3
    parts = ConvexParts.of([CUBE * (size - 2 * gap) + start + gap for size, start in zip(extent, low, strict=True)])
    return SimpleNamespace(
        vertices=CUBE * (high.max(axis=0) - low.min(axis=0)) + low.min(axis=0), faces=CUBE_FACES, mass=masses.sum(),
        center_of_mass=center, inertia=inertia, convex_parts=parts, atoms=np.arange(1),
    )  # fmt: skip


class Puzzle(SlabBox):
    """A unit cube that breaks into given pieces."""

    cut: tuple = ()

    def fracture(self, impulses, predictor="field"):
        return SimpleNamespace(pieces=self.cut, timings={}, crack_area=0.0)


def puzzle(*pieces):
    result = Puzzle(density=2400.0)
    object.__setattr__(result, "cut", tuple(boxes(cells) for cells in pieces))
    return result


# An L and its complement, hooked into one another, below a slab that lies on both.
INTERLOCKING = puzzle(
    [((0, 0, 0), (0.7, 1, 0.3)), ((0, 0, 0.3), (0.3, 1, 0.6))],
    [((0.3, 0, 0.3), (1, 1, 0.6)), ((0.7, 0, 0), (1, 1, 0.3))],
    [((0, 0, 0.6), (1, 1, 1))],
)
CRACKED = puzzle(
    [((0, 0, 0), (0.4, 0.5, 0.5))], [((0.4, 0, 0), (1, 0.5, 0.5))], [((0, 0.5, 0), (1, 1, 0.5))],
    [((0, 0, 0.5), (0.6, 0.4, 1)), ((0, 0.4, 0.5), (0.3, 1, 1))],
    [((0.6, 0, 0.5), (1, 0.4, 1)), ((0.3, 0.4, 0.5), (1, 1, 1))],
)  # fmt: skip


@pytest.mark.parametrize("what", [INTERLOCKING, CRACKED], ids=["interlocking", "cracked"])
@pytest.mark.parametrize("rate", [120, 240, 960])
def test_pieces_of_what_stands_stay_where_they_are(client, what, rate):
    floor(client)
    p.setTimeStep(1 / rate, physicsClientId=client)
    parameters = p.getPhysicsEngineParameters(client)
    world = fracsim.World(client)
    body = world.add(what)
    for _ in range(rate // 2):
        world.step()
    event = world.fracture(body, HARD)

    def places():
        return np.array([p.getBasePositionAndOrientation(child, client)[0] for child in event.children])

    start, rise, highest = places(), 0.0, 0.0
    while world.time < 2.5:
        world.step()
        highest = max(highest, (places() - start)[:, 2].max())
        if world.time > 0.7:  # once they have settled by the gaps between them
            rise = max(rise, max(p.getBaseVelocity(child, client)[0][2] for child in event.children))
    assert np.abs(places() - start).max() < 0.02
    assert highest < 1e-3
    assert rise < 0.01
    assert p.getPhysicsEngineParameters(client) == parameters


def test_a_tower_that_topples_gains_no_energy(client):
    floor(client)
    world = fracsim.World(client)
    tower = puzzle([((0, 0, 0), (1, 1, 0.2))], [((0, 0, 0.2), (0.3, 1, 1))], [((0.3, 0, 0.2), (0.5, 0.4, 0.9))])
    body = world.add(tower)
    for _ in range(60):
        world.step()
    event = world.fracture(body, HARD)
    p.resetBaseVelocity(event.children[1], (-0.8, 0, 0), (0, -1.5, 0), client)
    p.resetBaseVelocity(event.children[2], (0.5, 0, 0), (0, 1.0, 0.3), client)

    def energy():
        mass, _, _, center, kinetic = mechanics(client, event.children)
        return kinetic + 9.81 * mass * center[2]

    start = most = energy()
    scale = 9.81 * mechanics(client, event.children)[0] * 1.0
    while world.time < 3:
        world.step()
        most = max(most, energy())
    assert most <= start + 1e-3 * scale
    assert energy() < start - 0.01 * scale  # it did topple


@pytest.fixture(scope="module")
def impacts(shipped):
    """Impulses, and how many pieces each leaves."""
    impulses = shipped.sample_impulses(60, 9)
    return impulses, np.array([len(shipped.fracture(one).pieces) for one in impulses])


@pytest.mark.parametrize("size", [0.01, 0.3, 30.0])
def test_whatever_breaks_at_rest_stays_at_rest(client, shipped, impacts, size):
    impulses, counts = impacts
    order = np.argsort(counts)[np.count_nonzero(counts == 1) :]
    for k in (order[0], order[len(order) // 2], order[-1]):  # from two pieces to shattered
        p.resetSimulation(physicsClientId=client)
        world = fracsim.World(client)
        impact = impulses[k]
        scaled = fracsim.Impulse(impact.point * size, impact.direction, impact.magnitude * size**3)
        event = world.fracture(world.add(shipped.scaled(size)), scaled)
        assert len(event.children) == counts[k]
        for _ in range(240):
            p.stepSimulation(physicsClientId=client)
        speeds = [np.abs(p.getBaseVelocity(child, client)[0]).max() for child in event.children]
        assert max(speeds) <= 1e-3
