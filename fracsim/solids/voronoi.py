"""Voronoi cells of a body: convex cells of a centroidal set of seeds, cut exactly by the surface.

Cracks of the lattice simulators run along the planar faces between them. Offline only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Voronoi, cKDTree

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError
from .cut import DegenerateCut, cut_once
from .interior import sample_interior, wall_thickness
from .polygons import coarsen
from .solid import Solid, merge_small_regions, relabel, shared_faces, sum_by_index
from .surface import Surface

TRIES = 8  # sets of seeds tried before a surface is called impossible
SAMPLES = 40  # points inside the body for each cell: they place its seed
STEPS = 40  # of Lloyd's iteration; the seeds then move by 1 % of a cell a step
GRADING = 0.5  # the power of the walls' thickness that the cells' size follows
THICK = 1.25  # of a cell's size in a thick body: thinner walls get smaller cells; what is measured at any flat side
THINNEST = 0.1  # of the thickness from which cells grow no more: thinner walls get no smaller cells
SLIVER = 0.1  # of the volume that a cell should have at its place; smaller ones join a neighbour
FLAT = 1e-9  # of the largest extent: how far from its plane a face's triangle may lie by rounding
MARGIN = 1.3  # how much farther than any point of the body is from a seed the guards stay away from the body
JITTER = 0.02  # of the distance between guards, or of a cell when seeds are tried again: keeps positions general


@dataclass(frozen=True, eq=False)
class Seeds:
    """Where the Voronoi cells of a body grow from.

    Attributes
    ----------
    points : ndarray of float64, shape (S, 3)
        In the surface's frame, in units of the largest extent.
    volumes : ndarray of float64, shape (S,)
        About how much of the body is nearer to each than to the others.
    reach : float
        No point of the body is farther from the nearest seed, as far as samples can tell.
    inside : ndarray of float64, shape (N, 3)
        The samples of the body that placed them.
    """

    points: FloatArray
    volumes: FloatArray
    reach: float
    inside: FloatArray


def voronoi_solid(surface: Surface, cells: int, rng: np.random.Generator) -> Solid:
    """Divide a body into the Voronoi cells of seeds that are their own cells' centroids.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    cells : int
        How many seeds. There are a few more cells where the body has several parts of one Voronoi cell (the two
        walls of a gap), and fewer where slivers are joined.
    rng : numpy.random.Generator
        Places the seeds; the same generator gives the same bits.

    Returns
    -------
    Solid
        Of connected cells, whose volumes add up to the body's. Two cells meet in a plane, except where a sliver was
        joined to one of them. The outside has no marks but where cells meet.

    Raises
    ------
    BakeError
        If no set of seeds gives cells that add up to the body.

    See Also
    --------
    fracsim.solids.cut.cut_lattice : cells of nearly equal shape, by the thousand.

    Notes
    -----
    The seeds are denser where walls are thin (``place_seeds``). Each facet between two Voronoi cells is triangulated
    once, each triangle makes a tetrahedron with either seed, and these tetrahedra are cut by the surface
    (``cut_once``).
    """
    seeds = place_seeds(surface, cells, rng)
    spacing = np.cbrt(seeds.volumes)[:, None]
    fault = ""
    for attempt in range(TRIES):
        points = seeds.points
        if attempt:
            points = points + rng.uniform(-JITTER, JITTER, points.shape) * spacing
        try:
            tetrahedra = voronoi_tetrahedra(points, seeds.inside, MARGIN * (1 + 0.2 * attempt) * seeds.reach, rng)
            parts = cut_once(surface, *tetrahedra)
        except DegenerateCut as error:
            fault = str(error)
            continue
        return _join(parts, points, seeds.volumes, surface)
    raise BakeError(
        f"{surface.name}: cannot be cut into Voronoi cells ({fault}); the surface probably runs through itself: "
        "repair it before baking"
    )


def place_seeds(surface: Surface, count: int, rng: np.random.Generator) -> Seeds:
    """Place seeds whose Voronoi cells follow the thickness of a body's walls.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    count : int
        S, how many.
    rng : numpy.random.Generator
        The source of chance.

    Returns
    -------
    Seeds
        Each about the weighted centroid of its Voronoi cell in the body.

    Notes
    -----
    With h = (V/S)^(1/3), walls thinner than 1.25 h get cells smaller by the square root of their thickness, so that
    there is one cell or two through them, but no less than a third as large as the largest cells. Lloyd's
    iteration (Lloyd 1982) makes cells of size proportional to w^(-1/5) where the volume is weighted by w (Du, Faber,
    Gunzburger 1999, *Centroidal Voronoi tessellations*, section 6.4).
    """
    inside, volumes = sample_interior(surface, SAMPLES * count, rng)
    size = float(np.cbrt(volumes.sum() / count))
    thickness = wall_thickness(surface, inside, volumes, size, rng) / (THICK * size)
    spacing = thickness.clip(THINNEST, 1.0) ** GRADING
    # Through a wall thinner than its spacing there is one cell, so the thickness decides how many there are.
    density = volumes / (spacing**2 * np.minimum(spacing, THICK * thickness))
    weights = volumes / spacing**5
    points = inside[np.sort(rng.choice(len(inside), count, replace=False, p=density / density.sum()))]
    for _ in range(STEPS):
        _, nearest = cKDTree(points).query(inside)
        total = sum_by_index(nearest, weights, count)
        moment = sum_by_index(nearest, weights[:, None] * inside, count)
        held = total > 0
        points = points.copy()
        points[held] = moment[held] / total[held, None]
    tree = cKDTree(points)
    distance, nearest = tree.query(np.vstack([inside, surface.vertices]))
    held_volumes = sum_by_index(nearest[: len(inside)], volumes, count)
    # A seed that no sample is nearest to has a cell smaller than a sample.
    return Seeds(points, np.maximum(held_volumes, volumes.min()), float(distance.max()), inside)


def voronoi_tetrahedra(
    seeds: FloatArray, inside: FloatArray, margin: float, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Divide the Voronoi cells of seeds into tetrahedra that meet face to face.

    Parameters
    ----------
    seeds : ndarray of float64, shape (S, 3)
        The last S of the points that come out.
    inside : ndarray of float64, shape (N, 3)
        Samples of what the cells must cover.
    margin : float
        How far from the samples the cells may be bounded by guards: seeds on a grid around the body, which have no
        cells of their own.
    rng : numpy.random.Generator
        Places the guards.

    Returns
    -------
    points : ndarray of float64, shape (P, 3)
        Corners of Voronoi cells, then the seeds. The first lies outside the samples' bounding box.
    tetrahedra : ndarray of int64, shape (T, 4)
        Of positive volume; the last corner is the seed in whose cell it lies.

    Raises
    ------
    DegenerateCut
        If a cell is unbounded, or rounding leaves a tetrahedron without volume.
    """
    count = len(seeds)
    low, high = inside.min(axis=0), inside.max(axis=0)
    axes = [np.arange(a - 2.5 * margin, b + 3.5 * margin, margin) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid + rng.uniform(-JITTER, JITTER, grid.shape) * margin
    guards = grid[cKDTree(inside).query(grid)[0] > margin]
    diagram = Voronoi(np.vstack([seeds, guards]))
    ridges = diagram.ridge_points
    owned = np.flatnonzero((ridges < count).any(axis=1))
    lengths = np.array([len(diagram.ridge_vertices[k]) for k in owned])
    corners = np.concatenate([diagram.ridge_vertices[k] for k in owned]).astype(np.int64)
    if corners.min() < 0:
        raise DegenerateCut("a Voronoi cell is unbounded")
    # Qhull lists a facet's corners in order, so that a fan from the first triangulates it.
    start = np.cumsum(lengths) - lengths
    facet = np.repeat(np.arange(len(owned)), lengths - 2)
    step = np.arange(len(facet)) - np.repeat(np.cumsum(lengths - 2) - (lengths - 2), lengths - 2)
    triangles = np.stack([corners[start[facet] + k] for k in (0, step + 1, step + 2)], axis=1)
    used, inverse = np.unique(triangles, return_inverse=True)
    points = diagram.vertices[used]
    # The point farthest along x is beyond the body, which the cells cover.
    first = int(np.argmax(points[:, 0]))
    order = np.concatenate([[first], np.delete(np.arange(len(used)), first)])
    rank = np.empty(len(used), dtype=np.int64)
    rank[order] = np.arange(len(used))
    triangles = rank[inverse.reshape(-1, 3)]
    ends = ridges[owned][facet]
    blocks = [
        np.column_stack([triangles[ends[:, side] < count], len(used) + ends[ends[:, side] < count, side]])
        for side in (0, 1)
    ]
    tetrahedra = np.vstack(blocks)
    points = np.vstack([points[order], seeds])
    corner = points[tetrahedra]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1])
    if (volume == 0).any():
        raise DegenerateCut("a tetrahedron of a Voronoi cell is flat")
    tetrahedra[volume < 0, :2] = tetrahedra[volume < 0, 1::-1]
    return points, tetrahedra


