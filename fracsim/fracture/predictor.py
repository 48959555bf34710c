"""The default model: impulse in, unsigned distance field out, in numpy alone.

A small network sees where the impact lands and gives how strongly it moves every atom, and, where a truth turns pushes
into pulls, what it does at every interface beside that; impacts that act together add up. What opens an interface
becomes its break score, and the field is the min-plus product of scores with the geodesic distances to the
interfaces, which the mesh fixes: nothing per vertex depends on the impulse but that.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from ..common.arrays import AnyFloatArray, IntArray

TAU = 0.02  # of the largest extent: what a break score of 1/e adds to the distance
SURE = 1e-3  # scores below it are taken for no crack at all
FLOOR = 1e-4  # added to squared openings before their logarithm


@dataclass(frozen=True, eq=False)
class FieldWeights:
    """Weights of a trained model; every array float32.

    coordinates: (V, D), the surface coordinates of each vertex. weights_k, biases_k: a perceptron from D to C with
    SiLU between, beside which ``skip`` (D, C) runs straight. Of the C outputs the first A are potentials of the
    atoms: an interface opens along the impact by the difference across it. The other 9 I, or none, are a 3 x 3 response
    of each interface, (3, 3, I): an opening along axis a for an impact along axis b.
    slope, offset, push, shear: (I,), from opening to score. normals: (I, 3). severity: (1,), the largest seen in
    training. level: (1,), the score from which an interface counts as a crack.
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
        return [field.name for field in fields(cls)]

    @property
    def pass_height(self) -> float:
        """How far above a sure crack's field that of a barely counted one stands."""
        return -TAU * float(np.log(self.level[0]))

    def scores(
        self,
        corners: IntArray,
        barycentric: AnyFloatArray,
        directions: AnyFloatArray,
        severities: AnyFloatArray,
        pairs: IntArray,
    ) -> AnyFloatArray:
        """(I,) the probability that each interface breaks under K contacts acting together.

        corners: (K, 3) vertices around each contact point and barycentric (K, 3) coordinates of it;
        directions: (K, 3) unit; severities: (K,). pairs: (I, 2) atoms on either side.
        """
        x = np.einsum("kc,kcd->kd", barycentric.astype(np.float32), self.coordinates[corners])  # (K, D)
        response = x @ self.skip  # (K, C)
        for weights, biases in ((self.weights_0, self.biases_0), (self.weights_1, self.biases_1)):
            x = x @ weights + biases
            x = x / (1.0 + np.exp(-x))
        response += x @ self.weights_2 + self.biases_2
        response *= severities[:, None].astype(np.float32)
        way = directions.astype(np.float32)
        count = len(pairs)
        atoms = response.shape[1] if response.shape[1] < 9 * count else response.shape[1] - 9 * count
        moved = response[:, :atoms].T @ way  # (A, 3)
        opening = moved[pairs[:, 1]] - moved[pairs[:, 0]]
        if atoms < response.shape[1]:
            opening += np.einsum("kabi,kb->ia", response[:, atoms:].reshape(-1, 3, 3, count), way)
        normal = np.einsum("ik,ik->i", opening, self.normals)
        tangent = np.maximum(np.einsum("ik,ik->i", opening, opening) - normal**2, 0.0)
        pull, push = np.maximum(normal, 0.0), np.maximum(-normal, 0.0)
        squared = pull**2 + self.push * push**2 + self.shear * tangent
        logits = self.slope * np.log(squared + FLOOR) + self.offset
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0))))


def minimax_scores(scores: AnyFloatArray, pairs: IntArray, count: int) -> AnyFloatArray:
    """(I,) the score of each interface parting its two sides: the smallest, over all ways between them, of
    the largest score on the way to be cut.

    A cut needs every way between two atoms severed, so an interface parts them with the weakest link of its
    best detour: single linkage over the scores. Kruskal's algorithm, its union tree left uncompressed: joined
    smaller to larger it is at most log2(A) deep, and scores rise along it, so that two atoms' bottleneck is the
    last link climbed before their ways up meet.
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


def field_from_scores(scores: AnyFloatArray, distances: AnyFloatArray, cap: float) -> npt.NDArray[np.float64]:
    """(V,) the field min over i of distances[i] - TAU ln scores[i], capped.

    distances: (I, V), geodesic, from each interface. Sure cracks stand at their place; an unsure one is seen
    from further off.
    """
    rows = np.flatnonzero(scores > SURE)
    if len(rows) == 0:
        return np.full(distances.shape[1], cap)
    seen = distances[rows].astype(np.float32)
    seen -= (TAU * np.log(scores[rows])).astype(np.float32)[:, None]
    return np.minimum(seen.min(axis=0), cap).astype(np.float64)
