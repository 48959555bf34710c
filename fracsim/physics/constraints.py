"""Constraints in a PyBullet client: listed, made and removed; replacement carries them over from a body to a piece."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import pybullet as p

from .states import ConstraintInfo


class Constraints:
    """The constraints of one client.

    Parameters
    ----------
    client : int
        PyBullet's id of the client.
    """

    def __init__(self, client: int) -> None:
        self._client = client

    def all(self) -> list[tuple[int, ConstraintInfo]]:
        """List the constraints.

        Returns
        -------
        list of (int, ConstraintInfo)
            Id and description of each.
        """
        client = self._client
        ids = [
            p.getConstraintUniqueId(k, physicsClientId=client)
            for k in range(p.getNumConstraints(physicsClientId=client))
        ]
        return [(key, ConstraintInfo(*p.getConstraintInfo(key, physicsClientId=client)[:11])) for key in ids]

    def of(self, body: int) -> list[tuple[int, ConstraintInfo]]:
        """List the constraints on a body.

        Parameters
        ----------
        body : int
            Id of the body.

        Returns
        -------
        list of (int, ConstraintInfo)
            Id and description of each.
        """
        return [(key, info) for key, info in self.all() if body in (info.parent, info.child)]

    def pairs(self) -> list[tuple[int, int]]:
        """List the pairs of bodies that constraints join.

        Returns
        -------
        list of (int, int)
            Their ids; constraints to the world are left out.
        """
        if not p.getNumConstraints(physicsClientId=self._client):
            return []
        return [(info.parent, info.child) for _, info in self.all() if info.child >= 0]

    def joined_to(self, bodies: Collection[int]) -> list[int]:
        """Find the other bodies that constraints join to some of these.

        Parameters
        ----------
        bodies : collection of int
            Their ids.

        Returns
        -------
        list of int
            Ids of the others, sorted.
        """
        pairs = self.pairs()
        both_ways = [*pairs, *((child, parent) for parent, child in pairs)]
        return sorted({other for body, other in both_ways if body in bodies and other not in bodies})

    def create(self, info: Sequence[object]) -> int:
        """Make a constraint.

        Parameters
        ----------
        info : ConstraintInfo
            Its description, or a sequence of the same values.

        Returns
        -------
        int
            Its id.
        """
        constraint: int = p.createConstraint(*info[:10], physicsClientId=self._client)
        p.changeConstraint(constraint, maxForce=info[10], physicsClientId=self._client)
        return constraint

    def remove(self, constraint: int) -> None:
        """Remove a constraint.

        Parameters
        ----------
        constraint : int
            Its id.
        """
        p.removeConstraint(constraint, physicsClientId=self._client)
