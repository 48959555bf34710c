"""Whose simulation it is: the id of a physics client, in whichever form somebody has it. `Engine` asks once."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from ..common.errors import PhysicsError


@runtime_checkable
class _ClientWrapper(Protocol):
    """An object that stands for a client, such as ``pybullet_utils.bullet_client.BulletClient``."""

    _client: int


def client_id(client: object) -> int:
    """Find the integer that a physics client goes by.

    Parameters
    ----------
    client : int or BulletClient
        What pybullet.connect returned, or a ``pybullet_utils.bullet_client.BulletClient`` or another wrapper that
        keeps the id as ``_client``, as that one does.

    Returns
    -------
    int
        PyBullet's id of the client.

    Raises
    ------
    PhysicsError
        Where it is neither.
    """
    # BulletClient and its like offer no public way to the id that they wrap.
    client = client._client if isinstance(client, _ClientWrapper) else client
    if isinstance(client, bool) or not isinstance(client, (int, np.integer)):
        raise PhysicsError(f"a physics client is the integer that pybullet.connect returns, got {client!r}")
    return int(client)
