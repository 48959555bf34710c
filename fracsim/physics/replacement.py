"""The swap: which bodies an impact reached, how they moved before it, and what cracks take from the motion after it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..fracture.pieces import ConvexParts
from .bodies import Body
from .bullet import Engine
from .rotations import cross, rotation_of
from .states import ContactForces, Motion, Placement, Triple


def contact_island(pairs: Iterable[Sequence[int]], seeds: Iterable[int], is_static: Callable[[int], bool]) -> list[int]:
    """The bodies that pairs of them, by contacts with force or constraints, join to the seeds; nothing static joins
    two."""
    beside: dict[int, set[int]] = {}
    for a, b in pairs:
        beside.setdefault(a, set()).add(b)
        beside.setdefault(b, set()).add(a)
    found = list(dict.fromkeys(seeds))
    known = set(found)
    for body in found:  # grows while it runs
        for other in sorted(beside.get(body, set()) - known):
            if not is_static(other):
                known.add(other)
                found.append(other)
    return found


def velocity_before_step(
    engine: Engine, body: int, placement: Placement, touches: ContactForces, dt: float, gravity: Triple
) -> Motion:
    """How a free body moved before the last step, from how it moves now and what its contacts did to it.

    placement: where it was then. Damping and outside forces of that one step are not undone.
    """
    linear, angular = (np.array(part) for part in engine.motion(body))
    own = engine.rigid_body(body, -1)
    push, turn = np.zeros(3), np.zeros(3)
    for side, places in enumerate((touches.on_first, touches.on_second)):
        mine = touches.bodies[:, side] == body
        forces = (dt, -dt)[side] * touches.forces[mine]
        push += forces.sum(axis=0)
        turn += cross(places[mine] - placement[0], forces).sum(axis=0)
    rotation = rotation_of(placement[1])
    linear = linear - push / own.mass - dt * np.array(gravity)
    angular = angular - rotation @ np.divide(rotation.T @ turn, own.moments, out=np.zeros(3), where=own.moments > 0)
    if np.linalg.norm(angular) * dt > 1.0:  # no step resolves that, and what the engine makes of it tells nothing
        angular = np.zeros(3)
    return tuple(linear.tolist()), tuple(angular.tolist())


def transfer_constraint(
    engine: Engine, tie: tuple[int, Sequence[Any]], parent: Body, pieces: Sequence[Body], parts: Sequence[ConvexParts]
) -> int:
    """Give a constraint on a body to the piece that has the convex part nearest to where it holds -> its new id."""
    constraint, info = tie
    side = 0 if info[0] == parent.id else 1
    pivot = parent.center + parent.axes @ np.array(info[6 + side])  # asset frame
    gaps = [
        min(float(((points * some.scale + some.offset - pivot) ** 2).sum(axis=1).min()) for points in some.points)
        for some in parts
    ]
    piece = pieces[int(np.argmin(gaps))]
    turn = Rotation.from_matrix(piece.axes.T @ parent.axes) * Rotation.from_quat(info[8 + side])
    changed = list(info)
    changed[2 * side] = piece.id
    changed[6 + side] = (piece.axes.T @ (pivot - piece.center)).tolist()
    changed[8 + side] = turn.as_quat().tolist()
    engine.remove_constraint(constraint)
    return engine.create_constraint(changed)
