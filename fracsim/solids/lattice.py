"""The tetrahedral lattice that a surface is cut with. Offline only; ``cut`` uses it.

It is body-centred cubic, turned away from the body's own axes, and jittered.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray, IntArray
from .surface import Surface

# Facet k of a tetrahedron lies opposite its vertex k and is wound outward.
FACETS = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
JITTER = 0.15  # of the lattice spacing: enough to hide the lattice's favourite directions, too little to fold it
TILT = 0.2  # rad; against the body's own axes, so that no facet is parallel to a flat side


def body_centred_lattice(counts: IntArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """Make a body-centred cubic lattice and its tetrahedra, four around every inner face of a cube.

    Parameters
    ----------
    counts : ndarray of int64, shape (3,)
        How many cubes along each axis.
    spacing : float
        The edge of a cube.

    Returns
    -------
    points : ndarray of float64, shape (P, 3)
        Corners and centres of the cubes.
    tetrahedra : ndarray of int64, shape (T, 4)
        Of positive volume.

    Notes
    -----
    Labelle and Shewchuk 2007, *Isosurface stuffing*, section 2.
    """

    def grid(shape: IntArray) -> IntArray:
        """List the indices of a grid."""
        return np.stack(np.meshgrid(*[np.arange(k) for k in shape], indexing="ij"), -1).reshape(-1, 3)

    corners, bodies = grid(counts + 1), grid(counts)
    points = np.vstack([corners, bodies + 0.5]) * spacing
    blocks = []
    for axis in np.eye(3, dtype=np.int64):
        first, second = np.roll(axis, 1), np.roll(axis, 2)
        cubes = grid(counts - axis)
        corner = cubes + axis
        ring = [
            np.ravel_multi_index(tuple((corner + step).T), tuple(counts + 1))
            for step in (0 * axis, first, first + second, second)
        ]
        low = len(corners) + np.ravel_multi_index(tuple(cubes.T), tuple(counts))
        high = len(corners) + np.ravel_multi_index(tuple((cubes + axis).T), tuple(counts))
        blocks += [np.stack([low, high, ring[k], ring[(k + 1) % 4]], axis=1) for k in range(4)]
    return points, np.vstack(blocks)


def lattice_spacing(volume: float, area: float, cells: int) -> float:
    """Choose the spacing at which about so many tetrahedra meet a body.

    Parameters
    ----------
    volume, area : float
        V and A of the body.
    cells : int
        How many tetrahedra are wanted.

    Returns
    -------
    float
        The spacing a that solves cells = 12 V/a³ + 6 A/a².

    Notes
    -----
    A tetrahedron has volume a³/12; the second term is the layer that the surface passes through.
    """
    roots = np.roots([cells, 0.0, -6.0 * area, -12.0 * volume])
    return float(roots[np.isreal(roots) & (roots.real > 0)].real.max())


def tilted_lattice(surface: Surface, cells: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Make a lattice that covers a surface, tilted against its axes and jittered.

    Parameters
    ----------
    surface : Surface
        To be cut.
    cells : int
        About how many tetrahedra shall meet it.
    rng : numpy.random.Generator
        The source of tilt, place and jitter.

    Returns
    -------
    points : ndarray of float64, shape (P, 3)
        In the surface's frame.
    tetrahedra : ndarray of int64, shape (T, 4)
        Of positive volume.
    """
    mesh = surface.trimesh
    spacing = lattice_spacing(mesh.volume, mesh.area, cells)
    axes = mesh.bounding_box_oriented.primitive.transform[:3, :3]
    tilt = rng.standard_normal(3)
    turn = Rotation.from_rotvec(TILT * tilt / np.linalg.norm(tilt)).as_matrix() @ axes.T
    turned = surface.vertices @ turn.T
    low = turned.min(axis=0) - rng.uniform(1.5, 2.0, 3) * spacing
    counts = np.ceil((turned.max(axis=0) + 1.5 * spacing - low) / spacing).astype(np.int64)
    points, tetrahedra = body_centred_lattice(counts, spacing)
    return (points + low + rng.uniform(-JITTER, JITTER, points.shape) * spacing) @ turn, tetrahedra
