"""From contacts to impulses: what a hit will have delivered, predicted from the motion before it.

The engine spreads a hit over several steps, and the force of the first is no measure of it. The closing speed
before the step is: the impulses are the smallest j ≥ 0 that stop every contact from closing,
A j ≥ closing, with A from the inverse masses and inertias of both bodies, times (1 + restitution).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from ..impulse import Impulse
from .bodies import Body
from .engine import Engine, Motion, Placement, Rigid

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ContactImpulse:
    """One hit on a breakable body.

    body, other, other_link: PyBullet ids; link -1 is the base.
    point, direction: (3,) world, where it acts and the way the body is pushed.
    closing_speed: m/s, before the hit.
    impulse: the same in the asset's frame, as the model sees it. moving: the other body is not static.
    """

    body: int
    other: int
    other_link: int
    point: FloatArray
    direction: FloatArray
    closing_speed: float
    impulse: Impulse
    moving: bool


def gate(dt: float, gravity: FloatArray) -> float:
    """The closing speed, m/s, below which a contact is rest, rolling or leaning, and no hit."""
    return max(0.1, 3.0 * dt * float(np.linalg.norm(gravity)))


def anything_moves(motions: Iterable[Motion], gate: float) -> bool:
    """Whether some body is fast enough for a contact to pass the gate."""
    v, w = 0.25 * gate, 0.1 * gate  # two still bodies close at half the gate, plus what their spin adds
    return any(
        a > v or a < -v or b > v or b < -v or c > v or c < -v
        or d > w or d < -w or e > w or e < -w or f > w or f < -w
        for (a, b, c), (d, e, f) in motions
    )  # fmt: skip


def predict(
    engine: Engine,
    body: Body,
    placement: Placement,
    motions: dict[tuple[int, int], Motion],
    dt: float,
    gravity: FloatArray,
) -> list[ContactImpulse]:
    """The hits that a breakable body took in the last step, strongest first; they act together.

    placement, motions: where the body was, and how everything moved, before the step.
    """
    contacts = engine.contacts(body.id)
    if not contacts:
        return []
    before = body.pose(placement, motions[body.id, -1])
    points = np.array([c.point for c in contacts])  # (n, 3)
    normals = np.array([c.normal for c in contacts])  # (n, 3)
    keys = [(c.other, c.link) for c in contacts]

    own = Rigid(
        body.mass,
        body.moments,
        before.position + before.rotation @ body.center,
        before.rotation @ body.axes,
        engine.surface(body.id, 0.0, 0.0).restitution,
        False,
    )
    fall = gravity * dt
    closing = -_speeds(own, motions[body.id, -1], fall, points, normals)  # (n,)
    parts = {key: _rewound(engine.rigid(*key), engine.motion(key[0]), dt) for key in set(keys)}
    response = _response(own, points, normals)  # (n, 6)
    matrix = response @ response.T
    for key, part in parts.items():
        mine = np.array([k == key for k in keys])
        motion = motions.get(key, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        closing[mine] += _speeds(part, motion, fall, points[mine], normals[mine])
        if part.mass > 0.0:
            response = _response(part, points[mine], normals[mine])
            matrix[np.ix_(mine, mine)] += response @ response.T
    if closing.max() <= gate(dt, gravity):
        return []

    # Restitution after compression (Poisson), so that a hit and the floor beneath it share it.
    restitution = np.array([own.restitution * parts[key].restitution for key in keys])
    sizes = _complementary(matrix, closing) * (1.0 + restitution)
    places = (points - before.position) @ before.rotation  # (n, 3) asset frame
    pushes = normals @ before.rotation
    hits = [
        ContactImpulse(
            body.id,
            contact.other,
            contact.link,
            points[i],
            normals[i],
            float(closing[i]),
            Impulse(places[i], pushes[i], float(sizes[i])),
            parts[keys[i]].mass > 0.0,
        )
        for i, contact in enumerate(contacts)
        if sizes[i] > 1e-3 * sizes.max()
    ]
    return sorted(hits, key=lambda hit: -hit.impulse.magnitude)


def _speeds(part: Rigid, motion: Motion, fall: FloatArray, points: FloatArray, normals: FloatArray) -> FloatArray:
    """(n,) speed of a part's points along the normals, at the end of a step of free fall."""
    linear = np.array(motion[0])
    if part.mass > 0.0 and not part.jointed:  # joints and their motors hold a link up
        linear = linear + fall
    speeds: FloatArray = ((linear + np.cross(motion[1], points - part.center)) * normals).sum(axis=1)
    return speeds


def _response(part: Rigid, points: FloatArray, normals: FloatArray) -> FloatArray:
    """(n, 6) rows g with g_i · g_k the speed at contact i from a unit impulse at contact k."""
    spin = np.cross(points - part.center, normals) @ part.rotation
    # An inertia of zero is the engine's way to say that a body does not turn about that axis.
    turns = np.divide(1.0, np.sqrt(part.moments), out=np.zeros(3), where=part.moments > 0.0)
    return np.hstack([normals / np.sqrt(part.mass), spin * turns])


def _rewound(part: Rigid, motion: Motion, dt: float) -> Rigid:
    """A part back where it was before the step: the engine moves with the velocity it ends a step with."""
    if part.mass == 0.0 or part.jointed:
        return part
    center = part.center - dt * np.array(motion[0])
    return Rigid(part.mass, part.moments, center, part.rotation, part.restitution, part.jointed)


def _complementary(matrix: FloatArray, rate: FloatArray) -> FloatArray:
    """j ≥ 0 with matrix @ j ≥ rate, and equal wherever j > 0; spread evenly where that leaves a choice."""
    n = len(rate)
    factor = np.linalg.cholesky(matrix + 1e-6 * np.trace(matrix) / n * np.eye(n))
    solution: FloatArray = nnls(factor.T, np.linalg.solve(factor, rate))[0]
    return solution
