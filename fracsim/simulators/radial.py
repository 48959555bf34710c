"""A second truth, with neither modes nor atoms: cracks run out from where the body is hit. Offline only.

It is simple on purpose. Pieces are sets of the solid's cells, hundreds or thousands of them, cut by planes through
the contact and a sphere around it; whatever stands behind ``simulator.Generator`` with labels of cells, an expensive
simulation included, goes the way this one goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..fracture.rule import Interfaces, components, separated
from ..geometry.sampling import SurfacePoints
from ..solids.cut import cut_lattice
from ..solids.solid import Solid
from ..solids.surface import Surface
from .base import Impacts, Response, interfaces_between, merge_small_pieces_each

SUPPORT = 0.15  # of the largest extent: radius of the ball whose solid share says how well a point is backed
BARE = 0.2  # strength of a point with nothing behind it
REACH = 0.25  # of the largest extent: how far cracks run at the threshold; in proportion to severity beyond
SECTORS = 6  # the most that a contact parts the body around it into


@dataclass(frozen=True, eq=False)
class RadialSimulator:
    """Radial cracks through each contact, along the impact, and a spherical one where they end.

    A contact of severity s at a point of strength σ (more solid behind it, more strength) cracks the body from
    s = σ on: into 2 sectors about the impact, one more for every factor √2 beyond, out to REACH s/σ, the first crack
    towards the centre of the body. Several contacts divide the body among them like a weighted Voronoi diagram.
    """

    surface: Surface
    cells: Solid
    min_piece_volume_fraction: float
    fixed_cracks: bool = False

    @cached_property
    def interfaces(self) -> Interfaces:
        return interfaces_between(self.cells)

    @cached_property
    def strength(self) -> FloatArray:
        """(V,) severity from which a single contact at each vertex cracks the body."""
        tree = cKDTree(self.cells.centroids)
        near = tree.query_ball_point(self.surface.vertices, SUPPORT)
        backed = np.array([self.cells.volumes[rows].sum() for rows in near])
        return BARE + backed / (4 / 3 * np.pi * SUPPORT**3)

    def _ratios(self, impacts: Impacts) -> FloatArray:
        """(N, K): severity over strength at each contact."""
        corner = self.surface.faces[impacts.faces]
        strength = np.einsum("nkc,nkc->nk", impacts.barycentric, self.strength[corner])
        return np.asarray(impacts.severities / strength)

    def thresholds(self, impacts: Impacts) -> FloatArray:
        return np.asarray(1.0 / self._ratios(impacts).max(axis=1))

    def fracture(self, impacts: Impacts) -> Response:
        points = SurfacePoints(self.surface.vertices, self.surface.faces)
        where = points.at(impacts.faces.ravel(), impacts.barycentric.reshape(-1, 3)).reshape(*impacts.faces.shape, 3)
        ratios = self._ratios(impacts)
        labels = np.zeros((len(impacts), len(self.cells.volumes)), dtype=np.int64)
        for row in range(len(impacts)):
            active = np.flatnonzero(ratios[row] >= 1.0)
            if len(active):
                labels[row] = self._pieces(where[row, active], impacts.directions[row, active], ratios[row, active])
        return Response(
            merge_small_pieces_each(labels, self.cells.volumes, self.interfaces, self.min_piece_volume_fraction)
        )

    def _pieces(self, points: FloatArray, directions: FloatArray, ratios: FloatArray) -> IntArray:
        parts, pairs = self.cells, self.interfaces.pairs
        arm = parts.centroids[:, None] - points  # (P, K, 3)
        distance = np.linalg.norm(arm, axis=2) / (REACH * ratios)
        owner = np.argmin(distance, axis=1)
        each = np.arange(len(owner))
        centre = parts.volumes @ parts.centroids / parts.volumes.sum()
        first = np.cross(directions, np.cross(centre - points, directions))
        length = np.linalg.norm(first, axis=1, keepdims=True)
        fallback = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
        first = np.where(length > 1e-6, first, fallback)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(directions, first)
        mine = arm[each, owner]
        angle = np.arctan2((mine * second[owner]).sum(axis=1), (mine * first[owner]).sum(axis=1))
        sectors = np.minimum(2 + np.floor(2 * np.log2(ratios)), SECTORS)[owner]
        sector = np.floor(angle % (2 * np.pi) / (2 * np.pi) * sectors).astype(np.int64)
        region = np.where(distance[each, owner] > 1.0, -1, owner * SECTORS + sector)
        return components(~separated(region, pairs)[None], pairs, len(owner))[0]


def radial_simulator(
    surface: Surface, rng: np.random.Generator, cells: int = 5000, min_piece_volume_fraction: float = 1e-3
) -> RadialSimulator:
    """Cut a surface into about ``cells`` cells and let cracks run freely among them."""
    return RadialSimulator(surface, cut_lattice(surface, cells, rng), min_piece_volume_fraction)
