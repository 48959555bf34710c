"""The families of scenes of the stress matrix: who meets whom, and how.

Each function fills a stage from a cell and its random numbers. ``run`` plays them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pybullet as p

from ...common.impulse import Impulse
from ...physics.events import FractureEvent
from ...physics.impacts import ContactImpulse
from .aiming import aim, random_direction, random_orientation
from .cells import APPROACH, GRAVITY, Cell, asset_named, asset_of
from .stage import Stage

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


def _matrix(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Put bodies side by side, and throw something at each from somewhere, or drop all on the floor."""
    n = cell.breakables
    side = int(np.ceil(n ** (1 / 3)))
    asset = asset_named(cell.mesh)
    extent = np.ptp(asset.vertices, axis=0) / asset.size * cell.size
    lattice = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:n]
    # Neighbours that all but touch: what breaks one soon reaches the next.
    places = lattice * (extent + 0.01 * cell.size)
    orientation = random_orientation(rng) if n == 1 else UPRIGHT
    if cell.other == "floor":
        stage.floor()
        bodies = [stage.breakable(place, orientation) for place in places]
        low = min(p.getAABB(body, -1, physicsClientId=stage.client)[0][2] for body in bodies)
        step = cell.speed * cell.time_step
        rise = step * (APPROACH - min(1.0, 0.1 * cell.size / step) * rng.random())
        rise += GRAVITY * cell.time_step**2 * APPROACH * (APPROACH + 1) / 2 - low
        for body in bodies:
            position, axes = p.getBasePositionAndOrientation(body, physicsClientId=stage.client)
            lifted = (position[0], position[1], position[2] + rise)
            p.resetBasePositionAndOrientation(body, lifted, axes, physicsClientId=stage.client)
            p.resetBaseVelocity(body, (0.0, 0.0, -cell.speed), physicsClientId=stage.client)
        return
    spin = 0.3 * float(rng.random() < 0.5) * float(n == 1)
    bodies = [stage.breakable(place, orientation, spin=spin) for place in places]
    reach = 2.0 * float(np.linalg.norm(np.ptp(places, axis=0))) + 3.0 * cell.size
    for target in rng.choice(n, min(n, 4), replace=False):
        missile = stage.missile(cell.size * rng.uniform(0.08, 0.3), cell.other)
        center = np.array(p.getBasePositionAndOrientation(bodies[target], physicsClientId=stage.client)[0])
        aim(stage, missile, bodies, center, random_direction(rng), reach, rng.random())
    if rng.random() < 0.5:
        stage.boost(cell.speed * rng.random() * random_direction(rng))


def _thrown_at(stage: Stage, cell: Cell, rng: np.random.Generator, delay: int = APPROACH, spin: float = 0.0) -> int:
    """Put a body at the origin and throw a missile at it -> the body."""
    body = stage.breakable(ORIGIN, random_orientation(rng), spin=spin)
    missile = stage.missile(cell.size * rng.uniform(0.1, 0.3), cell.other)
    aim(stage, missile, [body], ORIGIN, random_direction(rng), 3.0 * cell.size, rng.random(), delay)
    return body


