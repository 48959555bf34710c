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
import numpy.typing as npt
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from ..impulse import Impulse
from .bodies import Body, cross
from .engine import Contacts, Engine, Motion, Placement, Rigid, Triple, rotation_of

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TOGETHER = 1e-4  # s: contacts that begin within it are one blow, shared among them
MANY, MOST = 32, 96  # contacts of a body from which on they are thinned out, and how many are left at most
SWEEPS = 10  # over the contacts of a blow, to find their friction
CHAIN = 0.01  # s: hits on one body within it act together, such as those of the corners of a flat landing
LOAD = 1e-3  # s: a sustained force F counts as the impulse F LOAD; about what a hit of hard things lasts
STILL: Motion = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


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


def gate(dt: float, gravity: Triple) -> float:
    """The closing speed, m/s, below which a contact is rest, rolling or leaning, and no hit."""
    x, y, z = gravity
    return max(0.1, 3.0 * dt * (x * x + y * y + z * z) ** 0.5)


def is_slow(motion: Motion, limit: float, reach: float) -> bool:
    """Whether no point within ``reach`` of a body's centre of mass is faster than about ``limit``."""
    (a, b, c), (d, e, f) = motion
    v, w = 0.25 * limit, 0.25 * limit / reach
    return -v < a < v and -v < b < v and -v < c < v and -w < d < w and -w < e < w and -w < f < w


def predict(
    engine: Engine,
    body: Body,
    contacts: Contacts,
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
    parts = {key: _rewound(engine.rigid(*key), engine.motion(key[0]), dt) for key in dict.fromkeys(others)}
    rigids = [own, *parts.values()]
    motions = [motion_of(body.id, -1), *(motion_of(*key) for key in parts)]
    sides = np.array([1 + list(parts).index(key) for key in others])  # whose contact it is
    blow = _Blow(rigids, motions, points, normals, sides)
    closing = blow.closing()
    since = np.clip(contacts.depths / np.maximum(closing, 1e-9), 0.0, dt)
    first = float(since[closing > 0.0].max(initial=0.0))
    # The engine takes a step with the velocity of its end, which is half a step's fall too much at its start.
    blow.fall(np.array(gravity) * (0.5 * dt - first))
    closing = blow.closing()
    least = gate(dt, gravity)
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
        for delay, i, speed, size in blow.sequence(gaps, least)
    ]


def _thinned(contacts: Contacts) -> Contacts:
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
    return contacts.some(np.sort(order[first[:MOST]]).tolist())


