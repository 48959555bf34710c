"""The default model in NumPy alone: impulses in, break scores and an unsigned distance field out.

The query asks it online; ``learning.field`` trains it, and evaluations use its functions.

A small network sees where an impulse lands and gives how strongly it moves every atom and, where a simulator turns
pushes into pulls, what it does at every interface beside that. The effects of impulses that act together add up. What
opens an interface becomes its break score. The field is the min-plus product of scores with the geodesic distances to
the interfaces, which the mesh fixes: nothing at a vertex depends on the impulse but that.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..common.arrays import AnyFloatArray, FloatArray, IntArray
from .rule import separated

TAU = 0.02  # of the largest extent: what a break score of 1/e adds to the distance
SURE = 1e-3  # scores below it are taken for no crack at all
FLOOR = 1e-4  # added to squared openings before their logarithm, which it keeps finite
LARGEST_LOGIT = 60.0  # beyond it a score is 0 or 1 to float32


@dataclass(frozen=True, eq=False)
class FieldWeights:
    """Weights of a trained model; every array float32.

    V vertices, D coordinates, C outputs, A atoms, I interfaces. Of the C outputs the first A are potentials of the
    atoms: an interface opens along the impulse by the difference across it. The other 9 I, or none, are a 3 x 3
    response of each interface, (3, 3, I): an opening along axis a for an impulse along axis b.

    Attributes
    ----------
    coordinates : ndarray, shape (V, D)
        The surface coordinates of each vertex.
    skip : ndarray, shape (D, C)
        A linear map beside the network.
    weights_0, weights_1, weights_2 : ndarray
        Of a perceptron from D to C, with SiLU between its layers.
    biases_0, biases_1, biases_2 : ndarray
        Of the same.
    slope, offset, push, shear : ndarray, shape (I,)
        From an interface's opening to its score; shares of push and shear that count.
    normals : ndarray, shape (I, 3)
        Unit normals of the interfaces.
    severity : ndarray, shape (1,)
        The largest total severity seen in training.
    level : ndarray, shape (1,)
        The score from which an interface counts as a crack.
    """

    coordinates: AnyFloatArray
    skip: AnyFloatArray
    weights_0: AnyFloatArray
    biases_0: AnyFloatArray
    weights_1: AnyFloatArray
    biases_1: AnyFloatArray
    weights_2: AnyFloatArray
    biases_2: AnyFloatArray
    slope: AnyFloatArray
    offset: AnyFloatArray
    push: AnyFloatArray
    shear: AnyFloatArray
    normals: AnyFloatArray
    severity: AnyFloatArray
    level: AnyFloatArray

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of all arrays.

        Returns
        -------
        list of str
            In the order of the attributes.
        """
        return [field.name for field in fields(cls)]

    @property
    def pass_height(self) -> float:
        """How far above the field of a sure crack that of a barely counted one stands, of the largest extent."""
        return -TAU * float(np.log(self.level[0]))

    def scores(
        self,
        corners: IntArray,
        barycentric: AnyFloatArray,
        directions: AnyFloatArray,
        severities: AnyFloatArray,
        pairs: IntArray,
    ) -> AnyFloatArray:
        """Predict how likely each interface breaks under K impulses that act together.

        Parameters
        ----------
        corners : ndarray of int64, shape (K, 3)
            The vertices of the face that each acts on.
        barycentric : ndarray, shape (K, 3)
            Where on that face.
        directions : ndarray, shape (K, 3)
            Unit vectors.
        severities : ndarray, shape (K,)
            How hard each is, see `fracsim.fracture.severity`.
        pairs : ndarray of int64, shape (I, 2)
            The atoms that meet at each interface.

        Returns
        -------
        ndarray of float32, shape (I,)
            Break scores from 0 to 1.
        """
        x = np.einsum("kc,kcd->kd", barycentric.astype(np.float32), self.coordinates[corners])  # (K, D)
        response = x @ self.skip  # (K, C)
        for weights, biases in ((self.weights_0, self.biases_0), (self.weights_1, self.biases_1)):
            x = x @ weights + biases
            x = x / (1.0 + np.exp(-x))
        response += x @ self.weights_2 + self.biases_2
        response *= severities[:, None].astype(np.float32)
        along = directions.astype(np.float32)
        count = len(pairs)
        atoms = response.shape[1] if response.shape[1] < 9 * count else response.shape[1] - 9 * count
        moved = response[:, :atoms].T @ along  # (A, 3)
        opening = moved[pairs[:, 1]] - moved[pairs[:, 0]]
        if atoms < response.shape[1]:
            opening += np.einsum("kabi,kb->ia", response[:, atoms:].reshape(-1, 3, 3, count), along)
        normal = np.einsum("ik,ik->i", opening, self.normals)
        tangent = np.maximum(np.einsum("ik,ik->i", opening, opening) - normal**2, 0.0)
        pull, push = np.maximum(normal, 0.0), np.maximum(-normal, 0.0)
        squared = pull**2 + self.push * push**2 + self.shear * tangent
        logits = self.slope * np.log(squared + FLOOR) + self.offset
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -LARGEST_LOGIT, LARGEST_LOGIT))))


