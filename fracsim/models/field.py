"""The default model: impulse in, unsigned distance field out, in numpy alone.

A small network sees where the blow lands and gives, for every interface, how strongly it is moved apart; blows
that act together add up. Those drives become break scores, and the field is their min-plus product with the
geodesic distances to the interfaces, which the mesh fixes: nothing per vertex depends on the impulse but that.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.int64]

TAU = 0.02  # of the largest extent: what a break score of 1/e adds to the distance
SURE = 1e-3  # scores below it are taken for no crack at all
FLOOR = 1e-3  # added to squared drives before their logarithm


@dataclass(frozen=True, eq=False)
class FieldModel:
    """Weights of a trained model; every array float32.

    coordinates: (V, D), the surface coordinates of each vertex. widths are those of the weights.
    weights_k, biases_k: a perceptron from D to I with SiLU between, beside which ``skip`` (D, I) runs straight.
    slope, offset, push, shear: (I,), from drive to score. normals: (I, 3). severity: the largest seen in training.
    """

    coordinates: FloatArray
    skip: FloatArray
    weights_0: FloatArray
    biases_0: FloatArray
    weights_1: FloatArray
    biases_1: FloatArray
    weights_2: FloatArray
    biases_2: FloatArray
    slope: FloatArray
    offset: FloatArray
    push: FloatArray
    shear: FloatArray
    normals: FloatArray
    severity: FloatArray

    @classmethod
    def names(cls) -> list[str]:
        return [field.name for field in fields(cls)]

    def scores(
        self, corners: IntArray, barycentric: FloatArray, directions: FloatArray, severities: FloatArray
    ) -> FloatArray:
        """(I,) the probability that each interface breaks under K contacts acting together.

        corners: (K, 3) vertices around each contact point and barycentric (K, 3) coordinates of it;
        directions: (K, 3) unit; severities: (K,).
        """
        x = np.einsum("kc,kcd->kd", barycentric, self.coordinates[corners]).astype(np.float32)  # (K, D)
        moved = x @ self.skip  # (K, I)
        for weights, biases in ((self.weights_0, self.biases_0), (self.weights_1, self.biases_1)):
            x = x @ weights + biases
            x = x / (1.0 + np.exp(-x))
        moved += x @ self.weights_2 + self.biases_2
        moved *= severities[:, None].astype(np.float32)
        opening = moved.T @ directions.astype(np.float32)  # (I, 3)
        normal = np.einsum("ik,ik->i", opening, self.normals)
        tangent = np.maximum(np.einsum("ik,ik->i", opening, opening) - normal**2, 0.0)
        pull, push = np.maximum(normal, 0.0), np.maximum(-normal, 0.0)
        squared = pull**2 + self.push * push**2 + self.shear * tangent
        logits = self.slope * np.log(squared + FLOOR) + self.offset
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0))))


def parting_scores(scores: FloatArray, pairs: IntArray, count: int) -> FloatArray:
    """(I,) the score of each interface parting its two sides: the smallest, over all ways between them, of
    the largest score on the way to be cut.

    A cut needs every way between two atoms severed, so an interface parts them with the weakest link of its
    best detour: single linkage over the scores, which equals the bottleneck path along their minimum
    spanning tree.
    """
    graph = coo_matrix((np.maximum(scores, 1e-12), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    tree = minimum_spanning_tree(graph.tocsr()).tocoo()
    bottleneck = np.zeros((count, count))
    members = {k: np.array([k]) for k in range(count)}
    group = list(range(count))
    for k in np.argsort(tree.data, kind="stable").tolist():
        a, b = group[tree.row[k]], group[tree.col[k]]
        if len(members[a]) < len(members[b]):
            a, b = b, a
        block = np.ix_(members[a], members[b])
        bottleneck[block] = tree.data[k]
        bottleneck[block[1].T, block[0].T] = tree.data[k]
        for atom in members[b].tolist():
            group[atom] = a
        members[a] = np.concatenate([members[a], members.pop(b)])
    return np.asarray(bottleneck[pairs[:, 0], pairs[:, 1]])


def field_from_scores(scores: FloatArray, distances: FloatArray, cap: float) -> npt.NDArray[np.float64]:
    """(V,) the field min over i of distances[i] - TAU ln scores[i], capped.

    distances: (I, V), geodesic, from each interface. Sure cracks stand at their place; an unsure one is seen
    from further off.
    """
    rows = np.flatnonzero(scores > SURE)
    if len(rows) == 0:
        return np.full(distances.shape[1], cap)
    seen = distances[rows].astype(np.float32) - (TAU * np.log(scores[rows])).astype(np.float32)[:, None]
    return np.minimum(seen.min(axis=0), cap).astype(np.float64)
