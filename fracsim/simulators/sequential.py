"""The reference simulator: cracks grow face by face through a lattice, by strength and toughness. Offline only.

It joins ``voronoi``, ``lattice`` and ``sequential_impact``. Cracks run as they do in brittle bodies: they begin where
something is pulled to its strength, and run on where that releases the energy they cost. So it is right where a single
crack matters, and as chaotic as real cracks are: a body hit a hair's breadth away may break along other faces.
``structural`` gives up single cracks for answers that repeat themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..common.arrays import BoolArray, FloatArray
from ..common.errors import BakeError
from ..fracture.rule import Interfaces, components
from ..solids.solid import Solid
from ..solids.surface import Surface
from ..solids.voronoi import voronoi_solid
from .base import Impacts, Progress, Response, State, interfaces_between, merge_small_pieces_each, no_progress
from .lattice import Lattice
from .lattice_build import lattice_of, vertex_compliances
from .lattice_faces import cell_faces
from .lattice_options import LatticeOptions, material_options
from .sequential_cracks import Cracks, IntactBody
from .sequential_impact import Breaks, Contacts, Impact, Setting

ROUNDING = 1e-9  # of a factor: severities that are a threshold's break what it breaks


@dataclass(frozen=True, eq=False)
class SequentialSimulator:
    """Cracks one after the other in a lattice of rigid cells and springs.

    Attributes
    ----------
    surface : Surface
        The body's surface, of largest extent 1, with V vertices.
    cells : Solid
        The C cells of the lattice, which labels speak of.
    interfaces : Interfaces
        The I interfaces between them.
    lattice : Lattice
        Of the cells.
    setting : Setting
        What follows from the material, and the smallest piece: smaller ones join a neighbour.
    """

    options_type: ClassVar[type[LatticeOptions]] = LatticeOptions
    fixed_cracks: ClassVar[bool] = False
    repeatable: ClassVar[bool] = True
    driven_by_impact_field: ClassVar[bool] = False
    severity_kind: ClassVar[str] = "force"
    default_samples: ClassVar[int] = 500

    surface: Surface
    cells: Solid
    interfaces: Interfaces
    lattice: Lattice
    setting: Setting

    material_options = staticmethod(material_options)

    @classmethod
    def build(
        cls,
        surface: Surface,
        options: LatticeOptions,
        rng: np.random.Generator,
        progress: Progress = no_progress,
    ) -> SequentialSimulator:
        """Divide a surface into cells and join them with springs.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        options : LatticeOptions
            Cells, the smallest piece, and what follows from the material.
        rng : numpy.random.Generator
            Places the cells.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        SequentialSimulator
            Of the surface.

        Raises
        ------
        BakeError
            If the surface cannot be divided.
        """
        progress("cells", 0.0)
        cells = voronoi_solid(surface, options.cells, rng)
        if len(cells.volumes) < 2:
            raise BakeError(f"{surface.name}: all of it is one cell; raise the number of cells")
        progress("lattice", 0.0)
        lattice = lattice_of(surface, cells, options)
        smallest = options.min_piece_volume_fraction
        setting = Setting(options.brittleness, options.strain, options.hertz, smallest)
        return cls(surface, cells, interfaces_between(cells), lattice, setting)

    @cached_property
    def body(self) -> IntactBody:
        """The inverse of the lattice's system, which is not kept in a state."""
        return IntactBody(self.lattice)

    @cached_property
    def compliance(self) -> FloatArray:
        """(V,), of the vertices (``ContactCompliance``)."""
        return vertex_compliances(self.surface, self.lattice)

    def first_crack(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to open a first crack.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            The least factor on each impact's severities at which a face breaks.
        """
        result = np.empty(len(impacts))
        for row, forces in enumerate(self.lattice.forces(impacts, impacts.points(self.surface))):
            cracks = Cracks(self.body, self.setting.brittleness, forces)
            result[row] = cracks.bearable(cracks.jumps())[0].min()
        return result

    def thresholds(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to break the body.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            The least factor on each impact's severities at which the body falls into two pieces, exact; infinite where
            it turns to crumbs first.
        """
        result = np.full(len(impacts), np.inf)
        for row in range(len(impacts)):
            breaks = self.breaks(impacts, row, np.inf, self._parted)
            whole = breaks.whole(np.inf, len(self.interfaces))
            if self._parted(whole):
                result[row] = breaks.factors[-1]
        return result

    def fracture(self, impacts: Impacts) -> Response:
        """Break the body by each impact.

        Parameters
        ----------
        impacts : Impacts
            N impacts, each on the whole body.

        Returns
        -------
        Response
            The piece of each cell, and the broken faces.
        """
        whole = np.ones((len(impacts), len(self.interfaces)), dtype=bool)
        for row in range(len(impacts)):
            factor = 1.0 + ROUNDING
            whole[row] = self.breaks(impacts, row, factor).whole(factor, len(self.interfaces))
        return self.pieces(whole)

    def pieces(self, whole: BoolArray) -> Response:
        """Find the pieces that whole faces leave.

        Parameters
        ----------
        whole : ndarray of bool, shape (N, I)
            The faces that hold.

        Returns
        -------
        Response
            The piece of each cell, and the broken faces.
        """
        labels = components(whole, self.interfaces.pairs, len(self.cells.volumes))
        volumes, smallest = self.cells.volumes, self.setting.smallest
        return Response(merge_small_pieces_each(labels, volumes, self.interfaces, smallest), ~whole)

    def breaks(
        self, impacts: Impacts, row: int, largest: float, stop: Callable[[BoolArray], bool] | None = None
    ) -> Breaks:
        """Let one impact grow.

        Parameters
        ----------
        impacts : Impacts
            N impacts.
        row : int
            Which of them.
        largest : float
            The factor on its severities at which the ramp ends; may be infinite.
        stop : callable, optional
            As ``sequential_impact.Impact.run``.

        Returns
        -------
        Breaks
            The faces that break on the way, and the factor at which each does. What an impact breaks at a factor it
            breaks at any greater one.
        """
        acting = np.flatnonzero(impacts.severities[row] > 0.0)
        if not len(acting):
            return Breaks(np.empty(0, dtype=np.int64), np.empty(0))
        face = impacts.faces[row, acting]
        corner = self.surface.vertices[self.surface.faces[face]]
        points = np.einsum("kc,kci->ki", impacts.barycentric[row, acting], corner)
        cells = [self.lattice.cell_at(int(at), point) for at, point in zip(face, points, strict=True)]
        forces = impacts.severities[row, acting]
        contacts = Contacts(points, impacts.directions[row, acting], forces, np.array(cells, dtype=np.int64))
        return Impact(self.body, contacts, self.setting).run(largest, stop)

    def _parted(self, whole: BoolArray) -> bool:
        """Say whether whole faces (I,) leave more than one piece."""
        return bool(self.pieces(whole[None]).labels.any())

    def state(self) -> State:
        """Collect what a dataset keeps of the simulator beside its surface, cells and interfaces.

        Returns
        -------
        arrays : dict of ndarray
            None.
        numbers : dict
            What follows from the material, and the smallest piece.
        """
        setting = self.setting
        return {}, {
            "brittleness": setting.brittleness,
            "strain": setting.strain,
            "hertz": setting.hertz,
            "speed_number": self.lattice.speed_number,
            "min_piece_volume_fraction": setting.smallest,
        }

    @classmethod
    def restore(
        cls,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        arrays: Mapping[str, npt.NDArray[Any]],
        numbers: Mapping[str, Any],
    ) -> SequentialSimulator:
        """Make the simulator again that ``state`` was asked of.

        Parameters
        ----------
        surface : Surface
            As it was.
        cells : Solid
            As they were.
        interfaces : Interfaces
            Between them.
        arrays, numbers : mapping
            What ``state`` gave.

        Returns
        -------
        SequentialSimulator
            It answers with the same bits.
        """
        lattice = Lattice(cells, cell_faces(cells), float(numbers["speed_number"]))
        names = ("brittleness", "strain", "hertz", "min_piece_volume_fraction")
        return cls(surface, cells, interfaces, lattice, Setting(*(float(numbers[name]) for name in names)))