def _held(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Hold a body by a constraint to the world (variants 0, 1) or to a free block (2, 3), rigidly or by a point."""
    body = _thrown_at(stage, cell, rng)
    joint = p.JOINT_FIXED if cell.variant % 2 == 0 else p.JOINT_POINT2POINT
    _, orientation = p.getBasePositionAndOrientation(body, physicsClientId=stage.client)
    if cell.variant < 2:
        stage.free = False
        p.createConstraint(
            body,
            -1,
            -1,
            -1,
            joint,
            [0, 0, 0],
            [0, 0, 0],
            [0, 0, 0],
            [0, 0, 0, 1],
            orientation,
            physicsClientId=stage.client,
        )
        return
    _, high = p.getAABB(body, -1, physicsClientId=stage.client)
    half = 0.3 * cell.size
    block = stage.missile(half, "box", 1.0)
    top = [0.0, 0.0, high[2] + half]
    p.resetBasePositionAndOrientation(block, top, (0, 0, 0, 1), physicsClientId=stage.client)
    _, inverse = p.invertTransform([0, 0, 0], orientation)
    arm = p.rotateVector(inverse, top)
    p.createConstraint(
        body, -1, block, -1, joint, [0, 0, 0], arm, [0, 0, 0], inverse, [0, 0, 0, 1], physicsClientId=stage.client
    )


def _post(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Throw a body at a static post, thick or thin, or at its edge."""
    stage.free = False
    thickness = cell.size * (0.5, 0.1, 0.02)[cell.variant % 3]
    post = stage.fixture((thickness, thickness, 2.0 * cell.size), ORIGIN)
    body = stage.breakable(np.array([-3.0 * cell.size, 0.0, 0.0]), random_orientation(rng), spin=0.2)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    aim(stage, body, [post], ORIGIN, direction, 4.0 * cell.size, rng.random())


def _mover(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Move a body of mass 0 from place to place (variant 0), with a velocity besides (1), or a slide on a motor (2)."""
    stage.free = stage.closed = False
    stage.allowed = 3.0 * cell.speed
    body = stage.breakable(ORIGIN, random_orientation(rng))
    half, direction = 0.3 * cell.size, np.array([1.0, 0.0, 0.0])
    client, step = stage.client, cell.speed * cell.time_step
    if cell.variant < 2:
        ram = stage.fixture((half, half, half), ORIGIN)
        aim(stage, ram, [body], ORIGIN, direction, 3.0 * cell.size, rng.random(), 0)
        start = np.array(p.getBasePositionAndOrientation(ram, physicsClientId=client)[0])

        def carry(index: int) -> None:
            place = start + (index - APPROACH) * step * direction
            p.resetBasePositionAndOrientation(ram, place.tolist(), (0, 0, 0, 1), physicsClientId=client)
            velocity = cell.speed * direction if cell.variant == 1 else ORIGIN
            p.resetBaseVelocity(ram, velocity.tolist(), physicsClientId=client)

        carry(0)
        stage.before.append(carry)
        return
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[half] * 3, physicsClientId=client)
    mass = cell.density_ratio * asset_named(cell.mesh).material.density * 8.0 * half**3
    slide = p.createMultiBody(
        0,
        basePosition=(-4.0 * cell.size, 0.0, 0.0),
        linkMasses=[mass],
        linkCollisionShapeIndices=[shape],
        linkVisualShapeIndices=[-1],
        linkPositions=[(0, 0, 0)],
        linkOrientations=[(0, 0, 0, 1)],
        linkInertialFramePositions=[(0, 0, 0)],
        linkInertialFrameOrientations=[(0, 0, 0, 1)],
        linkParentIndices=[0],
        linkJointTypes=[p.JOINT_PRISMATIC],
        linkJointAxis=[(1, 0, 0)],
        physicsClientId=client,
    )
    stage.fixtures.append(slide)
    # The object is slid on to the ram, rather than the ram to the object.
    aim(stage, body, [slide], np.array([-4.0 * cell.size, 0.0, 0.0]), -direction, 4.0 * cell.size, 0.0, 0, 0.0)
    p.resetJointState(slide, 0, -(APPROACH - rng.random()) * step, cell.speed, physicsClientId=client)
    p.changeDynamics(slide, 0, maxJointVelocity=1e5, physicsClientId=client)
    force = 1e3 * (mass + asset_named(cell.mesh).mass * cell.size**3) * cell.speed / cell.time_step
    p.setJointMotorControl2(
        slide, 0, p.VELOCITY_CONTROL, targetVelocity=cell.speed, force=force, physicsClientId=client
    )


def _salvo(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Throw balls or boxes from six sides, all in the same step."""
    body = stage.breakable(ORIGIN, random_orientation(rng))
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        missile = stage.missile(cell.size * rng.uniform(0.05, 0.15), cell.other)
        aim(stage, missile, [body], ORIGIN, axis, 3.0 * cell.size, rng.random())


def _tips(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Hit what sticks out farthest: head on (variant 0), across (1), or grazing (2)."""
    orientation = random_orientation(rng)
    body = stage.breakable(ORIGIN, orientation)
    asset = asset_named(cell.mesh)
    rotation = np.reshape(p.getMatrixFromQuaternion(orientation.tolist()), (3, 3))
    points = (asset.vertices - asset.center_of_mass) @ rotation.T / asset.size * cell.size
    out = random_direction(rng)
    tip = points[np.argmax(points @ out)]
    across = np.cross(out, random_direction(rng))
    across /= np.linalg.norm(across)
    radius = cell.size * rng.uniform(0.03, 0.15)
    direction = (-out, across, across)[cell.variant % 3]
    target = tip - out * (0.0, 0.02, -0.7)[cell.variant % 3] * (cell.size, cell.size, radius)[cell.variant % 3]
    aim(stage, stage.missile(radius, cell.other), [body], target, direction, 3.0 * cell.size, rng.random())


def _inside(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Throw a ball from inside the vase through its wall."""
    asset = asset_named(cell.mesh)
    orientation = random_orientation(rng)
    body = stage.breakable(ORIGIN, orientation)
    rotation = np.reshape(p.getMatrixFromQuaternion(orientation.tolist()), (3, 3))
    hollow = rotation @ (np.array([0.0, 0.0, -0.05]) - asset.center_of_mass) * cell.size
    angle = rng.uniform(0.0, 2.0 * np.pi)
    direction = rotation @ np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.3, 0.3)])
    direction /= np.linalg.norm(direction)
    ball = stage.missile(0.07 * cell.size, "ball")
    aim(stage, ball, [body], hollow, direction, 0.0, rng.random(), delay=0)
    # Where the wall is too far to be met in two steps, or so near that two steps back lie outside, it starts later.
    place = np.array(p.getBasePositionAndOrientation(ball, physicsClientId=stage.client)[0])
    back = min(APPROACH * cell.speed * cell.time_step, float((place - hollow) @ direction))
    p.resetBasePositionAndOrientation(
        ball, (place - back * direction).tolist(), (0, 0, 0, 1), physicsClientId=stage.client
    )
    p.resetBaseVelocity(ball, (cell.speed * direction).tolist(), physicsClientId=stage.client)


