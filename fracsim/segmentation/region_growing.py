"""Seeded region growing on a surface graph."""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph, falling, highest_around

MERGED = 0.1  # of the largest extent: regions join over an edge whose ends are both this far from a crack
STEP = 0.004  # of the largest extent, by which the level falls from which vertices are considered (both: 4.8.1)


def region_growing(graph: SurfaceGraph, udf: FloatArray, merged: float = MERGED) -> IntArray:
    """(V,) region labels of a vertex field (thesis, section 4.6.1 and Algorithm 2).

    Prose and pseudo-code differ: by the code a vertex takes the label of whoever comes last, and those below 0.1
    none. We follow the prose and section 4.8.1. Seeds are the local maxima. A level falls from the field's maximum in
    steps of 0.004 to 0, where all vertices are considered. At each level, as long as any is left, all considered
    vertices without a label that have labelled neighbours take the label most popular among these, together; ties go
    to the region of the higher seed. Last, regions join over edges whose ends are both at least ``merged``.
    Ties among maxima go to the lower index.
    """
    pairs = graph.pairs
    count = len(graph)
    starts, around = pairs.around
    ends = np.append(starts[1:], len(around))
    order, _ = falling(udf)
    seeds = order[highest_around(pairs, udf)[order] == order]
    label = np.full(count, -1)
    label[seeds] = np.arange(len(seeds))
    step = steps(udf)
    considered = np.zeros(count, dtype=bool)
    touched = np.zeros(count, dtype=bool)  # has a labelled neighbour

    def neighbours(vertices: IntArray) -> tuple[IntArray, IntArray]:
        """All neighbours of some vertices, and which of these each belongs to."""
        sizes = ends[vertices] - starts[vertices]
        owner = np.repeat(np.arange(len(vertices)), sizes)
        offset = np.arange(len(owner)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return around[starts[vertices][owner] + offset], owner

    touched[neighbours(seeds)[0]] = True
    bounds = np.flatnonzero(np.diff(step[order], prepend=-1))
    for level in np.split(order, bounds[1:]):
        considered[level] = True
        waiting = level[touched[level] & (label[level] < 0)]
        while len(waiting):
            beside, owner = neighbours(waiting)
            voice = label[beside]
            heard = voice >= 0
            ballot, votes = np.unique(owner[heard] * len(seeds) + voice[heard], return_counts=True)
            voter, choice = np.divmod(ballot, len(seeds))
            # The first of each voter's choices after sorting: most votes, then the lower label, of the higher seed.
            ranked = np.lexsort((choice, -votes, voter))
            first = ranked[np.flatnonzero(np.diff(voter[ranked], prepend=-1))]
            label[waiting] = choice[first]
            touched[beside] = True
            waiting = np.unique(beside[considered[beside] & (label[beside] < 0)])
    together = np.minimum(udf[pairs.first], udf[pairs.second]) >= merged
    return pairs.connected(together, seeds[label])


def steps(udf: FloatArray) -> IntArray:
    """(V,) after how many steps the level has fallen to each vertex, none later than the one that reaches 0."""
    top = udf.max()
    return np.minimum(np.ceil((top - udf) / STEP), max(np.ceil(top / STEP), 0.0)).astype(np.int64)
