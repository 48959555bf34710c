"""Whose simulation it is: the id of a physics client, in whichever form somebody has it. `Engine` asks once."""

from __future__ import annotations

import numpy as np

from ..common.errors import PhysicsError


def client_id(client: object) -> int:
    """Find the integer that a physics client goes by.

    Parameters
    ----------
    client : int or BulletClient
        What pybullet.connect returned, or a ``pybullet_utils.bullet_client.BulletClient``.

    Returns
    -------
    int
        PyBullet's id of the client.

    Raises
    ------
    PhysicsError
        Where it is neither.
    """
    if not isinstance(client, (int, np.integer)):
        from pybullet_utils.bullet_client import BulletClient

        # It offers no public way to its id.
        client = client._client if isinstance(client, BulletClient) else client
    if isinstance(client, bool) or not isinstance(client, (int, np.integer)):
        raise PhysicsError(f"a physics client is the integer that pybullet.connect returns, got {client!r}")
    return int(client)
