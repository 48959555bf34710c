"""Region growing: regions spread from the maxima of a field while a level falls.

It imports numpy and scipy only, and may be used by every room above ``common``.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray, IntArray
from .graph import SurfaceGraph, descending_order, highest_neighbour

MERGED = 0.1  # of the largest extent: regions join across an edge with both ends this high (thesis, section 4.8.1)
STEP = 0.004  # of the largest extent: by how much the level falls at a time (thesis, section 4.8.1)


def region_growing(graph: SurfaceGraph, udf: FloatArray, merged: float = MERGED) -> IntArray:
    """Label the regions of a field (thesis, section 4.6.1 and Algorithm 2).

    Text and pseudo-code of the thesis differ: in the pseudo-code a vertex takes the label of the neighbour that comes
    last, and vertices below 0.1 take none. We follow the text and section 4.8.1.

    The local maxima are the seeds. A level falls from the maximum of the field to 0 in steps of ``STEP``, and vertices
    above it are considered. At each level, as long as any vertex changes, all considered vertices without a label that
    have neighbours with one take the label that is most frequent among these, all at once; of equally frequent labels,
    that of the higher seed. Finally, regions join across edges with both ends at ``merged`` or higher. Of equal maxima
    the lower index comes first.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.
    merged : float
        Height of both ends of an edge from which two regions join, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        Region of each vertex, from 0.
    """
    pairs = graph.pairs
    count = len(graph)
    starts, neighbour_list = pairs.neighbours
    ends = np.append(starts[1:], len(neighbour_list))
    order, _ = descending_order(udf)
    seeds = order[highest_neighbour(pairs, udf)[order] == order]
    label = np.full(count, -1)
    label[seeds] = np.arange(len(seeds))
    level_of = levels(udf)
    considered = np.zeros(count, dtype=bool)
    touched = np.zeros(count, dtype=bool)  # has a neighbour with a label

    def neighbours(vertices: IntArray) -> tuple[IntArray, IntArray]:
        """All neighbours of several vertices, and the position in ``vertices`` of the vertex each belongs to."""
        sizes = ends[vertices] - starts[vertices]
        owner = np.repeat(np.arange(len(vertices)), sizes)
        offset = np.arange(len(owner)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return neighbour_list[starts[vertices][owner] + offset], owner

    touched[neighbours(seeds)[0]] = True
    bounds = np.flatnonzero(np.diff(level_of[order], prepend=-1))
    for level in np.split(order, bounds[1:]):
        considered[level] = True
        waiting = level[touched[level] & (label[level] < 0)]
        while len(waiting):
            beside, owner = neighbours(waiting)
            vote = label[beside]
            valid = vote >= 0
            ballot, votes = np.unique(owner[valid] * len(seeds) + vote[valid], return_counts=True)
            voter, choice = np.divmod(ballot, len(seeds))
            # After sorting, the first choice of each voter has most votes, and of equal ones the lower label, which
            # is that of the higher seed.
            ranked = np.lexsort((choice, -votes, voter))
            first = ranked[np.flatnonzero(np.diff(voter[ranked], prepend=-1))]
            label[waiting] = choice[first]
            touched[beside] = True
            waiting = np.unique(beside[considered[beside] & (label[beside] < 0)])
    together = np.minimum(udf[pairs.first], udf[pairs.second]) >= merged
    return pairs.connected(together, seeds[label])


def levels(udf: FloatArray) -> IntArray:
    """Count the steps after which the falling level reaches each vertex.

    Parameters
    ----------
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.

    Returns
    -------
    ndarray of int64, shape (V,)
        The number of steps; a vertex below 0 counts as reached when the level is 0.
    """
    top = udf.max()
    return np.minimum(np.ceil((top - udf) / STEP), max(np.ceil(top / STEP), 0.0)).astype(np.int64)
