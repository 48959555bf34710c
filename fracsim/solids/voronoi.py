"""Voronoi cells of a body: convex cells of a centroidal set of seeds, cut exactly by the surface.

Cracks of the lattice simulators run along the planar faces between them. Offline only.
"""

from __future__ import annotations

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
STEPS = 40  # of Lloyd's iteration
GRADING = 0.5  # the power of the walls' thickness that the cells' size follows
THICK = 1.25  # of a cell's size in a thick body: thinner walls get smaller cells; what is measured at any flat side
THINNEST = 0.1  # of the thickness from which cells grow no more: thinner walls get no smaller cells
SLIVER = 0.1  # of the volume that a cell should have at its place; smaller ones join a neighbour
FLAT = 1e-9  # of the largest extent: how far from its plane a face's triangle may lie by rounding
MARGIN = 1.3  # how much farther than any point of the body is from a seed the guards stay away from the body
JITTER = 0.02  # of the distance between guards, or from seed to seed where these are tried again: keeps things general


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
    return solid_of_seeds(surface, *place_seeds(surface, cells, rng), rng)


def solid_of_seeds(surface: Surface, seeds: FloatArray, inside: FloatArray, rng: np.random.Generator) -> Solid:
    """Divide a body into the Voronoi cells of given seeds.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    seeds : ndarray of float64, shape (S, 3)
        All different.
    inside : ndarray of float64, shape (N, 3)
        Samples of the body, denser than the seeds.
    rng : numpy.random.Generator
        Moves the seeds a little where rounding cannot decide how a cell and the surface meet.

    Returns
    -------
    Solid
        As of ``voronoi_solid``.

    Raises
    ------
    BakeError
        If the cells do not add up to the body, however often the seeds are moved.
    """
    distance, _ = cKDTree(seeds).query(np.vstack([inside, surface.vertices]))
    reach = float(distance.max())
    shift = JITTER * cKDTree(seeds).query(seeds, k=[2])[0] if len(seeds) > 1 else reach * np.ones((1, 1))
    fault = ""
    for attempt in range(TRIES):
        points = seeds + rng.uniform(-1.0, 1.0, seeds.shape) * shift if attempt else seeds
        try:
            tetrahedra = voronoi_tetrahedra(points, inside, MARGIN * (1 + 0.2 * attempt) * reach, rng)
            return _join(cut_once(surface, *tetrahedra), points, surface)
        except DegenerateCut as error:
            fault = str(error)
    raise BakeError(
        f"{surface.name}: cannot be cut into Voronoi cells ({fault}); the surface probably runs through itself: "
        "repair it before baking"
    )


def place_seeds(surface: Surface, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
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
    seeds : ndarray of float64, shape (S, 3)
        Each about the weighted centroid of its Voronoi cell in the body.
    inside : ndarray of float64, shape (N, 3)
        The samples of the body that placed them.

    Notes
    -----
    With h = (V/S)^(1/3), walls thinner than 1.25 h get cells smaller by the square root of their thickness, so that
    there is one cell or two through them, but no less than a third as large as the largest cells. Cells of size
    proportional to w^(-1/5) come of weighting the volume by w (``centroidal_seeds``).
    """
    inside, volumes = sample_interior(surface, SAMPLES * count, rng)
    size = float(np.cbrt(volumes.sum() / count))
    thickness = wall_thickness(surface, inside, volumes, size, rng) / (THICK * size)
    spacing = thickness.clip(THINNEST, 1.0) ** GRADING
    # Through a wall thinner than its spacing there is one cell, so the thickness decides how many there are.
    density = volumes / (spacing**2 * np.minimum(spacing, THICK * thickness))
    begin = inside[np.sort(rng.choice(len(inside), count, replace=False, p=density / density.sum()))]
    return centroidal_seeds(begin, inside, volumes / spacing**5), inside


def centroidal_seeds(seeds: FloatArray, inside: FloatArray, weights: FloatArray, steps: int = STEPS) -> FloatArray:
    """Move seeds to the weighted centroids of their own Voronoi cells.

    Parameters
    ----------
    seeds : ndarray of float64, shape (S, 3)
        Where they begin.
    inside : ndarray of float64, shape (N, 3)
        Samples of the body.
    weights : ndarray of float64, shape (N,)
        Of the samples: the volumes that they stand for, times any density.
    steps : int
        Of the iteration.

    Returns
    -------
    ndarray of float64, shape (S, 3)
        Where they are after these steps of Lloyd's iteration (Lloyd 1982, *Least squares quantization in PCM*).

    Notes
    -----
    In three dimensions cells come out with sizes proportional to density^(-1/5), in two, or through one thin wall,
    density^(-1/4) (Du, Faber, Gunzburger 1999, *Centroidal Voronoi tessellations*, section 6.4).
    """
    seeds = seeds.copy()
    for _ in range(steps):
        _, nearest = cKDTree(seeds).query(inside)
        total = sum_by_index(nearest, weights, len(seeds))
        moment = sum_by_index(nearest, weights[:, None] * inside, len(seeds))
        held = total > 0
        seeds[held] = moment[held] / total[held, None]
    return seeds


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


def _join(parts: Solid, seeds: FloatArray, surface: Surface) -> Solid:
    """Join the parts of tetrahedra to connected parts of Voronoi cells, and slivers to a neighbour."""
    # A Voronoi cell is convex, so the centroid of a part of it is nearest to its seed.
    _, seed = cKDTree(seeds).query(parts.centroids)
    pairs, areas, _ = shared_faces(parts.triangles, parts.sides, parts.points)
    same = seed[pairs[:, 0]] == seed[pairs[:, 1]]
    graph = coo_matrix((np.ones(same.sum()), tuple(pairs[same].T)), shape=(parts.count, parts.count))
    _, cell = connected_components(graph, directed=False)
    # What a cell there should have: the mean of its seed's whole Voronoi cell and those next to it.
    total = sum_by_index(seed, parts.volumes, len(seeds))
    beside = np.unique(np.sort(seed[pairs[~same]], axis=1), axis=0)
    ends = np.concatenate([np.arange(len(seeds)), beside[:, 0], beside[:, 1]])
    others = np.concatenate([np.arange(len(seeds)), beside[:, 1], beside[:, 0]])
    expected = sum_by_index(ends, total[others], len(seeds)) / np.bincount(ends)
    label = merge_small_regions(parts.volumes / expected[seed], pairs, areas, SLIVER, cell.astype(np.int64))
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
