"""TODO simulators.modal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError
from ..fracture.rule import Interfaces, load_ratios
from ..geometry.sampling import SurfacePoints
from ..solids.cut import cut_lattice
from ..solids.polygons import coarsen
from ..solids.solid import Solid, relabel
from ..solids.surface import Surface
from .base import Impacts, Response, critical_load_factor, interfaces_between, pieces_from_broken
from .diffusion import impact_field
from .fracture_modes import Modes, atoms_from_modes, fracture_modes


@dataclass(frozen=True, eq=False)
class ModalSimulator:
    """Fracture modes (Sellán et al. 2022), momentum diffusion and the breaking rule of ``breaking.drives``.

    cells: the fine solid; atom: (C,), the atom of each cell; parts: the atoms. rows: (V, A), the impact field at
    each vertex. min_piece_volume_fraction: fraction of the volume below which a piece joins a neighbour.
    energies: per mode, its fracture energy after each iteration.
    """

    surface: Surface
    fine_cells: Solid
    fine_to_cell: IntArray
    cells: Solid
    interfaces: Interfaces
    impact_field: FloatArray
    min_piece_volume_fraction: float
    energies: tuple[tuple[float, ...], ...]
    fixed_cracks: bool = True

    @cached_property
    def points(self) -> SurfacePoints:
        return SurfacePoints(self.surface.vertices, self.surface.faces)

    def load_ratios(self, impacts: Impacts) -> FloatArray:
        """(N, I) effective jumps across the interfaces, 1 being what breaks them; proportional to severity."""
        field = self.points.rows(self.impact_field, impacts.faces, impacts.barycentric)
        return load_ratios(field, impacts.directions, impacts.severities, self.interfaces)

    def thresholds(self, impacts: Impacts) -> FloatArray:
        return critical_load_factor(self.load_ratios(impacts), self.cells, self.interfaces)

    def fracture(self, impacts: Impacts) -> Response:
        return pieces_from_broken(
            self.load_ratios(impacts) >= 1.0, self.cells, self.interfaces, self.min_piece_volume_fraction
        )


def modal_simulator(
    surface: Surface,
    rng: np.random.Generator,
    cells: int = 5000,
    modes: int = 20,
    min_piece_volume_fraction: float = 1e-3,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> ModalSimulator:
    """Build the default truth of a surface; ``progress`` hears the stage and its share done.

    cells: of the solid, about. modes: fracture modes. Raises BakeError when the surface cannot be cut into cells
    or no mode parts it.
    """
    progress("solid", 0.0)
    solid = cut_lattice(surface, cells, rng)
    progress("modes", 0.0)
    found = fracture_modes(solid, modes, lambda share: progress("modes", share))
    progress("atoms", 0.0)
    return modal_from_solid(surface, solid, found, min_piece_volume_fraction, progress)


def modal_from_solid(
    surface: Surface,
    cells: Solid,
    modes: Modes,
    min_piece_volume_fraction: float,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> ModalSimulator:
    """The modal truth of a solid whose modes are known."""
    atom = atoms_from_modes(cells, modes)
    parts = coarsen(relabel(cells, atom), surface)
    joints = interfaces_between(parts)
    if len(joints) == 0:
        raise BakeError(f"{surface.name}: no fracture mode parts it; raise the number of modes or cells")
    progress("impact", 0.0)
    rows = impact_field(cells, atom, surface.vertices)
    return ModalSimulator(surface, cells, atom, parts, joints, rows, min_piece_volume_fraction, modes.objectives)
