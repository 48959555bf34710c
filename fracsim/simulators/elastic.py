"""A simulator that loads the modal simulator's interfaces by elastic stress, under inertia relief. Offline only.

``diffusion.impact_field`` lets momentum diffuse, and knows no bending and no tension on the far side. Here the same
impact acts on an elastic body that is free to fly: the force is balanced by the inertia of the rigid motion that it
causes (d'Alembert's principle), and what is left is stress; engineers call it inertia relief. The finite elements are
the textbook's (Zienkiewicz, Taylor and Zhu, *The Finite Element Method: Its Basis and Fundamentals*). The tractions on
the interfaces then go through the same breaking rule. Waves are left out: this is the stress of an impact that lasts
longer than sound takes to cross the body.

Lengths are in units of the largest extent L, forces in units of the impact's F, so tractions are in F/L². Young's
modulus and density are 1: the stress of a body under known forces depends on neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from ..fracture.rule import Interfaces, effective_opening
from ..geometry.sampling import CONE, SurfacePoints, cone
from ..solids.solid import Solid, solid_from_arrays, solid_to_arrays
from ..solids.surface import Surface
from .base import Impacts, Progress, Response, State, critical_load_factor, no_progress, pieces_from_broken
from .elastic_fem import ElasticBody
from .modal import FINE, ModalSimulator
from .registry import SimulatorOptions

try:
    from skfem import MeshTet
except ImportError as error:
    raise MissingExtraError("scikit-fem", "elastic") from error

GAUGE_IMPACTS = 2000  # impacts over which the median threshold is taken


@dataclass(frozen=True, eq=False)
class ElasticSimulator:
    """The cells and the breaking rule of a ModalSimulator, loaded by elastic tractions.

    Attributes
    ----------
    surface : Surface
        The body's surface, of largest extent 1, with V vertices.
    cells : Solid
        The A atoms of the modal simulator.
    interfaces : Interfaces
        The I interfaces between them.
    unit_tractions : ndarray of float64, shape (V, 3, I, 3)
        ``ElasticBody.tractions`` times ``gauge``: per unit of severity at each vertex and for each component of the
        impact's direction (second axis), the traction on each interface (last axis).
    gauge : float
        Turns tractions into the effective jumps of ``fracture.rule.load_ratios``, in L²/F. It is set so that the
        median threshold of single impacts, over the area and the cone of directions, is the modal simulator's: a
        strength cannot be compared with a jump of velocity in any other way.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the body's volume, join a neighbour.
    fine_cells : Solid
        The F cells that the modes were computed on.
    fine_to_cell : ndarray of int64, shape (F,)
        The atom of each fine cell.
    """

    options_type: ClassVar[type[SimulatorOptions]] = SimulatorOptions
    fixed_cracks: ClassVar[bool] = True
    repeatable: ClassVar[bool] = False  # fTetWild, which makes the mesh, does not repeat itself
    driven_by_impact_field: ClassVar[bool] = False
    severity_kind: ClassVar[str] = "impulse"

    surface: Surface
    cells: Solid
    interfaces: Interfaces
    unit_tractions: FloatArray
    gauge: float
    min_piece_volume_fraction: float
    fine_cells: Solid
    fine_to_cell: IntArray

    @classmethod
    def build(
        cls,
        surface: Surface,
        options: SimulatorOptions,
        rng: np.random.Generator,
        progress: Progress = no_progress,
    ) -> ElasticSimulator:
        """Build the modal simulator of a surface and its elastic counterpart.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        options : SimulatorOptions
            Cells, modes and the smallest piece of the modal simulator.
        rng : numpy.random.Generator
            Places the lattice that cuts the cells. The tetrahedra are not drawn from it and differ a little each time.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        ElasticSimulator
            Of the surface.

        Raises
        ------
        BakeError
            If the surface cannot be cut into cells, no mode parts it, or it cannot be filled with tetrahedra.
        MissingExtraError
            If wildmeshing is not installed.
        """
        return cls.from_modal(ModalSimulator.build(surface, options, rng, progress), progress=progress)

    @classmethod
    def from_modal(
        cls,
        modal: ModalSimulator,
        mesh: MeshTet | None = None,
        edge: float | None = None,
        progress: Progress = no_progress,
    ) -> ElasticSimulator:
        """Make the elastic counterpart of a modal simulator.

        Parameters
        ----------
        modal : ModalSimulator
            Its atoms and interfaces are taken over.
        mesh : skfem.MeshTet, optional
            Tetrahedra that fill the body; made by ``elastic_fem.tetrahedralise`` if None.
        edge : float, optional
            How long the edges of that mesh are, in units of the largest extent.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        ElasticSimulator
            Of the same body.

        Raises
        ------
        BakeError
            If the body cannot be filled with tetrahedra.
        MissingExtraError
            If a mesh has to be made and wildmeshing is not installed.
        """
        progress("elastic", 0.0)
        body = ElasticBody(modal.surface, modal.cells, modal.interfaces, mesh, edge)
        progress("elastic", 0.5)
        tractions = np.ascontiguousarray(np.moveaxis(body.tractions(modal.surface.vertices), 3, 1))
        ungauged = cls(
            modal.surface,
            modal.cells,
            modal.interfaces,
            tractions,
            1.0,
            modal.min_piece_volume_fraction,
            modal.fine_cells,
            modal.fine_to_cell,
        )
        impacts = single_impacts(modal.surface, GAUGE_IMPACTS, np.random.default_rng(0))
        gauge = float(np.median(ungauged.thresholds(impacts)) / np.median(modal.thresholds(impacts)))
        # In single precision, as files keep it, so that a simulator read from a file answers with the same bits.
        tractions = (tractions * gauge).astype(np.float32).astype(np.float64)
        return replace(ungauged, unit_tractions=tractions, gauge=gauge)

    def tractions(self, impacts: Impacts) -> FloatArray:
        """Work out the tractions of impacts; those of contacts that act together add up.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N, I, 3)
            Gauged tractions on the interfaces.
        """
        # One sparse row per impact: severity x barycentric x direction at each vertex, (N, 3 V).
        count, contacts = impacts.faces.shape
        corner = self.surface.faces[impacts.faces]  # (N, K, 3)
        column = 3 * corner[..., None] + np.arange(3)
        weight = (impacts.severities[..., None] * impacts.barycentric)[..., None] * impacts.directions[:, :, None]
        row = np.repeat(np.arange(count), contacts * 9)
        shape = (count, 3 * len(self.surface.vertices))
        spread = sp.csr_matrix((weight.ravel(), (row, column.ravel())), shape=shape)
        return np.asarray(spread @ self.unit_tractions.reshape(shape[1], -1)).reshape(count, -1, 3)

    def load_ratios(self, impacts: Impacts) -> FloatArray:
        """Work out how hard impacts load each interface.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N, I)
            Load over strength: an interface breaks at 1. In proportion to severity.
        """
        return effective_opening(self.tractions(impacts), self.interfaces.normals)

    def thresholds(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to break the body.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            The least factor on each impact's severities at which the body falls into two pieces.
        """
        return critical_load_factor(self.load_ratios(impacts), self.cells, self.interfaces)

    def fracture(self, impacts: Impacts) -> Response:
        """Break the body by each impact.

        Parameters
        ----------
        impacts : Impacts
            N impacts, each on the whole body.

        Returns
        -------
        Response
            The piece of each atom, and the broken interfaces.
        """
        return pieces_from_broken(
            self.load_ratios(impacts) >= 1.0, self.cells, self.interfaces, self.min_piece_volume_fraction
        )

    def state(self) -> State:
        """Collect what a dataset keeps of the simulator beside its surface, cells and interfaces.

        Returns
        -------
        arrays : dict of ndarray
            The fine cells, the atom of each, and the tractions in single precision, which they have already.
        numbers : dict
            The gauge and the smallest piece.
        """
        arrays = {
            **solid_to_arrays(self.fine_cells, FINE),
            "fine_to_cell": self.fine_to_cell,
            "unit_tractions": self.unit_tractions.astype(np.float32),
        }
        return arrays, {"min_piece_volume_fraction": self.min_piece_volume_fraction, "gauge": self.gauge}

    @classmethod
    def restore(
        cls,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        arrays: Mapping[str, npt.NDArray[Any]],
        numbers: Mapping[str, Any],
    ) -> ElasticSimulator:
        """Make the simulator again that ``state`` was asked of.

        Parameters
        ----------
        surface : Surface
            As it was.
        cells : Solid
            The atoms.
        interfaces : Interfaces
            Between them.
        arrays, numbers : mapping
            What ``state`` gave.

        Returns
        -------
        ElasticSimulator
            It answers with the same bits.
        """
        return cls(
            surface,
            cells,
            interfaces,
            arrays["unit_tractions"].astype(np.float64),
            float(numbers["gauge"]),
            float(numbers["min_piece_volume_fraction"]),
            solid_from_arrays(arrays, FINE),
            arrays["fine_to_cell"],
        )


def single_impacts(surface: Surface, count: int, rng: np.random.Generator) -> Impacts:
    """Draw single impacts of unit severity.

    Parameters
    ----------
    surface : Surface
        What is struck.
    count : int
        How many impacts.
    rng : numpy.random.Generator
        The source of chance.

    Returns
    -------
    Impacts
        Uniform over the area, and over the cone about the inward normal.
    """
    points = SurfacePoints(surface.vertices, surface.faces)
    face, barycentric = points.draw(count, rng)
    directions = cone(-points.normals[face], CONE, rng)
    return Impacts(face[:, None], barycentric[:, None], directions[:, None], np.ones((count, 1)))
