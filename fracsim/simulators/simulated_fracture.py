"""What a simulator does to a body, as plain data in SI units; ``fracsim.Simulator`` answers with it. Offline only."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import FracsimError, MissingExtraError
from ..common.files import write_beside
from ..geometry.complex import CellComplex

try:
    import trimesh
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

FORMATS = (".glb", ".obj", ".ply", ".stl")  # of files that pieces are saved to


@dataclass(frozen=True, eq=False)
class SimulatedPiece:
    """A solid piece of a simulated fracture.

    Attributes
    ----------
    vertices : ndarray of float64, shape (N, 3)
        m.
    faces : ndarray of int64, shape (M, 3)
        Indices of vertices, outward and watertight.
    outer : ndarray of bool, shape (M,)
        Which faces lie on the body's surface; the others are cracks.
    mass : float
        kg.
    center_of_mass : ndarray of float64, shape (3,)
        m.
    """

    vertices: FloatArray
    faces: IntArray
    outer: BoolArray
    mass: float
    center_of_mass: FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedFracture:
    """What impulses do to a body, by a simulator; plain data, which pickles and copies.

    Attributes
    ----------
    labels : ndarray of int64, shape (V,)
        The piece of each vertex of the surface.
    cell_labels : ndarray of int64, shape (A,)
        The piece of each of the simulator's cells.
    volumes_of : ndarray of float64, shape (A,)
        m³, of the cells, whatever the pieces are.
    masses : ndarray of float64, shape (P,)
        kg, of the pieces.
    broken_area : float
        m², of the cracks between pieces, each projected on its mean plane.
    critical_factor : float
        The factor on the impulses at which the body first comes apart; infinite where it never does.
    severity : float
        The sum of the impulses' severities, without unit.
    cells : CellComplex
        The cells, in units of the body's largest extent.
    scale : float
        m, the largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the origin of these units lies.
    """

    labels: IntArray
    cell_labels: IntArray
    volumes_of: FloatArray
    masses: FloatArray
    broken_area: float
    critical_factor: float
    severity: float
    cells: CellComplex = field(repr=False)
    scale: float
    offset: FloatArray = field(repr=False)

    @property
    def broken(self) -> bool:
        """Whether there is more than one piece."""
        return len(self.masses) > 1

    @property
    def shares(self) -> FloatArray:
        """(P,) of the body's mass that each piece has, the largest first."""
        return np.sort(self.masses)[::-1] / self.masses.sum()

    @cached_property
    def pieces(self) -> tuple[SimulatedPiece, ...]:
        """The pieces, one for each label, read off the cells when first asked for."""
        volumes, first, _ = self.cells.moments()
        result = []
        for label, mass in enumerate(self.masses.tolist()):
            chosen = self.cell_labels == label
            vertices, faces, outer = self.cells.surface(chosen)
            center = first[chosen].sum(axis=0) / volumes[chosen].sum()
            points = (each * self.scale + self.offset for each in (vertices, center))
            vertices, center = points
            result.append(SimulatedPiece(vertices, faces, outer, mass, center))
        return tuple(result)

    def save(self, path: str | Path) -> None:
        """Write the pieces to a file, whole or not at all.

        Parameters
        ----------
        path : str or Path
            Of the format that its ending names: .glb or .obj, with an object for each piece, or .ply or .stl, with all
            of them in one.

        Raises
        ------
        FracsimError
            If the ending is another one, or the file cannot be written there.
        """
        path = Path(path)
        if path.suffix not in FORMATS:
            raise FracsimError(f"{path}: unknown ending {path.suffix!r}; use one of {', '.join(FORMATS)}")
        meshes = [trimesh.Trimesh(piece.vertices, piece.faces, process=False) for piece in self.pieces]
        if path.suffix in (".ply", ".stl"):
            scene: Any = trimesh.util.concatenate(meshes)
        else:
            named: Any = {f"piece_{index:03d}": mesh for index, mesh in enumerate(meshes)}
            scene = trimesh.Scene(named)
        data = scene.export(file_type=path.suffix[1:])
        write_beside(path, data if isinstance(data, bytes) else data.encode())
