"""Mass, momentum and energy of bodies as the engine has them.

``stage`` checks with them what a step conserves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pybullet as p

from ...common.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Mechanics:
    """What N bodies are and how they move.

    Attributes
    ----------
    mass : ndarray of float64, shape (N,)
        kg.
    position : ndarray of float64, shape (N, 3)
        Of the centres of mass, m.
    momentum : ndarray of float64, shape (N, 3)
        N·s.
    energy : ndarray of float64, shape (N,)
        Kinetic energy, J.
    spin : ndarray of float64, shape (N, 3)
        Angular momentum about the body's own centre of mass, N·m·s.
    angular_velocity : ndarray of float64, shape (N, 3)
        rad/s.
    """

    mass: FloatArray
    position: FloatArray
    momentum: FloatArray
    energy: FloatArray
    spin: FloatArray
    angular_velocity: FloatArray

    @property
    def finite(self) -> bool:
        """Whether no pose and no velocity is NaN or infinite."""
        arrays = (self.mass, self.position, self.momentum, self.energy, self.spin)
        return all(bool(np.isfinite(array).all()) for array in arrays)

    @property
    def rotation_energy(self) -> float:
        """Kinetic energy of the rotation about the bodies' own centres of mass, J."""
        return float((self.energy - 0.5 * (self.momentum**2).sum(axis=1) / self.mass).sum())

    def kinetic_energy(self, drift: FloatArray) -> float:
        """Sum up the kinetic energy.

        Parameters
        ----------
        drift : ndarray of float64, shape (3,)
            The velocity of whoever looks, m/s.

        Returns
        -------
        float
            J.
        """
        relative = self.momentum - self.mass[:, None] * drift
        rotation = self.energy - 0.5 * (self.momentum**2).sum(axis=1) / self.mass
        return float((rotation + 0.5 * (relative**2).sum(axis=1) / self.mass).sum())

    def angular_momentum(self, center: FloatArray, drift: FloatArray) -> FloatArray:
        """Sum up the angular momentum about a point that moves.

        Parameters
        ----------
        center : ndarray of float64, shape (3,)
            The point, m.
        drift : ndarray of float64, shape (3,)
            Its velocity, m/s.

        Returns
        -------
        ndarray of float64, shape (3,)
            N·m·s.
        """
        relative = self.momentum - self.mass[:, None] * drift
        total: FloatArray = (np.cross(self.position - center, relative) + self.spin).sum(axis=0)
        return total


def mechanics_of(client: int, bodies: list[int]) -> Mechanics:
    """Read bodies from the engine.

    Parameters
    ----------
    client : int
        A PyBullet client.
    bodies : list of int
        The ids of N bodies.

    Returns
    -------
    Mechanics
        Of these bodies, in the same order.
    """
    states = [
        (
            p.getDynamicsInfo(body, -1, physicsClientId=client),
            *p.getBasePositionAndOrientation(body, physicsClientId=client),
            *p.getBaseVelocity(body, physicsClientId=client),
        )
        for body in bodies
    ]
    mass = np.array([state[0][0] for state in states])
    moments = np.array([state[0][2] for state in states]).reshape(-1, 3)
    position = np.array([state[1] for state in states]).reshape(-1, 3)
    rotations = [p.getMatrixFromQuaternion(state[2]) for state in states]
    rotation = np.array(rotations).reshape(-1, 3, 3)  # columns: principal axes
    linear = np.array([state[3] for state in states]).reshape(-1, 3)
    angular = np.array([state[4] for state in states]).reshape(-1, 3)
    local = np.einsum("nji,nj->ni", rotation, angular)
    spin = np.einsum("nij,nj->ni", rotation, moments * local)
    energy = 0.5 * mass * (linear**2).sum(axis=1) + 0.5 * (moments * local**2).sum(axis=1)
    return Mechanics(mass, position, mass[:, None] * linear, energy, spin, angular)
