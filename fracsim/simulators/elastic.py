"""A second opinion on how an impact spreads: linear elasticity by finite elements, under inertia relief.

``fracture_modes.impact_field`` lets momentum diffuse, and knows no bending and no tension on the far side. Here
the same impact acts on an elastic body that is free to fly: the force is balanced by the inertia of the rigid motion
it causes (d'Alembert's principle), and what is left is stress; engineers call it inertia relief. The elements are the
textbook's (Zienkiewicz, Taylor and Zhu, *The Finite Element Method: Its Basis and Fundamentals*). The tractions on
the interfaces then go through the same breaking rule. Waves are left out: it is the stress of an impact that lasts
longer than sound takes to cross.

Lengths are in units of the largest extent L, forces in units of the impact's F, so tractions are in F/L². Young's
modulus and density are 1: the stress of a body under given forces depends on neither.
Offline only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from ..fracture.rule import Interfaces, effective_opening
from ..geometry.sampling import CONE, SurfacePoints, cone
from ..solids.solid import Solid
from ..solids.surface import Surface
from .base import Impacts, Response, critical_load_factor, pieces_from_broken
from .elastic_fem import ElasticBody
from .modal import ModalSimulator

try:
    from skfem import MeshTet
except ImportError as error:
    raise MissingExtraError("scikit-fem", "check") from error

GAUGE_IMPACTS = 2000  # that the median threshold is taken over


@dataclass(frozen=True, eq=False)
class ElasticSimulator:
    """The parts and the breaking rule of a ModalGenerator, driven by elastic tractions.

    rows: (V, 3, I, 3), per unit of severity at each vertex, for each direction of the impact (second axis), the
    gauged tractions (last axis): ``ElasticBody.tractions`` times ``gauge``.
    gauge: L²/F; turns tractions into the effective jumps of ``breaking.drives``. It is set so that the median
    threshold of single impacts, over the area and the cone of directions, is the modal simulator's; a
    strength cannot be compared with a jump of velocity in any other way.
    cells, atom: as of the ModalGenerator.
    """

    surface: Surface
    cells: Solid
    interfaces: Interfaces
    impact_field: FloatArray
    gauge: float
    min_piece_volume_fraction: float
    fine_cells: Solid
    fine_to_cell: IntArray
    fixed_cracks: bool = True

    def tractions(self, impacts: Impacts) -> FloatArray:
        """(N, I, 3) gauged tractions; impacts that act together add up."""
        # One sparse row per impact: severity x barycentric x direction at each vertex, (N, 3 V).
        count, contacts = impacts.faces.shape
        corner = self.surface.faces[impacts.faces]  # (N, K, 3)
        column = 3 * corner[..., None] + np.arange(3)
        weight = (impacts.severities[..., None] * impacts.barycentric)[..., None] * impacts.directions[:, :, None]
        row = np.repeat(np.arange(count), contacts * 9)
        shape = (count, 3 * len(self.surface.vertices))
        spread = sp.csr_matrix((weight.ravel(), (row, column.ravel())), shape=shape)
        return np.asarray(spread @ self.impact_field.reshape(shape[1], -1)).reshape(count, -1, 3)

    def load_ratios(self, impacts: Impacts) -> FloatArray:
        """(N, I) effective tractions on the interfaces, 1 being what breaks them; proportional to severity."""
        return effective_opening(self.tractions(impacts), self.interfaces.normals)

    def thresholds(self, impacts: Impacts) -> FloatArray:
        return critical_load_factor(self.load_ratios(impacts), self.cells, self.interfaces)

    def fracture(self, impacts: Impacts) -> Response:
        return pieces_from_broken(
            self.load_ratios(impacts) >= 1.0, self.cells, self.interfaces, self.min_piece_volume_fraction
        )


def elastic_simulator(
    modal: ModalSimulator,
    mesh: MeshTet | None = None,
    edge: float | None = None,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> ElasticSimulator:
    """The elastic counterpart of a modal simulator; ``progress`` hears the stage and its share done.

    mesh: of the same body, or else edge: see ``tetrahedralise``.
    Raises MissingExtraError without wildmeshing when a mesh has to be made.
    """
    progress("elastic", 0.0)
    body = ElasticBody(modal.surface, modal.cells, modal.interfaces, mesh, edge)
    progress("elastic", 0.5)
    rows = np.ascontiguousarray(np.moveaxis(body.tractions(modal.surface.vertices), 3, 1))
    same = (modal.min_piece_volume_fraction, modal.cells, modal.fine_to_cell)
    bare = ElasticSimulator(modal.surface, modal.cells, modal.interfaces, rows, 1.0, *same)
    impacts = single_impacts(modal.surface, GAUGE_IMPACTS, np.random.default_rng(0))
    gauge = float(np.median(bare.thresholds(impacts)) / np.median(modal.thresholds(impacts)))
    # In single precision, as files keep it, so that a truth read back answers with the same bits.
    rows = (rows * gauge).astype(np.float32).astype(np.float64)
    return ElasticSimulator(modal.surface, modal.cells, modal.interfaces, rows, gauge, *same)


def single_impacts(surface: Surface, count: int, rng: np.random.Generator) -> Impacts:
    """``count`` single impacts of unit severity, uniform over the area and over the cone about the inward normal."""
    points = SurfacePoints(surface.vertices, surface.faces)
    face, barycentric = points.draw(count, rng)
    directions = cone(-points.normals[face], CONE, rng)
    return Impacts(face[:, None], barycentric[:, None], directions[:, None], np.ones((count, 1)))
