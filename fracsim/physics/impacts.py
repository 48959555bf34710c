"""From contacts to impulses: what an impact will have delivered, predicted from the motion before it.

The engine spreads an impact over several steps, and the force of the first is no measure of it. The closing speed
before the step is. `Verdicts` asks the model with the impulses that come out of here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import FloatArray
from ..common.impulse import Impulse
from ..geometry.frames import cross
from .bodies import Body
from .bullet import Engine
from .impact_solver import SETTINGS, ImpactSolver, complementary_impulses, inverse_inertia
from .rotations import rotation_of
from .states import AT_REST, BodyContacts, BodyLink, Motion, Placement, RigidBody, Triple

SLOW_SHARE = 0.25  # of a limit; three components of speed and three of spin below it add up to about the limit


@dataclass(frozen=True, eq=False)
class ClosedContact:
    """A contact of a breakable body that has closed.

    Attributes
    ----------
    other : (int, int)
        Body and link of what it is with; link -1 is the base.
    stiffness : float
        Of soft contacts with that, as the engine has it, N/m; 0 or less where it was not set.
    point : ndarray of float64, shape (3,)
        m, world frame.
    place : ndarray of float64, shape (3,)
        m, in the frame of the struck body's asset.
    speed : float
        m/s, at which it closed.
    impulse : float
        N·s.
    energy : float
        J, that it takes until nothing closes any more.
    delay : float
        s, after the first impact of the step; contacts of the same delay begin together.
    """

    other: BodyLink
    stiffness: float
    point: FloatArray
    place: FloatArray
    speed: float
    impulse: float
    energy: float
    delay: float


@dataclass(frozen=True, eq=False)
class ContactImpulse:
    """One impact on a breakable body at one contact.

    Attributes
    ----------
    body, other, other_link : int
        PyBullet's ids of the breakable body and of what it met, and the link of the latter; -1 is the base.
    point : ndarray of float64, shape (3,)
        Where it acts, m, world frame.
    direction : ndarray of float64, shape (3,)
        Unit vector the way the breakable body is pushed, world frame.
    closing_speed : float
        Before the impact, m/s; 0 for a sustained load.
    impulse : Impulse
        The same in the frame of the asset, as the model sees it (m, N·s).
    moving : bool
        Whether the other body is not static.
    energy : float
        J, that the contact takes until nothing closes any more; 0 for a sustained load.
    delay : float
        Time after the first impact of the same step, s.
    sustained : bool
        Whether it is no impact, but what a force that lasts counts as.
    """

    body: int
    other: int
    other_link: int
    point: FloatArray
    direction: FloatArray
    closing_speed: float
    impulse: Impulse
    moving: bool
    energy: float = 0.0
    delay: float = 0.0
    sustained: bool = False


def impact_speed_threshold(dt: float, gravity: Triple) -> float:
    """Compute the closing speed below which a contact is rest, rolling or leaning, and no impact.

    Parameters
    ----------
    dt : float
        Time step, s.
    gravity : tuple of float
        m/s².

    Returns
    -------
    float
        m/s: the larger of 0.1 and what three steps of fall make.

    Examples
    --------
    >>> impact_speed_threshold(1 / 240, (0, 0, -9.6))
    0.12
    """
    x, y, z = gravity
    return max(SETTINGS.least_impact_speed, SETTINGS.least_steps_of_fall * dt * (x * x + y * y + z * z) ** 0.5)


def is_slow(motion: Motion, limit: float, reach: float) -> bool:
    """Tell whether no point of a body is faster than about a speed.

    Parameters
    ----------
    motion : Motion
        How it moves, m/s and rad/s.
    limit : float
        The speed, m/s.
    reach : float
        Distance from its centre of mass to its furthest point, m.

    Returns
    -------
    bool
        Whether each component of its velocity, and of its angular velocity times reach, is below `SLOW_SHARE` of the
        limit.
    """
    (a, b, c), (d, e, f) = motion
    v, w = SLOW_SHARE * limit, SLOW_SHARE * limit / reach
    return -v < a < v and -v < b < v and -v < c < v and -w < d < w and -w < e < w and -w < f < w


def predict_impacts(
    engine: Engine,
    body: Body,
    contacts: BodyContacts,
    placement: Placement,
    motion_of: Callable[[int, int], Motion],
    durations_of: Callable[[Sequence[ClosedContact], float], list[float | None]],
    dt: float,
    gravity: Triple,
) -> list[ContactImpulse]:
    """Predict the impacts that a breakable body took in the last step.

    Parameters
    ----------
    engine : Engine
        Engine that the body is in.
    body : Body
        The body.
    contacts : BodyContacts
        Its contacts in the last step.
    placement : Placement
        Where it was before the step.
    motion_of : callable
        Maps a body and its link to how it moved before the step.
    durations_of : callable
        Gives the duration of contacts, s, as `ContactDurations.of` returns it.
    dt : float
        Time step, s.
    gravity : tuple of float
        m/s².

    Returns
    -------
    list of ContactImpulse
        In the order in which they came; empty where nothing closed faster than the threshold.

    Notes
    -----
    The impulses j ≥ 0 are the smallest that stop every contact from closing, A j ≥ closing, times one plus the
    restitution. A comes of the masses and inertias of both bodies (`ImpactSolver`). How deep two bodies are in each
    other when the engine notices says when each contact began, so what a long step shows at once is taken one after
    the other, as a short one would have it.
    """
    contacts = _thin_out(contacts)
    before = body.pose(placement, motion_of(body.id, -1))
    points, normals, others = contacts.points, contacts.normals, contacts.others
    strikers = {key: _moved_back(engine.rigid_body(*key), engine.motion(key[0]), dt) for key in dict.fromkeys(others)}
    rigids = [_placed(engine, body, placement), *strikers.values()]
    motions = [motion_of(body.id, -1), *(motion_of(*key) for key in strikers)]
    sides = np.array([1 + list(strikers).index(key) for key in others])
    solver = ImpactSolver(rigids, motions, points, normals, sides)
    closing = solver.closing()
    since = np.clip(contacts.depths / np.maximum(closing, 1e-9), 0.0, dt)  # s for which each contact has lasted
    first = float(since[closing > 0.0].max(initial=0.0))
    # The engine takes a step with the velocity of its end, which is half a step's fall too much at its start.
    solver.accelerate(np.array(gravity) * (0.5 * dt - first))
    closing = solver.closing()
    threshold = impact_speed_threshold(dt, gravity)
    if closing.max() <= threshold:
        return []
    gaps = np.maximum(closing * first - contacts.depths, 0.0)
    places = (points - before.position) @ before.rotation  # (n, 3) asset frame
    pushes = normals @ before.rotation
    sequence = solver.sequence(gaps, threshold)
    closed = [
        ClosedContact(
            others[i],
            strikers[others[i]].contact_stiffness,
            points[i],
            places[i],
            speed,
            size,
            0.5 * size * max(speed, 0.0) / (1.0 + float(solver.restitution[i])),
            delay,
        )
        for delay, i, speed, size in sequence
    ]
    return [
        ContactImpulse(
            body.id,
            *contact.other,
            contact.point,
            normals[i],
            contact.speed,
            Impulse(contact.place, pushes[i], contact.impulse, duration),
            strikers[contact.other].mass > 0.0,
            contact.energy,
            contact.delay,
        )
        for (_, i, _, _), contact, duration in zip(sequence, closed, durations_of(closed, threshold), strict=True)
    ]


def sustained_impulses(
    engine: Engine,
    body: Body,
    contacts: BodyContacts,
    placement: Placement,
    gravity: Triple,
) -> list[ContactImpulse]:
    """Compute what lasting forces on a body at rest count as.

    Parameters
    ----------
    engine : Engine
        Engine that the body is in.
    body : Body
        The body.
    contacts : BodyContacts
        Its contacts, with their forces.
    placement : Placement
        Where it is.
    gravity : tuple of float
        m/s².

    Returns
    -------
    list of ContactImpulse
        Each force, as `Impulse.from_force` describes it, without the share that the body's own weight takes.

    Notes
    -----
    That share is what the contacts must carry to hold the body alone. A weight resting in a narrow wedge presses on
    its flanks with many times itself and still is no load.
    """
    pose = body.pose(placement, AT_REST)
    rigid = _placed(engine, body, placement)
    if rigid.mass == 0.0:
        return []
    contacts = contacts.select(np.flatnonzero(contacts.forces > 0.0).tolist())
    holding = _thin_out(contacts)
    turn = cross(holding.points - rigid.center, holding.normals)
    response = holding.normals @ holding.normals.T / rigid.mass + turn @ inverse_inertia(rigid) @ turn.T
    weight = complementary_impulses(response, -(holding.normals @ np.array(gravity)))  # N
    share = 1.0 - weight.sum() / contacts.forces.sum()
    if share <= 0.0:
        return []
    places = (contacts.points - pose.position) @ pose.rotation
    pushes = contacts.normals @ pose.rotation
    return [
        ContactImpulse(
            body.id,
            *contacts.others[i],
            contacts.points[i],
            contacts.normals[i],
            0.0,
            Impulse.from_force(places[i], pushes[i], float(force) * share),
            not engine.is_static(contacts.others[i][0]),
            sustained=True,
        )
        for i, force in enumerate(contacts.forces)
        if force > SETTINGS.negligible_share * contacts.forces.max()
    ]


def _thin_out(contacts: BodyContacts) -> BodyContacts:
    """Keep the deepest of the contacts in each place, if there are many.

    In one place are those with the same thing, the same way and within a share of how far they all reach. A model does
    not tell them apart, and the time to solve for n of them grows as n³.
    """
    if len(contacts.others) <= SETTINGS.many_contacts:
        return contacts
    order = np.argsort(-contacts.depths, kind="stable")
    points, normals = contacts.points[order], contacts.normals[order]
    side = SETTINGS.place_share * float(np.ptp(points, axis=0).max())
    places = np.floor((points - points.min(axis=0)) / max(side, 1e-12))
    rows = np.column_stack([np.array(contacts.others)[order], places, np.rint(2.0 * normals)])
    first = np.sort(np.unique(rows, axis=0, return_index=True)[1])  # still by depth
    return contacts.select(np.sort(order[first[: SETTINGS.most_contacts]]).tolist())


def _placed(engine: Engine, body: Body, placement: Placement) -> RigidBody:
    """Read a body, as it is but for its place."""
    center, quaternion = placement
    return replace(engine.rigid_body(body.id, -1), center=np.array(center), rotation=rotation_of(quaternion))


def _moved_back(rigid: RigidBody, motion: Motion, dt: float) -> RigidBody:
    """Move a body back to before the step: the engine moves everything with the velocity that it ends a step with."""
    if rigid.mass == 0.0 or rigid.jointed:
        return rigid
    return replace(rigid, center=rigid.center - dt * np.array(motion[0]))
