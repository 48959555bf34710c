"""The breaking rule: what an impact does to the interfaces between atoms, and which atoms stay together.

Shared by the simulator (offline) and the ``modes`` predictor (online); numpy and scipy only.
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
    """The interfaces between neighbouring atoms.

    pairs: (I, 2), first < second. areas: (I,), of the jagged interface. normals: (I, 3) unit mean normal, from
    the first atom to the second. projected: (I,), the area projected on the mean normal.
    Lengths are in units of the largest extent.
    """

    pairs: IntArray
    areas: FloatArray
    normals: FloatArray
    projected: FloatArray

    def __len__(self) -> int:
        return len(self.pairs)


def load_ratios(rows: FloatArray, directions: FloatArray, severities: FloatArray, interfaces: Interfaces) -> FloatArray:
    """Effective velocity jumps (N, I) across the interfaces, in units of the one that breaks them.

    rows: (N, K, A) impact field of each of K contacts acting together. directions: (N, K, 3) unit.
    severities: (N, K), impulse / (mass * breaking velocity); 0 for a contact that is not there.
    An interface of normal n that opens with w has Δ² = ⟨w·n⟩₊² + κ⟨-w·n⟩₊² + β²|w_t|²; κ = β = 1 is the
    direction-blind rule of Breaking Good (Eq. 25).
    """
    first, second = interfaces.pairs.T
    jump = (rows[:, :, second] - rows[:, :, first]) * severities[:, :, None]
    return effective_opening(np.swapaxes(jump, 1, 2) @ directions, interfaces.normals)


def effective_opening(opening: FloatArray, normals: FloatArray) -> FloatArray:
    """(N, I) what counts of an opening or a traction (N, I, 3) across interfaces of unit normals (I, 3): all of the
    pull, √κ of the push, β of the shear."""
    normal = np.einsum("nik,ik->ni", opening, normals)
    tangent = np.maximum(np.einsum("nik,nik->ni", opening, opening) - normal**2, 0.0)
    pull, push = np.maximum(normal, 0.0), np.maximum(-normal, 0.0)
    return np.asarray(np.sqrt(pull**2 + KAPPA * push**2 + BETA**2 * tangent))


def components(joined: BoolArray, pairs: IntArray, count: int) -> IntArray:
    """(N, A) labels of the atoms of N bodies, each held together by its ``joined`` (N, I) interfaces.

    Labels of a body run from 0 in the order of their first atom.
    """
    samples, kept = np.nonzero(joined)
    nodes = samples[:, None] * count + pairs[kept]
    size = len(joined) * count
    graph = coo_matrix((np.ones(len(nodes), np.int8), (nodes[:, 0], nodes[:, 1])), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    label = label.reshape(len(joined), count)
    return np.asarray(label - label[:, :1], dtype=np.int64) if size else np.zeros((0, count), np.int64)


def weakest_cut(drive: FloatArray, pairs: IntArray, count: int) -> FloatArray:
    """(N,) the drive at which each body first falls apart, given the drives (N, I) of its interfaces.

    Scaled up, the drives break the strongest-driven interfaces first; two pieces exist once every way between
    them is cut. The last link to go is the largest edge of the minimum spanning tree, so a body breaks at
    severity 1 / weakest_cut.
    """
    samples = len(drive)
    nodes = (np.arange(samples)[:, None, None] * count + pairs).reshape(-1, 2)
    weights = np.maximum(drive, 1e-12).ravel()  # scipy takes a zero for an edge that is not there
    graph = coo_matrix((weights, (nodes[:, 0], nodes[:, 1])), shape=(samples * count, samples * count))
    tree = minimum_spanning_tree(graph.tocsr()).tocoo()
    result = np.zeros(samples)
    np.maximum.at(result, tree.row // count, tree.data)
    return result


def merge_small_pieces(labels: IntArray, volumes: FloatArray, interfaces: Interfaces, floor: float) -> IntArray:
    """Join every piece below ``floor`` (a fraction of the whole) to the neighbour it shares most area with.

    labels: (A,) the piece of each atom. Returns (A,), numbered from 0 in the order of first atoms.
    """
    labels = np.asarray(labels)
    while True:
        _, first, labels = np.unique(labels, return_index=True, return_inverse=True)
        labels = np.argsort(np.argsort(first))[labels.reshape(-1)]
        share = np.bincount(labels, volumes) / volumes.sum()
        if share.min() >= floor or len(share) == 1:
            return np.asarray(labels, dtype=np.int64)
        crumb = int(np.argmin(share))
        ends = labels[interfaces.pairs]
        beside = (ends == crumb).any(axis=1) & (ends[:, 0] != ends[:, 1])
        if not beside.any():
            return np.asarray(labels, dtype=np.int64)
        other = ends[beside].sum(axis=1) - crumb
        labels[labels == crumb] = int(np.argmax(np.bincount(other, interfaces.areas[beside])))


def separated(labels: IntArray, pairs: IntArray) -> BoolArray:
    """Which interfaces lie between different pieces: (..., A) labels to (..., I)."""
    return np.asarray(labels[..., pairs[:, 0]] != labels[..., pairs[:, 1]])
