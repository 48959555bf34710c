"""Regions that belong together, joined in the order of how strongly they are bound. Offline only.

``structural`` reads pieces off what is left of the interfaces between atoms with it.
"""

from __future__ import annotations

import heapq

import numpy as np

from ..common.arrays import FloatArray, IntArray


def merge_bound(
    volumes: FloatArray, pairs: IntArray, areas: FloatArray, bonds: FloatArray, least_bond: float, least_volume: float
) -> IntArray:
    """Join regions while their common boundary is bound strongly enough, the strongest first.

    Parameters
    ----------
    volumes : ndarray of float64, shape (A,)
        Of the regions.
    pairs : ndarray of int64, shape (I, 2)
        Which of them meet.
    areas : ndarray of float64, shape (I,)
        Where they meet.
    bonds : ndarray of float64, shape (I,)
        How strongly, from 0 to 1.
    least_bond : float
        Two groups stay apart where the mean bond over their common area is below it.
    least_volume : float
        A smaller group joins the neighbour that it is bound to most strongly, all the same.

    Returns
    -------
    ndarray of int64, shape (A,)
        The group of each region, numbered from 0 in the order of first members.

    Notes
    -----
    Average linkage (Sokal and Michener 1958) over the areas. The mean over a whole boundary tells a crack through it
    from a crack into it, which the strongest or the weakest single bond does not.
    """
    count = len(volumes)
    shared: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]  # (sum of area * bond, area)
    for (a, b), area, bond in zip(pairs.tolist(), areas.tolist(), bonds.tolist(), strict=True):
        shared[a][b] = shared[b][a] = (area * bond, area)
    volume = volumes.tolist()
    parent = list(range(count))
    heap = [(-held / area, a, b) for a in range(count) for b, (held, area) in shared[a].items() if a < b]
    heapq.heapify(heap)

    def join(kept: int, gone: int) -> None:
        """Make two groups one, under the first one's number."""
        parent[gone] = kept
        volume[kept] += volume[gone]
        for other, (held, area) in shared[gone].items():
            del shared[other][gone]
            if other != kept:
                before = shared[kept].get(other, (0.0, 0.0))
                total = (before[0] + held, before[1] + area)
                shared[kept][other] = shared[other][kept] = total
                heapq.heappush(heap, (-total[0] / total[1], min(kept, other), max(kept, other)))
        shared[gone] = {}

    while heap:
        bond, a, b = heapq.heappop(heap)
        if -bond < least_bond:
            break
        # An entry is stale where the bond has changed since, or one of the two has joined another.
        if b in shared[a] and -shared[a][b][0] / shared[a][b][1] == bond:
            join(a, b)
    while True:
        small = [k for k in range(count) if parent[k] == k and volume[k] < least_volume and shared[k]]
        if not small:
            break
        smallest = min(small, key=lambda k: volume[k])
        join(max(shared[smallest], key=lambda k: shared[smallest][k][0] / shared[smallest][k][1]), smallest)
    root = np.arange(count)
    for k in range(count):
        top = k
        while parent[top] != top:
            top = parent[top]
        root[k] = top
    _, first, label = np.unique(root, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[label.reshape(-1)])
