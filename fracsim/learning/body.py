"""TODO learning.body."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from ..common.arrays import Float32Array, FloatArray, IntArray
from ..common.errors import DatasetError
from ..data.dataset import Dataset
from ..data.samples import Samples
from ..fracture.atom_watershed import AtomWatershed
from ..fracture.predictor import field_of_labels
from ..fracture.rule import Interfaces
from ..geometry.complex import vertex_cells
from ..solids.geodesics import CAP, CurveDistances, interface_distances, split_in_four
from ..solids.spectrum import Spectrum, spectrum
from ..solids.surface import Surface
from ..solids.walls import facing_vertices
from .atoms import Atoms, atoms_for


@dataclass(frozen=True, eq=False)
class BodyGeometry:
    """What a model may know of a body: its shape, and where cracks can run in it; never how it answers an impact.

    surface: of largest extent 1, with V vertices and E edges. atoms: A building blocks of its pieces, and the I
    interfaces between them. distances: (I, V + E) float32, geodesic, from each interface's curve to the vertices and
    then the edge midpoints, capped at CAP. interface_vertices: (I, S) vertices along the curves.
    """

    surface: Surface
    atoms: Atoms
    distances: Float32Array
    interface_vertices: IntArray

    @classmethod
    def of(cls, surface: Surface, atoms: Atoms, progress: Callable[[float], None] = lambda _: None) -> Self:
        curves = CurveDistances(atoms.solid, surface)
        distances, interface_vertices = interface_distances(curves, atoms.interfaces.pairs, progress)
        return cls(surface, atoms, distances.astype(np.float32), interface_vertices)

    @classmethod
    def read(cls, dataset: Dataset, progress: Callable[[float], None] = lambda _: None) -> tuple[Self, Samples]:
        """The body of a dataset, and its samples in terms of the body's atoms."""
        simulator = dataset.simulator
        if simulator is None:
            raise DatasetError(f"{dataset.path}: holds no simulator, which says what the body is made of")
        samples = dataset.samples()
        if not len(samples):
            raise DatasetError(f"{dataset.path}: holds no samples; make some with: fracsim dataset make")
        floor = float(dataset.header["simulator"]["min_piece_volume_fraction"])
        atoms = atoms_for(simulator, [] if simulator.fixed_cracks else [samples.take(slice(2 * dataset.block))], floor)
        return cls.of(dataset.surface, atoms, progress), atoms.project(samples)

    @property
    def vertices(self) -> FloatArray:
        return self.surface.vertices

    @property
    def faces(self) -> IntArray:
        return self.surface.faces

    @property
    def interfaces(self) -> Interfaces:
        return self.atoms.interfaces

    @property
    def volumes(self) -> FloatArray:
        return self.atoms.solid.volumes

    @cached_property
    def vertex_atom(self) -> IntArray:
        """(V,) the atom of each vertex."""
        parts = self.atoms.solid
        return vertex_cells(parts.triangles, parts.sides, len(parts.points))[: len(self.vertices)]

    @cached_property
    def split(self) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """``udf.split_in_four`` of the surface."""
        return split_in_four(self.surface)

    @property
    def nodes(self) -> FloatArray:
        """(V + E, 3): the vertices, then the midpoints of ``edges``."""
        return self.split[0]

    @property
    def edges(self) -> IntArray:
        """(E, 2) in lexicographic order."""
        return self.split[2]

    @cached_property
    def links(self) -> IntArray:
        """(L, 2) vertices that face each other through a thin wall."""
        return facing_vertices(self.surface)

    @cached_property
    def atom_watershed(self) -> AtomWatershed:
        distances = self.distances[:, : len(self.vertices)]
        return AtomWatershed.of(
            self.interface_vertices, distances, self.interfaces.pairs, self.interfaces.areas, len(self.volumes)
        )

    def spectrum(self, count: int, radii: Sequence[float]) -> Spectrum:
        return spectrum(self.atoms.fine_cells, self.atoms.fine_to_atom, self.surface, count, radii)

    def fields(self, labels: IntArray, nodes: bool = False) -> Float32Array:
        """(N, V) the true fields of fractures that leave the atoms labels (N, A): the least distance to an interface
        that parts two pieces. nodes: (N, V + E), at the edge midpoints as well."""
        distances = self.distances if nodes else self.distances[:, : len(self.vertices)]
        fields = [field_of_labels(row, self.interfaces.pairs, distances, CAP) for row in labels]
        return np.array(fields, dtype=np.float32).reshape(len(labels), distances.shape[1])
