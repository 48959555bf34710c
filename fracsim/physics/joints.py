"""Joints of articulated bodies in a PyBullet client, such as robots'; only `Engine` and `Activity` ask for them."""

from __future__ import annotations

import pybullet as p

from .states import JointRates


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
