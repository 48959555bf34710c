"""The default simulator: fracture modes cut a body into atoms, and impacts break the interfaces between them.

It joins ``fracture_modes``, ``diffusion`` and the breaking rule of ``fracture.rule``. Offline only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError
from ..fracture.rule import Interfaces, load_ratios
from ..geometry.sampling import SurfacePoints
from ..solids.cut import cut_lattice
from ..solids.polygons import coarsen
from ..solids.solid import Solid, relabel, solid_from_arrays, solid_to_arrays
from ..solids.surface import Surface
from .base import (
    Impacts,
    Progress,
    Response,
    State,
    critical_load_factor,
    interfaces_between,
    no_progress,
    pieces_from_broken,
)
from .diffusion import impact_field
from .fracture_modes import Modes, atoms_from_modes, fracture_modes
from .registry import SimulatorOptions

FINE = "fine_cells/"  # what the fine solid's arrays are called in a state


@dataclass(frozen=True, eq=False)
class ModalSimulator:
    """Fracture modes, momentum diffusion, and the breaking rule of ``fracture.rule.load_ratios``.

    Its cells are atoms: the smallest regions that can come off. An interface is where two atoms meet. Game engines
    call them support chunks and bonds.

    Attributes
    ----------
    surface : Surface
        The body's surface, of largest extent 1, with V vertices.
    fine_cells : Solid
        The F cells that the modes were computed on.
    fine_to_cell : ndarray of int64, shape (F,)
        The atom of each fine cell.
    cells : Solid
        The A atoms.
    interfaces : Interfaces
        The I interfaces between them.
    impact_field : ndarray of float64, shape (V, A)
        How a unit impact at each vertex spreads over the atoms.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the body's volume, join a neighbour.
    energies : tuple of tuple of float
        For each mode, its fracture energy after each iteration.

    References
    ----------
    Sellán, Luong, Mattos Da Silva, Ramakrishnan, Yang, Jacobson: *Breaking Good: Fracture Modes for Realtime
    Destruction*, 2022.
    """

    options_type: ClassVar[type[SimulatorOptions]] = SimulatorOptions
    fixed_cracks: ClassVar[bool] = True
    repeatable: ClassVar[bool] = True
    driven_by_impact_field: ClassVar[bool] = True
    severity_kind: ClassVar[str] = "impulse"

    surface: Surface
    fine_cells: Solid
    fine_to_cell: IntArray
    cells: Solid
    interfaces: Interfaces
    impact_field: FloatArray
    min_piece_volume_fraction: float
    energies: tuple[tuple[float, ...], ...]

    @classmethod
    def build(
        cls,
        surface: Surface,
        options: SimulatorOptions,
        rng: np.random.Generator,
        progress: Progress = no_progress,
    ) -> ModalSimulator:
        """Cut a surface into cells, find its modes, and make atoms of them.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        options : SimulatorOptions
            Cells, modes and the smallest piece.
        rng : numpy.random.Generator
            Places the lattice that cuts the cells.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        ModalSimulator
            Of the surface.

        Raises
        ------
        BakeError
            If the surface cannot be cut into cells, or no mode parts it.
        """
        progress("solid", 0.0)
        solid = cut_lattice(surface, options.cells, rng)
        progress("modes", 0.0)
        modes = fracture_modes(solid, options.modes, lambda share: progress("modes", share))
        progress("atoms", 0.0)
        return cls.from_modes(surface, solid, modes, options.min_piece_volume_fraction, progress)

    @classmethod
    def from_modes(
        cls,
        surface: Surface,
        fine_cells: Solid,
        modes: Modes,
        min_piece_volume_fraction: float = 1e-3,
        progress: Progress = no_progress,
    ) -> ModalSimulator:
        """Make the simulator of a solid whose modes are known.

        Parameters
        ----------
        surface : Surface
            The solid's outside.
        fine_cells : Solid
            Of F cells.
        modes : Modes
            Of those cells.
        min_piece_volume_fraction : float
            Smaller pieces, as fractions of the body's volume, join a neighbour.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        ModalSimulator
            Of the surface.

        Raises
        ------
        BakeError
            If no mode parts the solid.
        """
        fine_to_cell = atoms_from_modes(fine_cells, modes)
        atoms = coarsen(relabel(fine_cells, fine_to_cell), surface)
        interfaces = interfaces_between(atoms)
        if len(interfaces) == 0:
            raise BakeError(f"{surface.name}: no fracture mode parts it; raise the number of modes or cells")
        progress("impact", 0.0)
        field = impact_field(fine_cells, fine_to_cell, surface.vertices)
        return cls(
            surface, fine_cells, fine_to_cell, atoms, interfaces, field, min_piece_volume_fraction, modes.objectives
        )

    @cached_property
    def points(self) -> SurfacePoints:
        """Points anywhere on the surface."""
        return SurfacePoints(self.surface.vertices, self.surface.faces)

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
        field = self.points.rows(self.impact_field, impacts.faces, impacts.barycentric)
        return load_ratios(field, impacts.directions, impacts.severities, self.interfaces)

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

    def figures(self) -> dict[str, Any]:
        """Collect what an asset's metadata says of the simulator.

        Returns
        -------
        dict
            ``mode_energies``: the fracture energy of each mode.
        """
        return {"mode_energies": [history[-1] for history in self.energies]}

    def state(self) -> State:
        """Collect what a dataset keeps of the simulator beside its surface, cells and interfaces.

        Returns
        -------
        arrays : dict of ndarray
            The fine cells, the atom of each, and the impact field.
        numbers : dict
            The smallest piece and the energies.
        """
        arrays = {
            **solid_to_arrays(self.fine_cells, FINE),
            "fine_to_cell": self.fine_to_cell,
            "impact_field": self.impact_field,
        }
        return arrays, {
            "min_piece_volume_fraction": self.min_piece_volume_fraction,
            "energies": [list(history) for history in self.energies],
        }

    @classmethod
    def restore(
        cls,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        arrays: Mapping[str, npt.NDArray[Any]],
        numbers: Mapping[str, Any],
    ) -> ModalSimulator:
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
        ModalSimulator
            It answers with the same bits.
        """
        return cls(
            surface,
            solid_from_arrays(arrays, FINE),
            arrays["fine_to_cell"],
            cells,
            interfaces,
            arrays["impact_field"],
            float(numbers["min_piece_volume_fraction"]),
            tuple(tuple(history) for history in numbers["energies"]),
        )