class _Blow:
    """Rigid bodies at the moment at which the first of n contacts between them closes, and what comes of it.

    rigids: the struck body, then what strikes it. sides: (n,), the index of the latter for each contact.
    """

    def __init__(
        self, rigids: list[Rigid], motions: list[Motion], points: FloatArray, normals: FloatArray, sides: IntArray
    ) -> None:
        self.rigids, self.normals, self.sides = rigids, normals, sides
        self.linear = np.array([motion[0] for motion in motions])
        self.angular = np.array([motion[1] for motion in motions])
        self.inverse = np.array([_inverse_inertia(rigid) for rigid in rigids])
        self.light = np.array([0.0 if rigid.mass == 0.0 else 1.0 / rigid.mass for rigid in rigids])
        self.own_arm = points - rigids[0].center
        self.arm = points - np.array([rigids[side].center for side in sides])
        product = [rigids[0].restitution * rigids[side].restitution for side in sides]
        self.restitution = np.array(product)
        self.friction = np.array([rigids[0].friction * rigids[side].friction for side in sides])

    def fall(self, change: FloatArray) -> None:
        """What hangs free changes its velocity."""
        for k, rigid in enumerate(self.rigids):
            if rigid.mass > 0.0 and not rigid.jointed:  # joints and their motors hold a link up
                self.linear[k] += change

    def approach(self) -> FloatArray:
        """(n, 3) velocity of what strikes, seen from the struck body, at each contact."""
        theirs = self.linear[self.sides] + cross(self.angular[self.sides], self.arm)
        return np.asarray(theirs - self.linear[0] - cross(self.angular[0], self.own_arm))

    def closing(self) -> FloatArray:
        """(n,) m/s along the normals."""
        return np.asarray((self.approach() * self.normals).sum(axis=1))

    def response(self, chosen: IntArray, ways: FloatArray) -> FloatArray:
        """(m, m) the change of the speed at contact chosen[i] along ways[i] by a unit impulse at k along ways[k]."""
        turn = cross(self.own_arm[chosen], ways)
        matrix = self.light[0] * ways @ ways.T + turn @ self.inverse[0] @ turn.T
        for side in set(self.sides[chosen].tolist()):
            mine = np.flatnonzero(self.sides[chosen] == side)
            turn = cross(self.arm[chosen[mine]], ways[mine])
            both = self.light[side] * ways[mine] @ ways[mine].T + turn @ self.inverse[side] @ turn.T
            matrix[np.ix_(mine, mine)] += both
        return np.asarray(matrix)

    def push(self, chosen: IntArray, impulses: FloatArray) -> None:
        """Impulses (m, 3) on the struck body at some contacts, and back on what strikes."""
        self.linear[0] += self.light[0] * impulses.sum(axis=0)
        self.angular[0] += self.inverse[0] @ cross(self.own_arm[chosen], impulses).sum(axis=0)
        for k, impulse in zip(chosen.tolist(), impulses, strict=True):
            side = self.sides[k]
            self.linear[side] -= self.light[side] * impulse
            self.angular[side] -= self.inverse[side] @ cross(self.arm[k], impulse)

    def wait(self, time: float) -> None:
        """Turn the arms on; the normals are those of what is struck against, and stay."""
        self.own_arm = Rotation.from_rotvec(time * self.angular[0]).apply(self.own_arm)
        for side in set(self.sides.tolist()):
            if self.light[side] > 0.0:
                mine = self.sides == side
                self.arm[mine] = Rotation.from_rotvec(time * self.angular[side]).apply(self.arm[mine])

    def sequence(self, gaps: FloatArray, least: float) -> list[tuple[float, int, float, float]]:
        """(time, contact, closing speed, impulse) of the blows, one after the other.

        Contacts touch when their gap is closed; those that do so together share a blow, which changes the speeds of
        all the others. Ends when nothing that is to come within CHAIN closes faster than ``least``.
        """
        gaps = gaps.copy()
        result: list[tuple[float, int, float, float]] = []
        now = 0.0
        for _ in range(2 * len(gaps) + 2):
            closing = self.closing()
            fast = closing > least
            if not fast.any():
                break
            time = float((gaps[fast] / closing[fast]).min())
            if now + time > CHAIN:
                break
            if time > 0.0:
                self.wait(time)
                now += time
                after = self.closing()
                gaps = np.maximum(gaps - 0.5 * (closing + after) * time, 0.0)
                gaps[fast & (gaps < 1e-9)] = 0.0
                closing = after
            touching = np.flatnonzero(gaps <= np.maximum(closing, 0.0) * TOGETHER)
            if not len(touching):
                continue
            normals = self.normals[touching]
            matrix = self.response(touching, normals)
            # Restitution after compression (Poisson), so that a hit and the floor beneath it share it.
            bounce = 1.0 + self.restitution[touching]
            sizes = _complementary(matrix, closing[touching]) * bounce
            if not sizes.any():
                break
            result += [
                (now, i, float(closing[i]), float(size))
                for i, size in zip(touching.tolist(), sizes, strict=True)
                if size > 1e-3 * sizes.max()
            ]
            self.push(touching, self._with_friction(touching, sizes))
            gaps[touching] = 0.0
        return result

    def _with_friction(self, touching: IntArray, sizes: FloatArray) -> FloatArray:
        """(m, 3) the impulses of a blow with normal parts ``sizes`` as a start: Coulomb friction up to where contacts
        stick, and what that changes of the normal parts, by projected Gauss-Seidel."""
        count = len(touching)
        normals = self.normals[touching]
        seed = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
        across = cross(normals, seed)
        across /= np.linalg.norm(across, axis=1)[:, None]
        ways = np.stack([normals, across, cross(normals, across)], axis=1).reshape(-1, 3)  # (3 m, 3)
        matrix = self.response(np.repeat(touching, 3), ways)
        target = (np.repeat(self.approach()[touching], 3, axis=0) * ways).sum(axis=1)
        target[::3] *= 1.0 + self.restitution[touching]
        found = np.zeros(3 * count)
        found[::3] = sizes
        limit = self.friction[touching]
        for _ in range(SWEEPS):
            for k in range(count):
                row = 3 * k
                for way in range(3):
                    here = row + way
                    found[here] += (target[here] - matrix[here] @ found) / matrix[here, here]
                found[row] = max(found[row], 0.0)
                slip = float(np.hypot(found[row + 1], found[row + 2]))
                if slip > limit[k] * found[row]:
                    found[row + 1 : row + 3] *= limit[k] * found[row] / slip
        return np.asarray((found[:, None] * ways).reshape(count, 3, 3).sum(axis=1))


