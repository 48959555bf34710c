"""Joints of articulated bodies in a PyBullet client, such as robots'; only `Engine` and `Activity` ask for them."""

from __future__ import annotations

import pybullet as p

from .states import BodyState, JointRates


class Joints:
    """The joints of the bodies of one client, which each body is asked for once.

    Parameters
    ----------
    client : int
        PyBullet's id of the client.
    """

    def __init__(self, client: int) -> None:
        self._client = client
        self._movable: dict[int, tuple[int, ...]] = {}

    def forget(self) -> None:
        """Ask every body anew, since ids of removed bodies are handed out again."""
        self._movable.clear()

    def movable(self, body: int) -> tuple[int, ...]:
        """List the joints of a body that are not fixed.

        Parameters
        ----------
        body : int
            Id of the body.

        Returns
        -------
        tuple of int
            Their indices.
        """
        joints = self._movable.get(body)
        if joints is None:
            joints = tuple(
                joint
                for joint in range(p.getNumJoints(body, physicsClientId=self._client))
                if p.getJointInfo(body, joint, physicsClientId=self._client)[2] != p.JOINT_FIXED
            )
            self._movable[body] = joints
        return joints

    def rates(self, body: int) -> JointRates:
        """Read the velocities of the joints that are not fixed.

        Parameters
        ----------
        body : int
            Id of the body.

        Returns
        -------
        tuple of tuple of float
            rad/s or m/s, one for each joint; empty where there is none.
        """
        joints = self.movable(body)
        if not joints:
            return ()
        states = p.getJointStatesMultiDof(body, joints, physicsClientId=self._client)
        return tuple(state[1] for state in states)

    def before(self, body: int, rates: JointRates | None, dt: float) -> tuple[tuple[int, ...], JointRates, JointRates]:
        """Compute where the joints were before the last step.

        Parameters
        ----------
        body : int
            Id of the body.
        rates : tuple of tuple of float, optional
            How they moved then; None takes what they do now.
        dt : float
            Length of the step, s.

        Returns
        -------
        joints : tuple of int
            Indices of those that are not fixed.
        angles : tuple of tuple of float
            Position of each: rad or m. A ball joint's is its quaternion after the step, which is a step's turn off.
        rates : tuple of tuple of float
            Velocity of each, rad/s or m/s.
        """
        joints = self.movable(body)
        if not joints:
            return (), (), ()
        states = p.getJointStatesMultiDof(body, joints, physicsClientId=self._client)
        now = tuple(state[1] for state in states)
        angles = tuple((state[0][0] - dt * state[1][0],) if len(state[0]) == 1 else tuple(state[0]) for state in states)
        return joints, angles, now if rates is None else tuple(rates)

    def restore(self, state: BodyState) -> None:
        """Put the joints of a body back.

        Parameters
        ----------
        state : BodyState
            Where, and how they move there.
        """
        for joint, angle, rate in zip(state.joints, state.angles, state.rates, strict=True):
            # One joint at a time: the call for several at once has crashed the engine.
            if len(angle) == 1:
                p.resetJointState(state.body, joint, angle[0], rate[0], physicsClientId=self._client)
            elif len(angle) == 4:
                p.resetJointStateMultiDof(state.body, joint, angle, rate, physicsClientId=self._client)