def minimax_scores(scores: AnyFloatArray, pairs: IntArray, count: int) -> AnyFloatArray:
    """Score how likely each interface parts its two sides.

    A cut needs every path between two atoms severed. So an interface parts them with the weakest link of its best
    detour: the smallest, over all paths between its two atoms, of the largest score along the path.

    Parameters
    ----------
    scores : ndarray, shape (I,)
        Break scores.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    count : int
        A, the number of atoms.

    Returns
    -------
    ndarray, shape (I,)
        Minimax scores.

    Notes
    -----
    Minimax path (single-linkage) scores by Kruskal's algorithm. Its union tree is left uncompressed: joined smaller to
    larger it is at most log2(A) deep, and scores rise along it, so that two atoms' bottleneck is the last link climbed
    before their paths to the root meet.

    Examples
    --------
    >>> import numpy as np
    >>> triangle = np.array([[0, 1], [1, 2], [0, 2]])
    >>> minimax_scores(np.array([0.9, 0.2, 0.7]), triangle, 3).tolist()
    [0.7, 0.2, 0.7]
    """
    order = np.argsort(scores, kind="stable")
    above, size, link = list(range(count)), [1] * count, [len(scores)] * count
    joins = count - 1
    for k, (a, b) in enumerate(pairs[order].tolist()):
        while above[a] != a:
            a = above[a]
        while above[b] != b:
            b = above[b]
        if a != b:
            if size[a] < size[b]:
                a, b = b, a
            above[b], link[b] = a, k
            size[a] += size[b]
            joins -= 1
            if joins == 0:
                break
    parent, rank = np.array(above), np.array(link)
    a, b = pairs.T
    last = np.zeros(len(pairs), dtype=np.int64)
    while True:
        apart = a != b
        if not apart.any():
            return np.asarray(scores[order[last]])
        low = np.minimum(rank[a], rank[b])
        last = np.where(apart, low, last)
        a, b = np.where(apart & (rank[a] == low), parent[a], a), np.where(apart & (rank[b] == low), parent[b], b)


def field_from_scores(scores: AnyFloatArray, distances: AnyFloatArray, cap: float) -> FloatArray:
    """Compute the field min over i of distances[i] - TAU ln scores[i], capped.

    Sure cracks stand where they are; an unsure one is seen from further off.

    Parameters
    ----------
    scores : ndarray, shape (I,)
        How likely each interface is a crack.
    distances : ndarray, shape (I, V)
        Geodesic, from each interface.
    cap : float
        The largest value.

    Returns
    -------
    ndarray of float64, shape (V,)
        The field, in units of the distances.
    """
    rows = np.flatnonzero(scores > SURE)
    if len(rows) == 0:
        return np.full(distances.shape[1], cap)
    seen = distances[rows].astype(np.float32)
    seen -= (TAU * np.log(scores[rows])).astype(np.float32)[:, None]
    return np.minimum(seen.min(axis=0), cap).astype(np.float64)


def field_of_labels(labels: IntArray, pairs: IntArray, distances: AnyFloatArray, cap: float) -> FloatArray:
    """Compute the exact field of a fracture: the distance to the nearest interface between two pieces, capped.

    Parameters
    ----------
    labels : ndarray of int64, shape (A,)
        The piece of each atom.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    distances : ndarray, shape (I, V)
        Geodesic, from each interface.
    cap : float
        The largest value.

    Returns
    -------
    ndarray of float64, shape (V,)
        The field, in units of the distances, to the precision of float32.
    """
    return field_from_scores(separated(labels, pairs).astype(np.float64), distances, cap)