def _nested(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Break while breaking: again a step (variant 0) or two (1) later, or on command from a callback (2, 3)."""
    body = _thrown_at(stage, cell, rng)
    if cell.variant < 2:
        missile = stage.missile(cell.size * rng.uniform(0.1, 0.2), cell.other)
        aim(
            stage,
            missile,
            [body],
            ORIGIN,
            random_direction(rng),
            3.0 * cell.size,
            rng.random(),
            APPROACH + 1 + cell.variant,
        )
        return
    # The bystander is far away, or close enough to be in the same heap of contacts.
    apart = 1.5 if cell.variant == 2 else 4.0
    bystander = stage.breakable(np.array([apart * cell.size, 0.0, 0.0]), UPRIGHT)
    impact = _firm(cell, bystander, stage)

    def command(hit: ContactImpulse) -> None:
        if hit.body == body and bystander in stage.world.bodies:
            event = stage.world.fracture(bystander, impact)
            stage.events += [event] if event.children else []

    stage.world.on_contact(command)


def _removal(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Remove bodies as a user might.

    In a callback, what was hit (variant 0), what hit it (1) or a bystander (2); or pieces between steps, through the
    engine (3) or through the world (4).
    """
    stage.free = False
    body = _thrown_at(stage, cell, rng)
    bystander = stage.breakable(np.array([4.0 * cell.size, 0.0, 0.0]), UPRIGHT)
    missile = stage.others[0]

    def answer(hit: ContactImpulse) -> None:
        victim = (body, missile, bystander)[cell.variant]
        if victim in stage.system:
            stage.take(victim)

    def clear(_: int, events: list[FractureEvent]) -> None:
        for child in list(stage.world.pieces)[::2] if events else []:
            stage.take(child, through_world=cell.variant == 4)

    if cell.variant < 3:
        stage.world.on_contact(answer)
    else:
        stage.after.append(clear)


def _worlds(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Play the same scene in two worlds of one process, which differ in nothing but their client."""
    _thrown_at(stage, cell, rng, spin=0.2)


def _states(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Restore a saved state.

    Across the break, where the engine may refuse (variants 0, 1), or between two breaks, where everything must be
    where it was (2, 3).
    """
    client = stage.client
    body = _thrown_at(stage, cell, rng)
    marks: dict[str, int] = {}
    if cell.variant < 2:
        stage.free = stage.closed = False

        def across(index: int, events: list[FractureEvent]) -> None:
            if index == 0:
                marks["state"] = p.saveState(physicsClientId=client)
            if index == APPROACH + 2 + 4 * cell.variant:
                try:
                    p.restoreState(marks["state"], physicsClientId=client)
                    stage.notes.append("restored")
                except p.error as error:
                    stage.notes.append(f"refused: {error}")

        stage.after.append(across)
        return
    bystander = stage.breakable(np.array([4.0 * cell.size, 0.0, 0.0]), random_orientation(rng))
    missile = stage.missile(cell.size * rng.uniform(0.1, 0.2), cell.other)
    center = np.array([4.0 * cell.size, 0.0, 0.0])
    aim(stage, missile, [body, bystander], center, random_direction(rng), 3.0 * cell.size, rng.random(), APPROACH + 10)
    kept: dict[int, Any] = {}

    def poses() -> dict[int, Any]:
        return {body: p.getBasePositionAndOrientation(body, physicsClientId=client) for body in stage.system}

    def between(index: int, events: list[FractureEvent]) -> None:
        if index == APPROACH + 3:
            marks["state"] = p.saveState(physicsClientId=client)
            kept.update(poses())
        if index == APPROACH + 6 + cell.variant:
            if set(kept) != set(stage.system):  # a piece broke again: the bodies differ
                stage.notes.append("broke in between")
                return
            p.restoreState(marks["state"], physicsClientId=client)
            now = poses()
            moved = [b for b in kept if b not in now or not np.allclose(now[b][0], kept[b][0], rtol=1e-9, atol=0)]
            if moved:
                stage.broken["state"] = f"bodies {moved} are not where the saved state has them"

    stage.after.append(between)
    stage.steps += 10


def _robot(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Swing an arm into the object: a KUKA iiwa (even variants) or a Franka Panda."""
    import pybullet_data

    stage.free = stage.closed = False
    client = stage.client
    name = ("kuka_iiwa/model.urdf", "franka_panda/panda.urdf")[cell.variant % 2]
    arm = p.loadURDF(
        os.path.join(pybullet_data.getDataPath(), name), [0, 0, 0], useFixedBase=True, physicsClientId=client
    )
    stage.fixtures.append(arm)
    rates = cell.speed / 0.7  # rad/s of the first joint, for the speed at 0.7 m
    stage.allowed = 6.0 * cell.speed
    stretched = {1: 1.3} if cell.variant % 2 == 0 else {1: 1.0, 3: -0.8, 5: 1.6}
    for joint in range(p.getNumJoints(arm, physicsClientId=client)):
        p.resetJointState(arm, joint, stretched.get(joint, 0.0), physicsClientId=client)
        p.setJointMotorControl2(
            arm, joint, p.VELOCITY_CONTROL, targetVelocity=rates if joint == 0 else 0.0, force=1e4,
            physicsClientId=client,
        )  # fmt: skip
        p.changeDynamics(arm, joint, maxJointVelocity=1e4, physicsClientId=client)
    hand = np.array(p.getLinkState(arm, 6, physicsClientId=client)[0])
    direction = np.cross([0.0, 0.0, 1.0], hand)
    direction /= np.linalg.norm(direction)
    body = stage.breakable(hand, random_orientation(rng))
    aim(stage, body, [arm], hand, -direction, 2.0 * cell.size + 1.0, 0.0, 0, 0.0)
    angle = -(APPROACH - rng.random()) * rates * cell.time_step
    p.resetJointState(arm, 0, angle, rates, physicsClientId=client)


def _rest(stage: Stage, cell: Cell, rng: np.random.Generator) -> None:
    """Break on command: at rest in free space (variant 0), in full flight (1), standing on a floor (2)."""
    body = stage.breakable(
        ORIGIN, UPRIGHT if cell.variant == 2 else random_orientation(rng), spin=0.5 if cell.variant == 1 else 0.0
    )
    if cell.variant == 0:
        stage.still = 1e-3 * cell.size
        stage.allowed = stage.still
    elif cell.variant == 1:
        stage.boost(cell.speed * random_direction(rng))
    else:
        stage.floor()
        low = p.getAABB(body, -1, physicsClientId=stage.client)[0][2]
        place = np.array([0.0, 0.0, 1e-3 * cell.size - low])
        _, axes = p.getBasePositionAndOrientation(body, physicsClientId=stage.client)
        p.resetBasePositionAndOrientation(body, place.tolist(), axes, physicsClientId=stage.client)
    impact = _firm(cell, body, stage)

    def command(index: int) -> None:
        if index == APPROACH and body in stage.world.bodies:
            event = stage.world.fracture(body, impact)
            stage.events += [event] if event.children else []

    stage.before.append(command)
    stage.steps = 60


def _firm(cell: Cell, body: int, stage: Stage) -> Impulse:
    """Draw an impact on command, the same in the twin, that breaks the object at its own strength."""
    asset = asset_of(cell)
    [impact] = asset.sample_impulses(1, cell.seed)
    return asset.impulse_of(10.0, impact.point, impact.direction)


FAMILIES: dict[str, tuple[Callable[[Stage, Cell, np.random.Generator], None], int]] = {  # scene, number of variants
    "matrix": (_matrix, 1),
    "held": (_held, 4),
    "post": (_post, 3),
    "mover": (_mover, 3),
    "salvo": (_salvo, 1),
    "tips": (_tips, 3),
    "inside": (_inside, 1),
    "nested": (_nested, 4),
    "removal": (_removal, 5),
    "worlds": (_worlds, 1),
    "states": (_states, 4),
    "robot": (_robot, 2),
    "rest": (_rest, 3),
}