def loads(
    engine: Engine,
    body: Body,
    contacts: Contacts,
    placement: Placement,
    gravity: Triple,
) -> list[ContactImpulse]:
    """What lasting forces on a body at rest count as: F LOAD each, without the share that its own weight takes.

    That share is what the contacts must carry to hold the body alone; a weight resting in a narrow wedge presses on its
    flanks with many times itself and still is no load.
    """
    pose = body.pose(placement, STILL)
    own = _own(engine, body, placement)
    if own.mass == 0.0:
        return []
    contacts = contacts.some(np.flatnonzero(contacts.forces > 0.0).tolist())
    some = _thinned(contacts)
    turn = cross(some.points - own.center, some.normals)
    response = some.normals @ some.normals.T / own.mass + turn @ _inverse_inertia(own) @ turn.T
    weight = _complementary(response, -(some.normals @ np.array(gravity)))  # N
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
            Impulse(places[i], pushes[i], float(force) * share * LOAD),
            not engine.is_static(contacts.others[i][0]),
            sustained=True,
        )
        for i, force in enumerate(contacts.forces)
        if force > 1e-3 * contacts.forces.max()
    ]


def _own(engine: Engine, body: Body, placement: Placement) -> Rigid:
    center, quaternion = placement
    return replace(engine.rigid(body.id, -1), center=np.array(center), rotation=rotation_of(quaternion))


def _inverse_inertia(part: Rigid) -> FloatArray:
    """(3, 3) world. An inertia of zero is the engine's way to say that a body does not turn about that axis."""
    turns = np.divide(1.0, part.moments, out=np.zeros(3), where=part.moments > 0.0)
    return np.asarray((part.rotation * turns) @ part.rotation.T)


def _rewound(part: Rigid, motion: Motion, dt: float) -> Rigid:
    """A part back where it was before the step: the engine moves with the velocity it ends a step with."""
    if part.mass == 0.0 or part.jointed:
        return part
    center = part.center - dt * np.array(motion[0])
    return replace(part, center=center)


def _complementary(matrix: FloatArray, rate: FloatArray) -> FloatArray:
    """j ≥ 0 with matrix @ j ≥ rate, and equal wherever j > 0; spread evenly where that leaves a choice."""
    n = len(rate)
    factor = np.linalg.cholesky(matrix + 1e-6 * np.trace(matrix) / n * np.eye(n))
    solution: FloatArray = nnls(factor.T, np.linalg.solve(factor, rate))[0]
    return solution
