"""What a model may know of a body: its shape, and where cracks can run in it; never how it answers an impact.

Every model is fitted to a ``BodyGeometry``; baking, training and evaluation make one.
"""

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
from .atoms import OBSERVED_BLOCKS, Atoms, atoms_for


@dataclass(frozen=True, eq=False)
class BodyGeometry:
    """A body with V vertices, E edges, A atoms and I interfaces between them.

    Attributes
    ----------
    surface : Surface
        Of largest extent 1.
    atoms : Atoms
        The building blocks of pieces.
    distances : ndarray of float32, shape (I, V + E)
        Geodesic distance from the curve of each interface to the vertices, then the edge midpoints, in units of the
        largest extent, capped at CAP.
    interface_vertices : ndarray of int64, shape (I, S)
        Vertices along each curve.
    """

    surface: Surface
    atoms: Atoms
    distances: Float32Array
    interface_vertices: IntArray

    @classmethod
    def of(cls, surface: Surface, atoms: Atoms, progress: Callable[[float], None] = lambda _: None) -> Self:
        """Measure a body.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        atoms : Atoms
            Its building blocks.
        progress : callable
            Called with the share that is done.

        Returns
        -------
        BodyGeometry
            The body.
        """
        curves = CurveDistances(atoms.solid, surface)
        distances, interface_vertices = interface_distances(curves, atoms.interfaces.pairs, progress)
        return cls(surface, atoms, distances.astype(np.float32), interface_vertices)

    @classmethod
    def read(cls, dataset: Dataset, progress: Callable[[float], None] = lambda _: None) -> tuple[Self, Samples]:
        """Measure the body of a dataset.

        Parameters
        ----------
        dataset : Dataset
            Open, with samples and a simulator.
        progress : callable
            Called with the share that is done.

        Returns
        -------
        tuple
            The body, and the dataset's samples in terms of its atoms.

        Raises
        ------
        DatasetError
            Where the dataset holds no samples, or its simulator is not known here.
        """
        simulator = dataset.simulator
        if simulator is None:
            name = dataset.header["simulator"]["name"]
            raise DatasetError(
                f"{dataset.path}: its simulator ({name}) is not registered, and only the simulator says what the body "
                "is made of; import what registers it, with: fracsim --import MODULE"
            )
        samples = dataset.samples()
        if not len(samples):
            raise DatasetError(f"{dataset.path}: holds no samples; make some with: fracsim dataset make")
        smallest = float(dataset.header["simulator"]["min_piece_volume_fraction"])
        observed = [] if simulator.fixed_cracks else [samples.take(slice(OBSERVED_BLOCKS * dataset.block))]
        atoms = atoms_for(simulator, observed, smallest)
        return cls.of(dataset.surface, atoms, progress), atoms.project(samples)

    @property
    def vertices(self) -> FloatArray:
        """The surface's vertices, (V, 3)."""
        return self.surface.vertices

    @property
    def faces(self) -> IntArray:
        """The surface's faces, (F, 3)."""
        return self.surface.faces

    @property
    def interfaces(self) -> Interfaces:
        """The I interfaces between atoms."""
        return self.atoms.interfaces

    @property
    def volumes(self) -> FloatArray:
        """The volume of each atom, (A,), in units of the largest extent cubed."""
        return self.atoms.solid.volumes

    @cached_property
    def vertex_atom(self) -> IntArray:
        """The atom of each vertex, (V,)."""
        solid = self.atoms.solid
        return vertex_cells(solid.triangles, solid.sides, len(solid.points))[: len(self.vertices)]

    @cached_property
    def split(self) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """The surface with each face split in four, see ``solids.geodesics.split_in_four``."""
        return split_in_four(self.surface)

    @property
    def nodes(self) -> FloatArray:
        """The vertices, then the midpoints of ``edges``, (V + E, 3)."""
        return self.split[0]

    @property
    def edges(self) -> IntArray:
        """The edges in lexicographic order, (E, 2)."""
        return self.split[2]

    @cached_property
    def links(self) -> IntArray:
        """Vertices that face each other through a thin wall, (L, 2)."""
        return facing_vertices(self.surface)

    @cached_property
    def atom_watershed(self) -> AtomWatershed:
        """The watershed over the atoms that takes fields apart."""
        distances = self.distances[:, : len(self.vertices)]
        return AtomWatershed.of(
            self.interface_vertices, distances, self.interfaces.pairs, self.interfaces.areas, len(self.volumes)
        )

    def spectrum(self, count: int, radii: Sequence[float]) -> Spectrum:
        """Find eigenfunctions of the solid's Laplacian.

        Parameters
        ----------
        count : int
            Eigenfunctions.
        radii : sequence of float
            Of the patches that they are averaged over at the surface, in units of the largest extent.

        Returns
        -------
        Spectrum
            See ``solids.spectrum.spectrum``.
        """
        return spectrum(self.atoms.fine_cells, self.atoms.fine_to_atom, self.surface, count, radii)

    def fields(self, labels: IntArray, nodes: bool = False) -> Float32Array:
        """Work out the exact fields of fractures, see ``fracture.predictor.field_of_labels``.

        Parameters
        ----------
        labels : ndarray of int64, shape (N, A)
            The piece of each atom.
        nodes : bool
            Whether edge midpoints are wanted as well.

        Returns
        -------
        ndarray of float32, shape (N, V) or (N, V + E)
            The distance to the nearest interface between two pieces, in units of the largest extent, capped at CAP.
        """
        distances = self.distances if nodes else self.distances[:, : len(self.vertices)]
        fields = [field_of_labels(row, self.interfaces.pairs, distances, CAP) for row in labels]
        return np.array(fields, dtype=np.float32).reshape(len(labels), distances.shape[1])
