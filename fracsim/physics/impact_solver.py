"""TODO physics.impact_solver."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray, IntArray
from ..geometry.frames import cross, tangent_basis
from .states import Motion, RigidBody

SIMULTANEOUS = 1e-4  # s: contacts that begin within it are one impact, shared among them
SWEEPS = 10  # over the contacts of an impact, to find their friction
IMPACT_WINDOW = 0.01  # s: hits on one body within it act together, such as those of the corners of a flat landing


class ImpactSolver:
    """Rigid bodies at the moment at which the first of n contacts between them closes, and what comes of it.

    rigids: the struck body, then what strikes it. sides: (n,), the index of the latter for each contact.
    """

    def __init__(
        self, rigids: list[RigidBody], motions: list[Motion], points: FloatArray, normals: FloatArray, sides: IntArray
    ) -> None:
        self.rigids, self.normals, self.sides = rigids, normals, sides
        self.linear = np.array([motion[0] for motion in motions])
        self.angular = np.array([motion[1] for motion in motions])
        self.inverse = np.array([inverse_inertia(rigid) for rigid in rigids])
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
        """(time, contact, closing speed, impulse) of the impacts, one after the other.

        Contacts touch when their gap is closed; those that do so together share an impact, which changes the speeds of
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
            if now + time > IMPACT_WINDOW:
                break
            if time > 0.0:
                self.wait(time)
                now += time
                after = self.closing()
                gaps = np.maximum(gaps - 0.5 * (closing + after) * time, 0.0)
                gaps[fast & (gaps < 1e-9)] = 0.0
                closing = after
            touching = np.flatnonzero(gaps <= np.maximum(closing, 0.0) * SIMULTANEOUS)
            if not len(touching):
                continue
            normals = self.normals[touching]
            matrix = self.response(touching, normals)
            # Restitution after compression (Poisson), so that a hit and the floor beneath it share it.
            bounce = 1.0 + self.restitution[touching]
            sizes = complementary_impulses(matrix, closing[touching]) * bounce
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
        """(m, 3) the impulses of an impact with normal parts ``sizes`` as a start: Coulomb friction up to where contacts
        stick, and what that changes of the normal parts, by projected Gauss-Seidel."""
        count = len(touching)
        normals = self.normals[touching]
        ways = np.stack([normals, *tangent_basis(normals, "smallest")], axis=1).reshape(-1, 3)  # (3 m, 3)
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


def inverse_inertia(part: RigidBody) -> FloatArray:
    """(3, 3) world. An inertia of zero is the engine's way to say that a body does not turn about that axis."""
    turns = np.divide(1.0, part.moments, out=np.zeros(3), where=part.moments > 0.0)
    return np.asarray((part.rotation * turns) @ part.rotation.T)


def complementary_impulses(matrix: FloatArray, rate: FloatArray) -> FloatArray:
    """j ≥ 0 with matrix @ j ≥ rate, and equal wherever j > 0; spread evenly where that leaves a choice."""
    n = len(rate)
    factor = np.linalg.cholesky(matrix + 1e-6 * np.trace(matrix) / n * np.eye(n))
    solution: FloatArray = nnls(factor.T, np.linalg.solve(factor, rate))[0]
    return solution
