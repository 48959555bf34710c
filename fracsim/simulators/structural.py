"""The physical simulator: stress softens all faces of a lattice at once, and pieces are what still holds together.

It joins ``voronoi``, ``lattice`` and ``softening``. Its answers follow from elasticity, strength and toughness alone,
and change little when an impact moves a little, so they can be learned; ``sequential`` is the reference for single
cracks. Offline only.
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
from ..common.errors import BakeError
from ..fracture.rule import Interfaces, components, separated
from ..solids.polygons import coarsen
from ..solids.solid import Solid, merge_small_regions, relabel, solid_from_arrays, solid_to_arrays
from ..solids.surface import Surface
from ..solids.voronoi import centroidal_seeds, voronoi_solid
from .base import Impacts, Progress, Response, State, interfaces_between, no_progress
from .lattice import Lattice
from .lattice_build import lattice_of, vertex_compliances
from .lattice_faces import cell_faces
from .lattice_options import LatticeOptions, material_options
from .piece_reading import PieceReading
from .softening import Softening

FINE = "fine_cells/"  # what the cells' arrays are called in a state
LLOYD_STEPS = 59
BISECTIONS = 6  # of the interval between 1 and 1.5 times some factor, for a threshold
GROWTH = 1.5  # of the factor, while the body holds
LARGEST_FACTOR = 200.0  # times the one at which a first crack opens; what still holds then does not break


@dataclass(frozen=True)
class StructuralOptions(LatticeOptions):
    """What ``StructuralSimulator`` is built with.

    Attributes
    ----------
    atoms : int
        About how many atoms, the smallest regions that come off, the cells are grouped into; at least 2.

    Raises
    ------
    BakeError
        If a value is out of range.
    """

    atoms: int = 48

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (isinstance(self.atoms, int) and self.atoms >= 2):
            raise BakeError(f"atoms must be a whole number and at least 2, got {self.atoms}")


@dataclass(frozen=True, eq=False)
class StructuralSimulator:
    """Simultaneous softening of a lattice of rigid cells and springs.

    Attributes
    ----------
    surface : Surface
        The body's surface, of largest extent 1, with V vertices.
    fine_cells : Solid
        The N cells of the lattice.
    fine_to_cell : ndarray of int64, shape (N,)
        The atom of each.
    cells : Solid
        The A atoms, which labels speak of.
    interfaces : Interfaces
        The I interfaces between them.
    softening : Softening
        What softens the lattice.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the body's volume, join a neighbour.
    """

    options_type: ClassVar[type[LatticeOptions]] = StructuralOptions
    fixed_cracks: ClassVar[bool] = True
    repeatable: ClassVar[bool] = True
    driven_by_impact_field: ClassVar[bool] = False
    severity_kind: ClassVar[str] = "force"
    default_samples: ClassVar[int] = 5000

    surface: Surface
    fine_cells: Solid
    fine_to_cell: IntArray
    cells: Solid
    interfaces: Interfaces
    softening: Softening
    min_piece_volume_fraction: float

    material_options = staticmethod(material_options)

    @classmethod
    def build(
        cls,
        surface: Surface,
        options: StructuralOptions,
        rng: np.random.Generator,
        progress: Progress = no_progress,
    ) -> StructuralSimulator:
        """Divide a surface into cells, and group these into atoms.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        options : StructuralOptions
            Cells, atoms, the smallest piece, and what follows from the material.
        rng : numpy.random.Generator
            Places the cells.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        StructuralSimulator
            Of the surface.

        Raises
        ------
        BakeError
            If the surface cannot be divided.
        """
        progress("cells", 0.0)
        fine = voronoi_solid(surface, options.cells, rng)
        progress("lattice", 0.0)
        lattice = lattice_of(surface, fine, options)
        faces = lattice.faces
        floor = max(options.min_piece_volume_fraction, 1.0 / (3.0 * options.atoms)) * float(fine.volumes.sum())
        atom = group_cells(fine, faces.pairs, faces.areas, options.atoms, floor, rng)
        if atom.max() == 0:
            raise BakeError(f"{surface.name}: all its cells are one atom; raise the number of atoms or cells")
        cells = coarsen(relabel(fine, atom), surface)
        softening = Softening(lattice, options.brittleness, options.strain, options.hertz)
        return cls(surface, fine, atom, cells, interfaces_between(cells), softening, options.min_piece_volume_fraction)

    @property
    def lattice(self) -> Lattice:
        """The lattice of the fine cells."""
        return self.softening.lattice

    @cached_property
    def compliance(self) -> FloatArray:
        """(V,), of the vertices (``ContactCompliance``)."""
        return vertex_compliances(self.surface, self.lattice)

    @cached_property
    def reading(self) -> PieceReading:
        """How pieces are read off what is left of the lattice."""
        volumes, smallest = self.fine_cells.volumes, self.min_piece_volume_fraction
        atoms = self.cells.volumes
        return PieceReading(self.lattice.faces, volumes, self.fine_to_cell, atoms, self.interfaces, smallest)

    def stiffness_left(self, impacts: Impacts) -> FloatArray:
        """Soften the body by each impact.

        Parameters
        ----------
        impacts : Impacts
            N impacts; severities are peak forces over strength times L².

        Returns
        -------
        ndarray of float64, shape (N, I)
            The mean share of its stiffness that is left of each interface; 0 where the lattice has come apart and the
            two atoms have gone with different parts of it.
        """
        result = np.empty((len(impacts), len(self.interfaces)))
        for row, (forces, severities) in enumerate(zip(self._forces(impacts), impacts.severities, strict=True)):
            result[row] = self.reading.left_of_interfaces(self.softening.run(forces, severities))
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
            The least factor on each impact's severities at which the body falls into two pieces, to 1 %; infinite where
            a force far above that of a first crack does not break it.

        See Also
        --------
        first_crack : what no smaller factor can be, for one solution of the body.
        """
        result = np.full(len(impacts), np.inf)
        for row, (forces, severities) in enumerate(zip(self._forces(impacts), impacts.severities, strict=True)):

            def breaks(factor: float, forces: FloatArray = forces, severities: FloatArray = severities) -> bool:
                left = self.softening.run(factor * forces, factor * severities)
                return bool(self.reading.pieces(self.reading.left_of_interfaces(left)).any())

            low = high = first = self._first_crack(forces)
            while not (broken := breaks(high)) and high < LARGEST_FACTOR * first:
                low, high = high, GROWTH * high
            if broken:
                for _ in range(BISECTIONS if low < high else 0):
                    middle = float(np.sqrt(low * high))
                    low, high = (low, middle) if breaks(middle) else (middle, high)
                result[row] = high
        return result

    def first_crack(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to open a first crack.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            The least factor on each impact's severities at which some face is pulled to what it can bear.
        """
        return np.array([self._first_crack(forces) for forces in self._forces(impacts)])

    def _first_crack(self, forces: FloatArray) -> float:
        """Find the factor on forces (6 N,) at which a first face opens."""
        lattice = self.lattice
        tension, _, _ = lattice.tension(lattice.jumps(lattice.intact.solve(forces)), lattice.whole)
        return 1.0 / max(float((tension / self.softening.onset_strength).max()), 1e-300)

    def fracture(self, impacts: Impacts) -> Response:
        """Break the body by each impact.

        Parameters
        ----------
        impacts : Impacts
            N impacts, each on the whole body.

        Returns
        -------
        Response
            The piece of each atom, and the interfaces between pieces.
        """
        left = self.stiffness_left(impacts)
        labels = np.array([self.reading.pieces(row) for row in left]).reshape(len(impacts), len(self.cells.volumes))
        broken = np.array([separated(row, self.interfaces.pairs) for row in labels], dtype=bool)
        return Response(labels, broken.reshape(left.shape))

    def _forces(self, impacts: Impacts) -> FloatArray:
        """Spread the contacts' forces (N, 6 cells)."""
        return self.lattice.forces(impacts, impacts.points(self.surface))

    def state(self) -> State:
        """Collect what a dataset keeps of the simulator beside its surface, cells and interfaces.

        Returns
        -------
        arrays : dict of ndarray
            The fine cells and the atom of each.
        numbers : dict
            What follows from the material, and the smallest piece.
        """
        softening = self.softening
        return {**solid_to_arrays(self.fine_cells, FINE), "fine_to_cell": self.fine_to_cell}, {
            "brittleness": softening.brittleness,
            "strain": softening.strain,
            "hertz": softening.hertz,
            "speed_number": self.lattice.speed_number,
            "min_piece_volume_fraction": self.min_piece_volume_fraction,
        }

    @classmethod
    def restore(
        cls,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        arrays: Mapping[str, npt.NDArray[Any]],
        numbers: Mapping[str, Any],
    ) -> StructuralSimulator:
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
        StructuralSimulator
            It answers with the same bits.
        """
        fine = solid_from_arrays(arrays, FINE)
        lattice = Lattice(fine, cell_faces(fine), float(numbers["speed_number"]))
        softening = Softening(lattice, float(numbers["brittleness"]), float(numbers["strain"]), float(numbers["hertz"]))
        return cls(
            surface,
            fine,
            arrays["fine_to_cell"],
            cells,
            interfaces,
            softening,
            float(numbers["min_piece_volume_fraction"]),
        )


def group_cells(
    solid: Solid, pairs: IntArray, areas: FloatArray, count: int, floor: float, rng: np.random.Generator
) -> IntArray:
    """Group the cells of a solid into connected regions of about as many cells each.

    Parameters
    ----------
    solid : Solid
        Of N cells.
    pairs : ndarray of int64, shape (I, 2)
        Which of them meet.
    areas : ndarray of float64, shape (I,)
        What they share.
    count : int
        About how many regions.
    floor : float
        Volume that every region has, at least.
    rng : numpy.random.Generator
        Where the regions begin.

    Returns
    -------
    ndarray of int64, shape (N,)
        The region of each cell.

    Notes
    -----
    Lloyd's iteration over the cells' centroids, each weighted by the root of its volume: between regions of as many
    cells and regions of as much volume, so that they are smaller where walls are thin.
    """
    centroids, weight = solid.centroids, np.sqrt(solid.volumes)
    count = min(count, len(centroids))
    begin = centroids[rng.choice(len(centroids), count, replace=False, p=weight / weight.sum())]
    _, nearest = cKDTree(centroidal_seeds(begin, centroids, weight, LLOYD_STEPS)).query(centroids)
    region = components((nearest[pairs[:, 0]] == nearest[pairs[:, 1]])[None], pairs, len(centroids))[0]
    return merge_small_regions(solid.volumes, pairs, areas, floor, region)
