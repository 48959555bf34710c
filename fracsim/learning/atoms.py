"""Atoms: the building blocks of pieces, whatever truth says how these form. Offline only.

Modes bring their own atoms. A truth that cuts its cells freely has none, so its atoms are found in what it does:
cells that its fractures keep together belong together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ..common.arrays import IntArray
from ..common.errors import BakeError, MissingExtraError
from ..data.samples import Samples, sample_block
from ..fracture.rule import Interfaces, separated
from ..simulators.base import FractureSimulator, interfaces_between, pieces_from_broken
from ..simulators.fracture_modes import ATOM_FLOOR
from ..solids.polygons import coarsen
from ..solids.solid import Solid, merge_small_regions, relabel, shared_faces

try:
    from sklearn.cluster import AgglomerativeClustering
    from sklearn.random_projection import GaussianRandomProjection
except ImportError as error:
    raise MissingExtraError("scikit-learn", "bake") from error


OBSERVED = 150  # atoms of a truth that has none of its own
OBSERVED_KEPT = 2  # blocks of its fractures that they are found in
DIMENSIONS = 64  # in which fractures are compared


@dataclass(frozen=True, eq=False)
class Atoms:
    """cells: the fine solid. atom: (C,), the atom of each cell. parts: the atoms, with the surface for outside.
    interfaces: between them. own: whether the truth's labels speak of these very atoms."""

    fine_cells: Solid
    fine_to_atom: IntArray
    solid: Solid
    interfaces: Interfaces
    are_the_simulators: bool
    min_piece_volume_fraction: float

    def project(self, samples: Samples) -> Samples:
        """The samples in terms of atoms: each takes the label that most of its volume has, and an atom cut off from
        the rest of its piece is a piece of its own."""
        if self.are_the_simulators:
            if samples.broken.shape[1]:
                return samples
            return replace(samples, broken=separated(samples.labels, self.interfaces.pairs))
        count = len(self.solid.volumes)
        labels = samples.labels
        width = int(labels.max()) + 1
        votes = np.empty((len(labels), count), dtype=np.int64)
        for row, label in enumerate(labels):
            weight = np.bincount(self.fine_to_atom * width + label, self.fine_cells.volumes, minlength=count * width)
            votes[row] = weight.reshape(count, width).argmax(axis=1)
        broken = separated(votes, self.interfaces.pairs)
        merged = pieces_from_broken(broken, self.solid, self.interfaces, self.min_piece_volume_fraction).labels
        return replace(samples, labels=merged, broken=separated(merged, self.interfaces.pairs))


def observe_fractures(simulator: FractureSimulator, seed: int) -> list[Samples]:
    """The first blocks of a truth that has no atoms of its own, for ``atoms_for``; none of any other."""
    return [] if simulator.fixed_cracks else [sample_block(simulator, seed, block) for block in range(OBSERVED_KEPT)]


def atoms_for(simulator: FractureSimulator, watched: list[Samples], min_piece_volume_fraction: float) -> Atoms:
    """The simulator's own atoms where its cracks are fixed, or those seen in the training fractures ``watched``."""
    parts = simulator.cells
    if simulator.fixed_cracks:
        cells, atom = getattr(simulator, "fine_cells", None), getattr(simulator, "fine_to_cell", None)
        if not (isinstance(cells, Solid) and isinstance(atom, np.ndarray) and len(atom) == len(cells.volumes)):
            cells, atom = parts, np.arange(len(parts.volumes))
        return Atoms(cells, atom, parts, interfaces_between(parts), True, min_piece_volume_fraction)
    labels = np.concatenate([block.labels[block.split == 0] for block in watched])
    if not labels.any():
        raise BakeError(f"{simulator.surface.name}: no fracture of its truth parts it")
    atom = observed_atoms(parts, labels[labels.any(axis=1)], OBSERVED)
    blocks = coarsen(relabel(parts, atom), simulator.surface)
    interfaces = interfaces_between(blocks)
    if len(interfaces) == 0:
        raise BakeError(f"{simulator.surface.name}: no fracture of its truth parts it")
    return Atoms(parts, atom, blocks, interfaces, False, min_piece_volume_fraction)


def observed_atoms(cells: Solid, labels: IntArray, count: int) -> IntArray:
    """(C,) about ``count`` connected groups of cells that fractures seldom part.

    labels: (N, C). Ward's clustering among neighbouring cells; two cells are as far apart as the number of fractures
    that part them, kept up to a few per cent by a random projection.
    """
    pairs, areas, _ = shared_faces(cells.triangles, cells.sides, cells.points)
    total = len(cells.volumes)
    offset = np.concatenate([[0], np.cumsum(labels.max(axis=1) + 1)])
    columns = (labels + offset[:-1, None]).T.ravel()  # a column for every piece of every fracture
    rows = np.repeat(np.arange(total), len(labels))
    member = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(total, int(offset[-1])))
    points = GaussianRandomProjection(DIMENSIONS, random_state=0).fit_transform(member)
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(total, total))
    ward = AgglomerativeClustering(min(count, total), connectivity=graph + graph.T, linkage="ward")
    group = ward.fit_predict(points).astype(np.int64)
    return merge_small_regions(cells.volumes, pairs, areas, ATOM_FLOOR * float(cells.volumes.sum()), group)
