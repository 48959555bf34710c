"""Impacts between rigid bodies, one after the other: the impulses that stop contacts from closing, with friction.

`predict_impacts` builds one solver for each body that was struck.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray, IntArray
from ..geometry.frames import cross, tangent_basis
from .states import Motion, RigidBody


@dataclass(frozen=True)
class ContactSettings:
    """What counts as an impact, and how finely impacts are told apart.

    Attributes
    ----------
    least_impact_speed : float
        Closing speed below which a contact is no impact, m/s: a fall from half a millimetre.
    least_steps_of_fall : float
        The same in steps of free fall, since contacts at rest close by about one step of it in every step.
    impact_window : float
        Time within which impacts on a body act together, s: those of the corners of a flat landing come within it.
    simultaneous_window : float
        Time within which contacts that begin share one impact, s: about what sound takes through 0.3 m of ceramic.
    friction_sweeps : int
        Sweeps over the contacts of an impact to find their friction; more change nothing that a model sees.
    negligible_share : float
        Share of the strongest impulse of an impact below which one is dropped.
    many_contacts : int
        Contacts of a body from which they are thinned out.
    most_contacts : int
        Contacts that are left then, at most.
    place_share : float
        Contacts closer than this share of the extent of all are in one place then.
    """

    least_impact_speed: float = 0.1
    least_steps_of_fall: float = 3.0
    impact_window: float = 0.01
    simultaneous_window: float = 1e-4
    friction_sweeps: int = 10
    negligible_share: float = 1e-3
    many_contacts: int = 32
    most_contacts: int = 96
    place_share: float = 0.05


SETTINGS = ContactSettings()
IMPACT_WINDOW = SETTINGS.impact_window  # s


class ImpactSolver:
    """Rigid bodies at the moment in which the first of n contacts between them closes, and what comes of it.

    The first body is the struck one; the others strike it. Impulses change the velocities that the solver holds.

    Parameters
    ----------
    rigids : list of RigidBody, length m
        The struck body, then what strikes it.
    motions : list of Motion, length m
        How they move, m/s and rad/s.
    points : ndarray of float64, shape (n, 3)
        Points of the contacts, m, world frame.
    normals : ndarray of float64, shape (n, 3)
        Unit vectors the way the struck body is pushed.
    sides : ndarray of int64, shape (n,)
        Index in rigids of what strikes at each contact.
    """

    def __init__(
        self, rigids: list[RigidBody], motions: list[Motion], points: FloatArray, normals: FloatArray, sides: IntArray
    ) -> None:
        self._rigids, self._normals, self._sides = rigids, normals, sides
        self._linear = np.array([motion[0] for motion in motions])  # (m, 3)
        self._angular = np.array([motion[1] for motion in motions])  # (m, 3)
        self._inverse_inertia = np.array([inverse_inertia(rigid) for rigid in rigids])  # (m, 3, 3)
        self._inverse_mass = np.array([0.0 if rigid.mass == 0.0 else 1.0 / rigid.mass for rigid in rigids])  # (m,)
        self._struck_arm = points - rigids[0].center  # (n, 3)
        self._striker_arm = points - np.array([rigids[side].center for side in sides])  # (n, 3)
        # The engine multiplies the coefficients of two bodies.
        self._restitution = np.array([rigids[0].restitution * rigids[side].restitution for side in sides])
        self._friction = np.array([rigids[0].friction * rigids[side].friction for side in sides])

    @property
    def restitution(self) -> FloatArray:
        """(n,) coefficients of the contacts."""
        return self._restitution

    def accelerate(self, change: FloatArray) -> None:
        """Change the velocity of every body that is free to move.

        Parameters
        ----------
        change : ndarray of float64, shape (3,)
            m/s. Static bodies, and links, which joints and their motors hold up, keep theirs.
        """
        for k, rigid in enumerate(self._rigids):
            if rigid.mass > 0.0 and not rigid.jointed:
                self._linear[k] += change

    def closing(self) -> FloatArray:
        """Compute how fast each contact closes.

        Returns
        -------
        ndarray of float64, shape (n,)
            Along its normal, m/s.
        """
        return np.asarray((self._approach() * self._normals).sum(axis=1))

    def sequence(self, gaps: FloatArray, threshold: float) -> list[tuple[float, int, float, float]]:
        """Simulate the impacts, one after the other.

        Contacts touch when their gap is closed. Those that do so together share an impact, which changes the speeds of
        all others. It ends when nothing that closes faster than the threshold is to come within `IMPACT_WINDOW`.

        Parameters
        ----------
        gaps : ndarray of float64, shape (n,)
            Gap of each contact, m.
        threshold : float
            Closing speed below which a contact is no impact, m/s.

        Returns
        -------
        list of (float, int, float, float)
            Time, s, index of the contact, closing speed, m/s, and impulse, N·s, of each.

        Notes
        -----
        Restitution acts after compression (Poisson's hypothesis), so that an impact and the floor beneath the body
        share it.
        """
        gaps = gaps.copy()
        result: list[tuple[float, int, float, float]] = []
        now = 0.0
        for _ in range(2 * len(gaps) + 2):
            closing = self.closing()
            fast = closing > threshold
            if not fast.any():
                break
            time = float((gaps[fast] / closing[fast]).min())
            if now + time > IMPACT_WINDOW:
                break
            if time > 0.0:
                self._wait(time)
                now += time
                after = self.closing()
                gaps = np.maximum(gaps - 0.5 * (closing + after) * time, 0.0)
                gaps[fast & (gaps < 1e-9)] = 0.0
                closing = after
            touching = np.flatnonzero(gaps <= np.maximum(closing, 0.0) * SETTINGS.simultaneous_window)
            if not len(touching):
                continue
            response = self._response(touching, self._normals[touching])
            sizes = complementary_impulses(response, closing[touching]) * (1.0 + self._restitution[touching])
            if not sizes.any():
                break
            result += [
                (now, i, float(closing[i]), float(size))
                for i, size in zip(touching.tolist(), sizes, strict=True)
                if size > SETTINGS.negligible_share * sizes.max()
            ]
            self._push(touching, self._with_friction(touching, sizes))
            gaps[touching] = 0.0
        return result

    def _approach(self) -> FloatArray:
        """Compute the velocity of what strikes, seen from the struck body, at each contact, shape (n, 3)."""
        theirs = self._linear[self._sides] + cross(self._angular[self._sides], self._striker_arm)
        return np.asarray(theirs - self._linear[0] - cross(self._angular[0], self._struck_arm))

    def _response(self, chosen: IntArray, directions: FloatArray) -> FloatArray:
        """Compute the change of the speed at contact chosen[i] along directions[i] by a unit impulse at k along k's.

        Shape (c, c) for c chosen contacts.
        """
        turn = cross(self._struck_arm[chosen], directions)
        matrix = self._inverse_mass[0] * directions @ directions.T + turn @ self._inverse_inertia[0] @ turn.T
        for side in set(self._sides[chosen].tolist()):
            its = np.flatnonzero(self._sides[chosen] == side)
            turn = cross(self._striker_arm[chosen[its]], directions[its])
            both = self._inverse_mass[side] * directions[its] @ directions[its].T
            matrix[np.ix_(its, its)] += both + turn @ self._inverse_inertia[side] @ turn.T
        return np.asarray(matrix)

    def _push(self, chosen: IntArray, impulses: FloatArray) -> None:
        """Apply impulses (c, 3) to the struck body at some contacts, and back to what strikes."""
        self._linear[0] += self._inverse_mass[0] * impulses.sum(axis=0)
        self._angular[0] += self._inverse_inertia[0] @ cross(self._struck_arm[chosen], impulses).sum(axis=0)
        for k, impulse in zip(chosen.tolist(), impulses, strict=True):
            side = self._sides[k]
            self._linear[side] -= self._inverse_mass[side] * impulse
            self._angular[side] -= self._inverse_inertia[side] @ cross(self._striker_arm[k], impulse)

    def _wait(self, time: float) -> None:
        """Turn the arms on; the normals are those of what is struck against, and stay."""
        self._struck_arm = Rotation.from_rotvec(time * self._angular[0]).apply(self._struck_arm)
        for side in set(self._sides.tolist()):
            if self._inverse_mass[side] > 0.0:
                its = self._sides == side
                turn = Rotation.from_rotvec(time * self._angular[side])
                self._striker_arm[its] = turn.apply(self._striker_arm[its])

    def _with_friction(self, touching: IntArray, sizes: FloatArray) -> FloatArray:
        """Compute the impulses (c, 3) of an impact, beginning with their normal parts ``sizes``.

        Coulomb friction up to where contacts stick, and what that changes of the normal parts, by projected
        Gauss-Seidel.
        """
        count = len(touching)
        normals = self._normals[touching]
        across, along = tangent_basis(normals, "smallest")
        directions = np.stack([normals, across, along], axis=1).reshape(-1, 3)  # (3 c, 3)
        matrix = self._response(np.repeat(touching, 3), directions)
        target = (np.repeat(self._approach()[touching], 3, axis=0) * directions).sum(axis=1)
        target[::3] *= 1.0 + self._restitution[touching]
        impulse = np.zeros(3 * count)
        impulse[::3] = sizes
        limit = self._friction[touching]
        for _ in range(SETTINGS.friction_sweeps):
            for k in range(count):
                row = 3 * k
                for entry in range(row, row + 3):
                    impulse[entry] += (target[entry] - matrix[entry] @ impulse) / matrix[entry, entry]
                impulse[row] = max(impulse[row], 0.0)
                slip = float(np.hypot(impulse[row + 1], impulse[row + 2]))
                if slip > limit[k] * impulse[row]:
                    impulse[row + 1 : row + 3] *= limit[k] * impulse[row] / slip
        return np.asarray((impulse[:, None] * directions).reshape(count, 3, 3).sum(axis=1))


def inverse_inertia(rigid: RigidBody) -> FloatArray:
    """Compute the inverse of a body's inertia.

    Parameters
    ----------
    rigid : RigidBody
        The body.

    Returns
    -------
    ndarray of float64, shape (3, 3)
        1/(kg·m²), world frame; zero about an axis with no moment, which is how the engine says that a body does not
        turn about it.
    """
    inverse = np.divide(1.0, rigid.moments, out=np.zeros(3), where=rigid.moments > 0.0)
    return np.asarray((rigid.rotation * inverse) @ rigid.rotation.T)


def complementary_impulses(response: FloatArray, rate: FloatArray) -> FloatArray:
    """Solve the linear complementarity problem of contacts: j ≥ 0, A j ≥ b, and equal wherever j > 0.

    Parameters
    ----------
    response : ndarray of float64, shape (n, n)
        A, symmetric and positive semidefinite.
    rate : ndarray of float64, shape (n,)
        b.

    Returns
    -------
    ndarray of float64, shape (n,)
        j; spread evenly where contacts share it in a way that A leaves open.

    Notes
    -----
    With A = L Lᵀ, j minimises |Lᵀ j - L⁻¹ b| over j ≥ 0, whose optimality conditions are these. A millionth of the
    mean of the diagonal is added to it, which makes A definite and the solution even.

    Examples
    --------
    >>> import numpy as np
    >>> complementary_impulses(np.ones((2, 2)), np.ones(2)).round(3).tolist()
    [0.5, 0.5]
    """
    n = len(rate)
    factor = np.linalg.cholesky(response + 1e-6 * np.trace(response) / n * np.eye(n))
    solution: FloatArray = nnls(factor.T, np.linalg.solve(factor, rate))[0]
    return solution