def _join(parts: Solid, seeds: FloatArray, volumes: FloatArray, surface: Surface) -> Solid:
    """Join the parts of tetrahedra to connected parts of Voronoi cells, and slivers to a neighbour."""
    # A Voronoi cell is convex, so the centroid of a part of it is nearest to its seed.
    _, seed = cKDTree(seeds).query(parts.centroids)
    pairs, areas, _ = shared_faces(parts.triangles, parts.sides, parts.points)
    same = seed[pairs[:, 0]] == seed[pairs[:, 1]]
    graph = coo_matrix((np.ones(same.sum()), tuple(pairs[same].T)), shape=(parts.count, parts.count))
    _, cell = connected_components(graph, directed=False)
    label = merge_small_regions(parts.volumes / volumes[seed], pairs, areas, SLIVER, cell.astype(np.int64))
    cells = relabel(parts, label)
    # The triangles that relabelling keeps, each with the plane between the two seeds on its sides.
    ends = np.where(parts.sides >= 0, label[parts.sides], -1)
    ends = np.sort(seed[parts.sides[ends[:, 0] != ends[:, 1]]], axis=1)
    plane = ends[:, 0] * len(seeds) + ends[:, 1]
    across = seeds[ends[:, 1]] - seeds[ends[:, 0]]
    corner = cells.points[cells.triangles] - 0.5 * seeds[ends].sum(axis=1)[:, None]
    height = np.abs(np.einsum("nki,ni->nk", corner, across)).max(axis=1)
    # A triangle off that plane, beside a part so thin that rounding took it for the other seed's, stays as it is.
    off = height > FLAT * np.linalg.norm(across, axis=1)
    plane[off] = len(seeds) ** 2 + np.arange(off.sum())
    return coarsen(cells, surface, plane)
