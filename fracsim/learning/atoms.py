"""Atoms, the smallest regions of a body that can come off, whatever its simulator says of pieces. Offline only.

A simulator of fixed cracks brings its own atoms. Of one that cuts its cells freely, atoms are found in what it does:
cells that its fractures keep together belong together. Bodies and baking come in here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ..common.arrays import IntArray
from ..common.errors import BakeError, MissingExtraError
from ..data.samples import TRAINING_SPLIT, Samples, sample_block
from ..data.workers import run_blocks
from ..fracture.rule import Interfaces, separated
from ..simulators.base import FineCells, FractureSimulator, interfaces_between, pieces_from_broken
from ..simulators.fracture_modes import ATOM_FLOOR
from ..solids.polygons import coarsen
from ..solids.solid import Solid, merge_small_regions, relabel, shared_faces

try:
    from sklearn.cluster import AgglomerativeClustering
    from sklearn.random_projection import GaussianRandomProjection
except ImportError as error:
    raise MissingExtraError("scikit-learn", "bake") from error


OBSERVED = 150  # atoms that are found where a simulator has none of its own
OBSERVED_BLOCKS = 2  # blocks of its samples in which they are found
DIMENSIONS = 64  # of the random projection in which cells are compared: keeps distances to a few per cent


@dataclass(frozen=True, eq=False)
class Atoms:
    """A body as A atoms, made of C fine cells, with I interfaces between the atoms.

    Attributes
    ----------
    fine_cells : Solid
        The C fine cells.
    fine_to_atom : ndarray of int64, shape (C,)
        The atom of each fine cell.
    solid : Solid
        The A atoms; their outside is the surface.
    interfaces : Interfaces
        Where two atoms meet.
    are_the_simulators : bool
        Whether the simulator's labels speak of these very atoms.
    min_piece_volume_fraction : float
        Pieces of less than this fraction of the volume join a neighbour.
    """

    fine_cells: Solid
    fine_to_atom: IntArray
    solid: Solid
    interfaces: Interfaces
    are_the_simulators: bool
    min_piece_volume_fraction: float

    def project(self, samples: Samples) -> Samples:
        """Put samples in terms of the atoms.

        An atom takes the label that most of its volume has. An atom that is cut off from the rest of its piece is a
        piece of its own.

        Parameters
        ----------
        samples : Samples
            With labels of the simulator's cells, (N, C).

        Returns
        -------
        Samples
            With labels (N, A) and broken (N, I).
        """
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


def observe_fractures(simulator: FractureSimulator, seed: int, workers: int = 1) -> list[Samples]:
    """Draw the first blocks of samples of a simulator that has no atoms of its own, for ``atoms_for``.

    Parameters
    ----------
    simulator : FractureSimulator
        The simulator.
    seed : int
        Of the samples.
    workers : int
        Processes that draw them.

    Returns
    -------
    list of Samples
        The blocks; none where the simulator's cracks are fixed.
    """
    blocks = [] if simulator.fixed_cracks else list(range(OBSERVED_BLOCKS))
    return list(run_blocks(sample_block, simulator, seed, blocks, workers))


def atoms_for(simulator: FractureSimulator, observed: list[Samples], min_piece_volume_fraction: float) -> Atoms:
    """Find the atoms of a simulator's body.

    Parameters
    ----------
    simulator : FractureSimulator
        The simulator; where its cracks are fixed, its own cells are the atoms.
    observed : list of Samples
        Else, fractures whose training split the atoms are found in.
    min_piece_volume_fraction : float
        Pieces of less than this fraction of the volume join a neighbour.

    Returns
    -------
    Atoms
        The atoms.

    Raises
    ------
    BakeError
        Where no observed fracture breaks the body.
    """
    cells = simulator.cells
    if simulator.fixed_cracks:
        fine, atom = cells, np.arange(len(cells.volumes))
        if isinstance(simulator, FineCells):
            fine, atom = simulator.fine_cells, simulator.fine_to_cell
        return Atoms(fine, atom, cells, interfaces_between(cells), True, min_piece_volume_fraction)
    labels = np.concatenate([block.labels[block.split == TRAINING_SPLIT] for block in observed])
    if not labels.any():
        raise BakeError(f"{simulator.surface.name}: no fracture of its simulator breaks it; use another simulator")
    atom = observed_atoms(cells, labels[labels.any(axis=1)], OBSERVED)
    blocks = coarsen(relabel(cells, atom), simulator.surface)
    interfaces = interfaces_between(blocks)
    if len(interfaces) == 0:
        raise BakeError(f"{simulator.surface.name}: no fracture of its simulator breaks it; use another simulator")
    return Atoms(cells, atom, blocks, interfaces, False, min_piece_volume_fraction)


def observed_atoms(cells: Solid, labels: IntArray, count: int) -> IntArray:
    """Find connected groups of cells that fractures seldom separate.

    Ward's clustering (Ward 1963) among neighbouring cells. Two cells are as far apart as the number of fractures that
    separate them, kept up to a few per cent by a random projection (Johnson and Lindenstrauss 1984).

    Parameters
    ----------
    cells : Solid
        C cells.
    labels : ndarray of int64, shape (N, C)
        The piece of each cell in each fracture.
    count : int
        Groups, about.

    Returns
    -------
    ndarray of int64, shape (C,)
        The group of each cell.
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
