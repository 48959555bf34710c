"""Points inside a body: weighted samples of its volume, and how thick its walls are around them.

Offline only. ``voronoi`` places its seeds with it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray
from .surface import Surface


def sample_interior(surface: Surface, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Sample the inside of a body along parallel lines of a random direction.

    Parameters
    ----------
    surface : Surface
        Of volume V.
    count : int
        About how many points are wanted; thin walls get more, as every stretch of a line inside the body gets one.
    rng : numpy.random.Generator
        Turns and shifts the lines.

    Returns
    -------
    points : ndarray of float64, shape (N, 3)
        In the surface's frame; evenly spaced along each stretch.
    volumes : ndarray of float64, shape (N,)
        What each stands for. Their sum estimates V without bias.
    """
    turn = Rotation.random(random_state=rng).as_matrix()
    vertices = surface.vertices @ turn.T
    spacing = float(np.cbrt(surface.trimesh.volume / count))
    offset = vertices.min(axis=0)[:2] - rng.uniform(0.0, 1.0, 2) * spacing
    # Lines along z through the points of a grid of x and y, in units of its spacing; the faces that each goes through.
    corner = vertices[surface.faces]
    flat = (corner[:, :, :2] - offset) / spacing
    low = np.ceil(flat.min(axis=1)).astype(np.int64)
    extent = np.maximum(np.floor(flat.max(axis=1)).astype(np.int64) - low + 1, 0)
    size = extent.prod(axis=1)
    face = np.repeat(np.arange(len(corner)), size)
    step = np.arange(len(face)) - np.repeat(np.cumsum(size) - size, size)
    line = low[face] + np.stack([step // extent[face, 1], step % extent[face, 1]], axis=1)
    a, b, c = np.moveaxis(flat[face], 1, 0)

    def double_area(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        """Return twice the signed area of triangles in the plane."""
        return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])

    weight = np.stack([double_area(b, c, line), double_area(c, a, line), double_area(a, b, line)], axis=1)
    through = (weight > 0).all(axis=1) | (weight < 0).all(axis=1)
    face, line, weight = face[through], line[through], weight[through]
    height = np.einsum("nk,nk->n", weight, corner[face, :, 2]) / weight.sum(axis=1)
    # Every second stretch of a line is inside. A line that rounding gives an odd number of faces is left out.
    _, number, hits = np.unique(line, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    even = hits[number] % 2 == 0
    order = np.lexsort((height[even], number[even]))
    ends = height[even][order].reshape(-1, 2)
    line = line[even][order][::2]
    length = ends[:, 1] - ends[:, 0]
    parts = np.maximum(np.ceil(length / spacing).astype(np.int64), 1)
    row = np.repeat(np.arange(len(parts)), parts)
    step = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
    z = ends[row, 0] + (step + 0.5) / parts[row] * length[row]
    points = np.column_stack([line[row] * spacing + offset, z]) @ turn
    return points, length[row] / parts[row] * spacing**2


def wall_thickness(
    surface: Surface, points: FloatArray, volumes: FloatArray, radius: float, rng: np.random.Generator
) -> FloatArray:
    """Measure how thick a body is around points inside it: twice its volume over its surface area, near each.

    Parameters
    ----------
    surface : Surface
        Of the body.
    points, volumes : ndarray
        As ``sample_interior`` gives them, (N, 3) and (N,).
    radius : float
        How near, in units of the largest extent. It must be several times the points' spacing.
    rng : numpy.random.Generator
        Places the samples of the surface.

    Returns
    -------
    ndarray of float64, shape (N,)
        The thickness of a wall; of a round rod its radius. Infinite where no surface is near.
    """
    mesh = surface.trimesh
    spacing = np.cbrt(volumes.sum() / len(volumes))
    count = int(np.ceil(mesh.area / spacing**2))
    share = mesh.area_faces / mesh.area
    # Systematic sampling: every face gets its share to within one sample.
    face = np.searchsorted(np.cumsum(share), (np.arange(count) + rng.uniform()) / count).clip(max=len(share) - 1)
    barycentric = rng.dirichlet(np.ones(3), count)
    skin = np.einsum("nk,nkj->nj", barycentric, surface.vertices[surface.faces[face]])
    area = cKDTree(skin).query_ball_point(points, radius, return_length=True) * (mesh.area / count)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), radius, output_type="coo_matrix").tocsr()
    near.data[:] = 1.0
    volume = near @ volumes
    return np.asarray(2.0 * volume / np.maximum(area, 1e-300), dtype=np.float64)
