"""How the bodies of a scene are thrown at one another: random directions, and meeting after a number of steps.

``scenes`` uses it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pybullet as p

from ...common.arrays import FloatArray
from .cells import APPROACH
from .stage import Stage

ADVANCES = 60  # at most, to bring a thrown body into touch


def aim(
    stage: Stage,
    mover: int,
    obstacles: Iterable[int],
    target: FloatArray,
    direction: FloatArray,
    reach: float,
    phase: float,
    delay: int = APPROACH,
    speed: float | None = None,
) -> None:
    """Throw a body so that it touches after a number of steps.

    It is moved along its path until it touches, and put back by the distance that it will fly.

    Parameters
    ----------
    stage : Stage
        The scene.
    mover : int
        The body that is thrown.
    obstacles : iterable of int
        What it may touch first.
    target : ndarray of float64, shape (3,)
        A point that it is thrown at, m.
    direction : ndarray of float64, shape (3,)
        Unit vector along its path.
    reach : float
        Distance from the target at which the search begins, m.
    phase : float
        How much of its last step lies beneath the surface, 0 to 1, as it may be anything in a simulation; no more
        than half its radius, so that what is fast does not simply pass.
    delay : int
        After how many steps it has touched.
    speed : float, optional
        m/s; by default the cell's.
    """
    speed = stage.cell.speed if speed is None else speed
    _, orientation = p.getBasePositionAndOrientation(mover, physicsClientId=stage.client)
    travelled, gap, obstacles = 0.0, np.inf, list(obstacles)
    for _ in range(ADVANCES):
        p.resetBasePositionAndOrientation(
            mover, (target + (travelled - reach) * direction).tolist(), orientation, physicsClientId=stage.client
        )
        gap = min(_gap(stage, mover, obstacle, 4.0 * reach + stage.cell.size) for obstacle in obstacles)
        if gap < 1e-4 * stage.cell.size or travelled > 2.0 * reach + stage.cell.size:
            break
        travelled += gap
    step = speed * stage.cell.time_step
    low, high = p.getAABB(mover, -1, physicsClientId=stage.client)
    depth = phase * min(step, 0.25 * float(min(np.subtract(high, low))))
    place = target + (travelled - reach + depth - delay * step) * direction
    p.resetBasePositionAndOrientation(mover, place.tolist(), orientation, physicsClientId=stage.client)
    p.resetBaseVelocity(mover, (speed * direction).tolist(), physicsClientId=stage.client)


def _gap(stage: Stage, first: int, second: int, reach: float) -> float:
    """Find the distance between two bodies, m; no more than ``reach``."""
    points = p.getClosestPoints(first, second, reach, physicsClientId=stage.client)
    return min((point[8] for point in points), default=reach)


def random_direction(rng: np.random.Generator) -> FloatArray:
    """Draw a direction, all equally likely.

    Parameters
    ----------
    rng : Generator
        Random numbers.

    Returns
    -------
    ndarray of float64, shape (3,)
        A unit vector.
    """
    vector: FloatArray = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def random_orientation(rng: np.random.Generator) -> FloatArray:
    """Draw an orientation, all equally likely.

    Parameters
    ----------
    rng : Generator
        Random numbers.

    Returns
    -------
    ndarray of float64, shape (4,)
        A unit quaternion x, y, z, w.
    """
    quaternion: FloatArray = rng.normal(size=4)
    return quaternion / np.linalg.norm(quaternion)
