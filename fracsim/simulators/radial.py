"""A simulator with neither modes nor atoms: cracks run out from where the body is hit. Offline only.

It is simple on purpose. Pieces are sets of the solid's cells, hundreds or thousands of them, cut by planes through
the contact and by a sphere around it. Any other simulator that labels cells, an expensive one included, is connected
in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..fracture.rule import Interfaces, components, separated
from ..geometry.frames import tangent_basis
from ..geometry.sampling import SurfacePoints
from ..solids.cut import cut_lattice
from ..solids.solid import Solid
from ..solids.surface import Surface
from .base import (
    Impacts,
    Progress,
    Response,
    State,
    interfaces_between,
    merge_small_pieces_each,
    no_progress,
)
from .registry import SimulatorOptions

SUPPORT = 0.15  # of the largest extent: radius of the ball whose solid share is a point's strength
BARE = 0.2  # strength of a point with nothing behind it
REACH = 0.25  # of the largest extent: how far cracks run at the threshold; in proportion to severity beyond
SECTORS = 6  # the most sectors that one contact cuts the body around it into


@dataclass(frozen=True, eq=False)
class RadialSimulator:
    """Radial cracks through each contact, along the impact, and a spherical crack where they end.

    A contact of severity s at a point of strength σ (more solid behind the point, more strength) cracks the body from
    s = σ on: into 2 sectors about the impact, and one more for every factor √2 in s/σ. Cracks run out to REACH s/σ,
    the first towards the centre of the body. Several contacts divide the body among them like a weighted Voronoi
    diagram.

    Attributes
    ----------
    surface : Surface
        The body's surface, of largest extent 1, with V vertices.
    cells : Solid
        The C cells that pieces are sets of.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the body's volume, join a neighbour.
    """

    options_type: ClassVar[type[SimulatorOptions]] = SimulatorOptions
    fixed_cracks: ClassVar[bool] = False
    repeatable: ClassVar[bool] = True
    driven_by_impact_field: ClassVar[bool] = False
    severity_kind: ClassVar[str] = "impulse"

    surface: Surface
    cells: Solid
    min_piece_volume_fraction: float

    @classmethod
    def build(
        cls,
        surface: Surface,
        options: SimulatorOptions,
        rng: np.random.Generator,
        progress: Progress = no_progress,
    ) -> RadialSimulator:
        """Cut a surface into cells that cracks run freely among.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        options : SimulatorOptions
            Cells and the smallest piece.
        rng : numpy.random.Generator
            Places the lattice that cuts the cells.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        RadialSimulator
            Of the surface.

        Raises
        ------
        BakeError
            If the surface cannot be cut into cells.
        """
        progress("solid", 0.0)
        return cls(surface, cut_lattice(surface, options.cells, rng), options.min_piece_volume_fraction)

    @cached_property
    def interfaces(self) -> Interfaces:
        """The interfaces between neighbouring cells."""
        return interfaces_between(self.cells)

    @cached_property
    def strength(self) -> FloatArray:
        """The severity from which a single contact at each vertex cracks the body, (V,)."""
        tree = cKDTree(self.cells.centroids)
        near = tree.query_ball_point(self.surface.vertices, SUPPORT)
        backed = np.array([self.cells.volumes[rows].sum() for rows in near])
        return BARE + backed / (4 / 3 * np.pi * SUPPORT**3)

    def _ratios(self, impacts: Impacts) -> FloatArray:
        """Severity over strength at each contact, (N, K)."""
        corner = self.surface.faces[impacts.faces]
        strength = np.einsum("nkc,nkc->nk", impacts.barycentric, self.strength[corner])
        return np.asarray(impacts.severities / strength)

    def thresholds(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to crack the body.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            The least factor on each impact's severities at which one of its contacts reaches its point's strength.
        """
        return np.asarray(1.0 / self._ratios(impacts).max(axis=1))

    def fracture(self, impacts: Impacts) -> Response:
        """Break the body by each impact.

        Parameters
        ----------
        impacts : Impacts
            N impacts, each on the whole body.

        Returns
        -------
        Response
            The piece of each cell; no broken interfaces.
        """
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
        """Label the cells (C,) by the sectors of K contacts: points and directions (K, 3), ratios (K,)."""
        cells, pairs = self.cells, self.interfaces.pairs
        arm = cells.centroids[:, None] - points  # (C, K, 3)
        distance = np.linalg.norm(arm, axis=2) / (REACH * ratios)
        owner = np.argmin(distance, axis=1)  # the contact that each cell belongs to
        each = np.arange(len(owner))
        centre = cells.volumes @ cells.centroids / cells.volumes.sum()
        # Two axes across each impact; angles are counted from the first, which points to the body's centre.
        first = np.cross(directions, np.cross(centre - points, directions))
        length = np.linalg.norm(first, axis=1, keepdims=True)
        fallback, _ = tangent_basis(directions, "smallest")
        first = np.where(length > 1e-6, first, fallback)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(directions, first)
        owner_arm = arm[each, owner]
        angle = np.arctan2((owner_arm * second[owner]).sum(axis=1), (owner_arm * first[owner]).sum(axis=1))
        sectors = np.minimum(2 + np.floor(2 * np.log2(ratios)), SECTORS)[owner]
        sector = np.floor(angle % (2 * np.pi) / (2 * np.pi) * sectors).astype(np.int64)
        region = np.where(distance[each, owner] > 1.0, -1, owner * SECTORS + sector)
        return components(~separated(region, pairs)[None], pairs, len(owner))[0]

    def state(self) -> State:
        """Collect what a dataset keeps of the simulator beside its surface, cells and interfaces.

        Returns
        -------
        arrays : dict of ndarray
            None: the rest follows from the cells.
        numbers : dict
            The smallest piece.
        """
        return {}, {"min_piece_volume_fraction": self.min_piece_volume_fraction}

    @classmethod
    def restore(
        cls,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        arrays: Mapping[str, npt.NDArray[Any]],
        numbers: Mapping[str, Any],
    ) -> RadialSimulator:
        """Make the simulator again that ``state`` was asked of.

        Parameters
        ----------
        surface : Surface
            As it was.
        cells : Solid
            As they were.
        interfaces : Interfaces
            Not needed: they are worked out from the cells again.
        arrays, numbers : mapping
            What ``state`` gave.

        Returns
        -------
        RadialSimulator
            It answers with the same bits.
        """
        return cls(surface, cells, float(numbers["min_piece_volume_fraction"]))
