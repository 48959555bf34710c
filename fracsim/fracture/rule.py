"""The breaking rule: what an impact does to the interfaces between atoms, and which atoms stay together.

The fracture simulators use it offline, the query online.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ..common.arrays import BoolArray, FloatArray, IntArray

# Brittle solids hold some 10 times more compression than tension, and κ = (σ_t/σ_c)² is near 0.01; they shear
# about as easily as they part.
KAPPA = 0.01
BETA = 1.0


@dataclass(frozen=True, eq=False)
class Interfaces:
    """The interfaces between neighbouring atoms; lengths in units of the largest extent.

    Attributes
    ----------
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet; first < second.
    areas : ndarray of float64, shape (I,)
        Of the jagged interfaces.
    normals : ndarray of float64, shape (I, 3)
        Unit mean normals, from the first atom to the second.
    projected : ndarray of float64, shape (I,)
        Areas projected on the mean normals.
    """

    pairs: IntArray
    areas: FloatArray
    normals: FloatArray
    projected: FloatArray

    def __len__(self) -> int:
        return len(self.pairs)


def load_ratios(rows: FloatArray, directions: FloatArray, severities: FloatArray, interfaces: Interfaces) -> FloatArray:
    """Compute the effective velocity jumps across interfaces, in units of the one that breaks them.

    Parameters
    ----------
    rows : ndarray of float64, shape (N, K, A)
        Impact field of each of K impulses that act together, in N samples.
    directions : ndarray of float64, shape (N, K, 3)
        Unit vectors.
    severities : ndarray of float64, shape (N, K)
        Impulse over mass times gauge times critical velocity; 0 where a sample has fewer impulses.
    interfaces : Interfaces
        The I interfaces.

    Returns
    -------
    ndarray of float64, shape (N, I)
        Load ratios; an interface breaks from 1 on.

    Notes
    -----
    An interface of normal n that opens with w has Δ² = ⟨w·n⟩₊² + κ⟨-w·n⟩₊² + β²|w_t|². With κ = β = 1 this is the
    rule of Breaking Good (Eq. 25), which does not know directions.
    """
    first, second = interfaces.pairs.T
    jump = (rows[:, :, second] - rows[:, :, first]) * severities[:, :, None]
    return effective_opening(np.swapaxes(jump, 1, 2) @ directions, interfaces.normals)


def effective_opening(opening: FloatArray, normals: FloatArray) -> FloatArray:
    """Compute what counts of an opening or a traction: all of the pull, √κ of the push, β of the shear.

    Parameters
    ----------
    opening : ndarray of float64, shape (N, I, 3)
        Velocity jumps, or tractions, in any unit.
    normals : ndarray of float64, shape (I, 3)
        Unit normals of the interfaces.

    Returns
    -------
    ndarray of float64, shape (N, I)
        In the same unit.
    """
    normal = np.einsum("nik,ik->ni", opening, normals)
    tangent = np.maximum(np.einsum("nik,nik->ni", opening, opening) - normal**2, 0.0)
    pull, push = np.maximum(normal, 0.0), np.maximum(-normal, 0.0)
    return np.asarray(np.sqrt(pull**2 + KAPPA * push**2 + BETA**2 * tangent))


def components(joined: BoolArray, pairs: IntArray, count: int) -> IntArray:
    """Find which atoms hang together, in N bodies at once.

    Parameters
    ----------
    joined : ndarray of bool, shape (N, I)
        The interfaces of each body that hold.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    count : int
        A, the number of atoms.

    Returns
    -------
    ndarray of int64, shape (N, A)
        Labels; those of a body run from 0 in the order of their first atom.
    """
    samples, kept = np.nonzero(joined)
    nodes = samples[:, None] * count + pairs[kept]
    size = len(joined) * count
    graph = coo_matrix((np.ones(len(nodes), np.int8), (nodes[:, 0], nodes[:, 1])), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    label = label.reshape(len(joined), count)
    return np.asarray(label - label[:, :1], dtype=np.int64) if size else np.zeros((0, count), np.int64)


def weakest_cut(loads: FloatArray, pairs: IntArray, count: int) -> FloatArray:
    """Find the load ratio of the last interface that breaks before a body first falls apart.

    Scaled up together, load ratios break the most loaded interfaces first. Two pieces exist once every path between
    them is cut. The last interface to break is then the one that carries the largest load ratio in the minimum spanning
    tree, so a body first breaks at the severity 1 / weakest_cut.

    Parameters
    ----------
    loads : ndarray of float64, shape (N, I)
        Load ratios of the interfaces of N bodies, at severity 1.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    count : int
        A, the number of atoms.

    Returns
    -------
    ndarray of float64, shape (N,)
        Load ratios.
    """
    samples = len(loads)
    nodes = (np.arange(samples)[:, None, None] * count + pairs).reshape(-1, 2)
    weights = np.maximum(loads, 1e-12).ravel()  # scipy takes a zero for an edge that is not there
    graph = coo_matrix((weights, (nodes[:, 0], nodes[:, 1])), shape=(samples * count, samples * count))
    tree = minimum_spanning_tree(graph.tocsr()).tocoo()
    result = np.zeros(samples)
    np.maximum.at(result, tree.row // count, tree.data)
    return result


def merge_small_pieces(labels: IntArray, volumes: FloatArray, interfaces: Interfaces, floor: float) -> IntArray:
    """Join every small piece to the neighbour that it shares most area with, the smallest first.

    Parameters
    ----------
    labels : ndarray of int64, shape (A,)
        The piece of each atom.
    volumes : ndarray of float64, shape (A,)
        Of the atoms, in any unit.
    interfaces : Interfaces
        Where atoms meet.
    floor : float
        Pieces of a smaller share of the volume are small.

    Returns
    -------
    ndarray of int64, shape (A,)
        Labels from 0, in the order of their first atom.
    """
    labels = np.asarray(labels)
    while True:
        _, first, labels = np.unique(labels, return_index=True, return_inverse=True)
        labels = np.argsort(np.argsort(first))[labels.reshape(-1)]
        share = np.bincount(labels, volumes) / volumes.sum()
        if share.min() >= floor or len(share) == 1:
            return np.asarray(labels, dtype=np.int64)
        small = int(np.argmin(share))
        ends = labels[interfaces.pairs]
        beside = (ends == small).any(axis=1) & (ends[:, 0] != ends[:, 1])
        if not beside.any():
            return np.asarray(labels, dtype=np.int64)
        other = ends[beside].sum(axis=1) - small
        labels[labels == small] = int(np.argmax(np.bincount(other, interfaces.areas[beside])))


def separated(labels: IntArray, pairs: IntArray) -> BoolArray:
    """Tell which interfaces lie between different pieces.

    Parameters
    ----------
    labels : ndarray of int64, shape (..., A)
        The piece of each atom.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.

    Returns
    -------
    ndarray of bool, shape (..., I)
        Whether the two atoms of each interface are on different pieces.
    """
    return np.asarray(labels[..., pairs[:, 0]] != labels[..., pairs[:, 1]])
