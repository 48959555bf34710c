"""How impacts are drawn over a surface: single and scattered contacts, landings, rings and grips. Sampling uses it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import IntArray
from ..geometry.sampling import CONE, SurfacePoints, cone
from ..simulators.base import Impacts
from ..solids.surface import Surface

CONTACTS = 6  # at most, that act together in a sample
SEVERAL = 0.25  # share of samples with 2 to CONTACTS contacts, in equal parts of every kind but the first
KINDS = ("single", "scattered", "landing", "ring", "grip")
POOL = 2048  # points from which the contacts of landings, rings and grips are chosen
TILT = np.deg2rad(10.0)  # half angle within which contacts of one body on another push the same way
RING = (0.05, 0.25)  # radii, in units of the largest extent
AWAY = -0.2  # cosine between a normal and a direction below which a point faces that way enough to be touched
OPPOSITE = 0.5  # cosine between the inward normal of one finger and the outward normal under the other, at least
OUT_OF_REACH = 10.0  # added to a distance, in units of the largest extent, so that no such point is chosen
DEPTH_WEIGHT = 0.2  # of the depth of a grip against how far it is off the line through the body
NEAREST = 64  # points of the pool among which a contact of a ring is chosen


def draw_impacts(surface: Surface, count: int, rng: np.random.Generator) -> tuple[Impacts, IntArray]:
    """Draw impacts whose severities add up to 1.

    Single and scattered contacts are uniform over the area, in a cone about the inward normal. The other kinds choose
    among POOL points of the surface, one pool for all impacts. A landing is on a flat floor: the lowest points along a
    random upward direction. A ring is the end of a tube: points around a circle. The contacts of both push one way,
    within TILT. A grip is two opposite points pushed towards each other, within TILT and equally hard.

    Parameters
    ----------
    surface : Surface
        The body's.
    count : int
        Impacts, N.
    rng : Generator
        The source of chance.

    Returns
    -------
    impacts : Impacts
        Of up to CONTACTS contacts each.
    kind : ndarray of int64, shape (N,)
        Index into KINDS.
    """
    points = SurfacePoints(surface.vertices, surface.faces)
    kind = np.where(rng.random(count) < SEVERAL, rng.integers(1, len(KINDS), count), 0)
    contacts = np.where(kind == 0, 1, rng.integers(2, CONTACTS + 1, count))
    contacts[kind == KINDS.index("ring")] = rng.integers(3, CONTACTS + 1, int((kind == KINDS.index("ring")).sum()))
    contacts[kind == KINDS.index("grip")] = 2
    face, bary = points.draw(count * CONTACTS, rng)
    face, bary = face.reshape(count, CONTACTS), bary.reshape(count, CONTACTS, 3)
    directions = cone(-points.normals[face.ravel()], CONE, rng).reshape(count, CONTACTS, 3)
    share = rng.exponential(size=(count, CONTACTS)) * (np.arange(CONTACTS) < contacts[:, None])

    pool_face, pool_bary = points.draw(POOL, rng)
    pool, normal = points.at(pool_face, pool_bary), points.normals[pool_face]

    landing = kind == KINDS.index("landing")
    if landing.any():
        up = rng.standard_normal((int(landing.sum()), 3))
        up /= np.linalg.norm(up, axis=1)[:, None]
        height = up @ pool.T + OUT_OF_REACH * (up @ normal.T > AWAY)  # what faces away from the floor does not touch it
        lowest = np.argpartition(height, 4 * CONTACTS, axis=1)[:, : 4 * CONTACTS]
        chosen = np.take_along_axis(lowest, rng.permuted(np.tile(np.arange(4 * CONTACTS), (len(up), 1)), axis=1), 1)
        chosen = chosen[:, :CONTACTS]
        face[landing], bary[landing] = pool_face[chosen], pool_bary[chosen]
        directions[landing] = cone(np.repeat(up, CONTACTS, axis=0), TILT, rng).reshape(-1, CONTACTS, 3)

    ring = kind == KINDS.index("ring")
    if ring.any():
        centre = points.at(face[ring, 0], bary[ring, 0])
        axis = -points.normals[face[ring, 0]]
        radius = np.exp(rng.uniform(np.log(RING[0]), np.log(RING[1]), len(centre)))
        side = cone(axis, np.pi / 2, rng)
        side -= np.einsum("ni,ni->n", side, axis)[:, None] * axis
        side /= np.linalg.norm(side, axis=1)[:, None]
        turn = 2 * np.pi * np.arange(CONTACTS) / contacts[ring, None]
        around = np.cos(turn)[:, :, None] * side[:, None] + np.sin(turn)[:, :, None] * np.cross(axis, side)[:, None]
        target = centre[:, None] + radius[:, None, None] * around
        _, near = cKDTree(pool).query(target, k=NEAREST)
        facing = np.einsum("rkni,ri->rkn", normal[near], axis) < AWAY
        first = np.argmax(facing, axis=2)
        chosen = np.take_along_axis(near, first[:, :, None], axis=2)[:, :, 0]
        # Where nothing near faces the tube, the contact is at its centre, which does.
        beside_tube = np.take_along_axis(facing, first[:, :, None], axis=2)
        face[ring] = np.where(beside_tube[:, :, 0], pool_face[chosen], face[ring][:, :1])
        bary[ring] = np.where(beside_tube, pool_bary[chosen], bary[ring][:, :1])
        directions[ring] = cone(np.repeat(axis, CONTACTS, axis=0), TILT, rng).reshape(-1, CONTACTS, 3)

    grip = kind == KINDS.index("grip")
    if grip.any():
        first = points.at(face[grip, 0], bary[grip, 0])
        inward = -points.normals[face[grip, 0]]
        arm = pool - first[:, None]
        along = np.einsum("gpi,gi->gp", arm, inward)
        beside = np.linalg.norm(arm - along[:, :, None] * inward[:, None], axis=2)
        facing = (normal @ inward.T).T > OPPOSITE
        # The nearest point of the far side that is close to the line through the body.
        chosen = np.argmin(beside + DEPTH_WEIGHT * along + OUT_OF_REACH * ((along <= 0) | ~facing), axis=1)
        face[grip, 1], bary[grip, 1] = pool_face[chosen], pool_bary[chosen]
        directions[grip, 0], directions[grip, 1] = cone(inward, TILT, rng), cone(-inward, TILT, rng)
        share[grip, :2] = 1.0

    share /= share.sum(axis=1, keepdims=True)
    return Impacts(face, bary, directions, share), kind
