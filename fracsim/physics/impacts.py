"""From contacts to impulses: what a hit will have delivered, predicted from the motion before it.

The engine spreads a hit over several steps, and the force of the first is no measure of it. The closing speed
before the step is: the impulses are the smallest j ≥ 0 that stop every contact from closing,
A j ≥ closing, with A from the inverse masses and inertias of both bodies, times (1 + restitution).
How deep the two are in each other when the engine notices says when each contact began, so that what a long
step shows at once is taken one after the other, as a short one would have it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import FloatArray
from ..common.impulse import Impulse
from ..geometry.frames import cross
from .bodies import Body
from .bullet import Engine
from .impact_solver import ImpactSolver, complementary_impulses, inverse_inertia
from .rotations import rotation_of
from .states import AT_REST, BodyContacts, Motion, Placement, RigidBody, Triple

MANY, MOST = 32, 96  # contacts of a body from which on they are thinned out, and how many are left at most
LOAD_DURATION = 1e-3  # s: a sustained force F counts as the impulse F LOAD; about what a hit of hard things lasts


@dataclass(frozen=True, eq=False)
class ContactImpulse:
    """One hit on a breakable body.

    body, other, other_link: PyBullet ids; link -1 is the base.
    point, direction: (3,) world, where it acts and the way the body is pushed.
    closing_speed: m/s, before the hit. delay: s, after the first hit of the same step.
    impulse: the same in the asset's frame, as the model sees it. moving: the other body is not static.
    sustained: it is no hit, but what a force that lasts counts as.
    """

    body: int
    other: int
    other_link: int
    point: FloatArray
    direction: FloatArray
    closing_speed: float
    impulse: Impulse
    moving: bool
    delay: float = 0.0
    sustained: bool = False


def impact_speed_threshold(dt: float, gravity: Triple) -> float:
    """The closing speed, m/s, below which a contact is rest, rolling or leaning, and no hit."""
    x, y, z = gravity
    return max(0.1, 3.0 * dt * (x * x + y * y + z * z) ** 0.5)


def is_slow(motion: Motion, limit: float, reach: float) -> bool:
    """Whether no point within ``reach`` of a body's centre of mass is faster than about ``limit``."""
    (a, b, c), (d, e, f) = motion
    v, w = 0.25 * limit, 0.25 * limit / reach
    return -v < a < v and -v < b < v and -v < c < v and -w < d < w and -w < e < w and -w < f < w


def predict_impacts(
    engine: Engine,
    body: Body,
    contacts: BodyContacts,
    placement: Placement,
    motion_of: Callable[[int, int], Motion],
    dt: float,
    gravity: Triple,
) -> list[ContactImpulse]:
    """The hits that a breakable body took in the last step, in the order in which they came.

    placement: where the body was before the step. motion_of: how a body and its link moved then.
    """
    contacts = _thinned(contacts)
    before = body.pose(placement, motion_of(body.id, -1))
    own = _own(engine, body, placement)
    points, normals, others = contacts.points, contacts.normals, contacts.others
    parts = {key: _rewound(engine.rigid_body(*key), engine.motion(key[0]), dt) for key in dict.fromkeys(others)}
    rigids = [own, *parts.values()]
    motions = [motion_of(body.id, -1), *(motion_of(*key) for key in parts)]
    sides = np.array([1 + list(parts).index(key) for key in others])  # whose contact it is
    impact = ImpactSolver(rigids, motions, points, normals, sides)
    closing = impact.closing()
    since = np.clip(contacts.depths / np.maximum(closing, 1e-9), 0.0, dt)
    first = float(since[closing > 0.0].max(initial=0.0))
    # The engine takes a step with the velocity of its end, which is half a step's fall too much at its start.
    impact.fall(np.array(gravity) * (0.5 * dt - first))
    closing = impact.closing()
    least = impact_speed_threshold(dt, gravity)
    if closing.max() <= least:
        return []
    gaps = np.maximum(closing * first - contacts.depths, 0.0)
    places = (points - before.position) @ before.rotation  # (n, 3) asset frame
    pushes = normals @ before.rotation
    return [
        ContactImpulse(
            body.id,
            *others[i],
            points[i],
            normals[i],
            speed,
            Impulse(places[i], pushes[i], size),
            parts[others[i]].mass > 0.0,
            delay,
        )
        for delay, i, speed, size in impact.sequence(gaps, least)
    ]


def _thinned(contacts: BodyContacts) -> BodyContacts:
    """Of more than MANY contacts the deepest in each place, that is from the same thing, the same way and within a
    twentieth of how far they all reach: a model does not tell such apart, and the time to solve for n grows as n³."""
    if len(contacts.others) <= MANY:
        return contacts
    order = np.argsort(-contacts.depths, kind="stable")
    points, normals = contacts.points[order], contacts.normals[order]
    low = points.min(axis=0)
    places = np.floor((points - low) / max(0.05 * float(np.ptp(points, axis=0).max()), 1e-12))
    rows = np.column_stack([np.array(contacts.others)[order], places, np.rint(2.0 * normals)])
    first = np.sort(np.unique(rows, axis=0, return_index=True)[1])  # still by depth
    return contacts.select(np.sort(order[first[:MOST]]).tolist())


def sustained_impulses(
    engine: Engine,
    body: Body,
    contacts: BodyContacts,
    placement: Placement,
    gravity: Triple,
) -> list[ContactImpulse]:
    """What lasting forces on a body at rest count as: F LOAD each, without the share that its own weight takes.

    That share is what the contacts must carry to hold the body alone; a weight resting in a narrow wedge presses on its
    flanks with many times itself and still is no load.
    """
    pose = body.pose(placement, AT_REST)
    own = _own(engine, body, placement)
    if own.mass == 0.0:
        return []
    contacts = contacts.select(np.flatnonzero(contacts.forces > 0.0).tolist())
    some = _thinned(contacts)
    turn = cross(some.points - own.center, some.normals)
    response = some.normals @ some.normals.T / own.mass + turn @ inverse_inertia(own) @ turn.T
    weight = complementary_impulses(response, -(some.normals @ np.array(gravity)))  # N
    share = 1.0 - weight.sum() / contacts.forces.sum()
    places = (contacts.points - pose.position) @ pose.rotation
    pushes = contacts.normals @ pose.rotation
    if share <= 0.0:
        return []
    return [
        ContactImpulse(
            body.id,
            *contacts.others[i],
            contacts.points[i],
            contacts.normals[i],
            0.0,
            Impulse(places[i], pushes[i], float(force) * share * LOAD_DURATION),
            not engine.is_static(contacts.others[i][0]),
            sustained=True,
        )
        for i, force in enumerate(contacts.forces)
        if force > 1e-3 * contacts.forces.max()
    ]


def _own(engine: Engine, body: Body, placement: Placement) -> RigidBody:
    center, quaternion = placement
    return replace(engine.rigid_body(body.id, -1), center=np.array(center), rotation=rotation_of(quaternion))


def _rewound(part: RigidBody, motion: Motion, dt: float) -> RigidBody:
    """A part back where it was before the step: the engine moves with the velocity it ends a step with."""
    if part.mass == 0.0 or part.jointed:
        return part
    center = part.center - dt * np.array(motion[0])
    return replace(part, center=center)
