"""The swap: which bodies a blow reached, how they moved before it, and what cracks take from the motion after it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..pieces import Parts
from .bodies import Body, cross
from .engine import Engine, Motion, Placement, Triple, rotation_of

FloatArray = npt.NDArray[np.float64]
Touch = tuple[int, int, FloatArray, FloatArray, FloatArray]  # as Engine.pairs gives it

COOLING = 0.02  # s after a break within which cracks take their energy


@dataclass
class CrackEnergy:
    """J, the energy that opening the cracks of a break takes, and what the pieces had to give.

    demand: fracture energy times projected crack area. taken: from the pieces' motion relative to that of all of them
    as one rigid body, never more than is there; it grows in the first COOLING seconds after the break.
    """

    demand: float
    taken: float = 0.0


@dataclass(eq=False)
class Cooling:
    """A break whose cracks have not had all their energy yet."""

    energy: CrackEnergy
    pieces: list[Body]
    until: float  # s, of the world's time


def island(
    touches: Iterable[Touch], ties: Iterable[tuple[int, int]], seeds: Iterable[int], is_static: Callable[[int], bool]
) -> list[int]:
    """The bodies that contacts with force, or constraints (``ties``), join to the seeds; nothing static joins two."""
    beside: dict[int, set[int]] = {}
    for a, b in [*((touch[0], touch[1]) for touch in touches), *ties]:
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


def undone(
    engine: Engine, body: int, placement: Placement, touches: Iterable[Touch], dt: float, gravity: Triple
) -> Motion:
    """How a free body moved before the last step, from how it moves now and what its contacts did to it.

    placement: where it was then. Damping and outside forces of that one step are not undone.
    """
    linear, angular = (np.array(part) for part in engine.motion(body))
    own = engine.rigid(body, -1)
    push, turn = np.zeros(3), np.zeros(3)
    for a, b, force, on_a, on_b in touches:
        if body in (a, b):
            sign, place = (dt, on_a) if body == a else (-dt, on_b)
            push += sign * force
            turn += sign * cross(place - placement[0], force)
    rotation = rotation_of(placement[1])
    linear = linear - push / own.mass - dt * np.array(gravity)
    angular = angular - rotation @ np.divide(rotation.T @ turn, own.moments, out=np.zeros(3), where=own.moments > 0)
    return tuple(linear.tolist()), tuple(angular.tolist())


def hand_over(
    engine: Engine, tie: tuple[int, Sequence[Any]], parent: Body, pieces: Sequence[Body], parts: Sequence[Parts]
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
    engine.untie(constraint)
    return engine.tie(changed)


def cool(engine: Engine, pieces: Sequence[Body], demand: float) -> tuple[float, list[Motion]]:
    """Take up to ``demand`` J from the pieces' motion relative to their common rigid motion -> J taken, new motions.

    Common motion is that of one rigid body with the pieces' momentum and angular momentum. What is left over has
    neither, so that scaling it down changes no momentum, and its energy is all that the motion has besides.
    """
    placements = [engine.placement(piece.id) for piece in pieces]
    motions = [engine.motion(piece.id) for piece in pieces]
    mass = np.array([piece.mass for piece in pieces])
    linear = np.array([motion[0] for motion in motions])
    angular = np.array([motion[1] for motion in motions])
    place = np.array([center for center, _ in placements])
    axes = np.array([rotation_of(quaternion) for _, quaternion in placements])
    inertia = np.einsum("nij,nj,nkj->nik", axes, np.array([piece.moments for piece in pieces]), axes)
    arm = place - mass @ place / mass.sum()
    drift = mass @ linear / mass.sum()
    spin = (mass[:, None] * cross(arm, linear)).sum(axis=0) + np.einsum("nij,nj->i", inertia, angular)
    spread = (arm**2).sum(axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    whole = (mass[:, None, None] * spread + inertia).sum(axis=0)
    common = np.linalg.solve(whole, spin)
    rigid = drift + cross(common, arm)
    off, twist = linear - rigid, angular - common
    energy = 0.5 * float((mass * (off**2).sum(axis=1)).sum() + np.einsum("ni,nij,nj->", twist, inertia, twist))
    taken = min(demand, energy)
    # Less than rounding leaves of the motion as a whole is no energy to speak of.
    if taken <= 1e-12 * float((mass * (linear**2).sum(axis=1)).sum()) or taken == 0.0:
        return 0.0, motions
    left = np.sqrt(max(0.0, 1.0 - taken / energy))
    linear, angular = rigid + left * off, common + left * twist
    changed: list[Motion] = []
    for piece, v, w in zip(pieces, linear, angular, strict=True):
        engine.move(piece.id, v, w)
        changed.append((tuple(v.tolist()), tuple(w.tolist())))
    return taken, changed
