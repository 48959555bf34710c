"""Midpoint segmentation: joins what no crack can separate, from a field known at vertices and edge midpoints.

It imports numpy and scipy only, and may be used by every room above ``common``.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import AnyFloatArray, IntArray
from .graph import Pairs, SurfaceGraph

SLACK = 0.0  # of the largest extent: by how much the field may be wrong; 0 for an exact field
# Of an edge's length: two discs overlap when their radii add up to a half. The rest is a margin, because a field on a
# curved or coarsely triangulated surface may exceed the exact distance a little.
SURE = 0.52
STRAIGHT = 0.1  # of the lower end: how far a midpoint may be off the mean of both ends and count as one side of a crack
CLEAR = 0.25  # of a link's length: a link with an end nearer to a crack than this may cross the crack
WITNESSES = 2  # links that are needed to join two patches


def midpoint_segmentation(graph: SurfaceGraph, nodes: AnyFloatArray, slack: float = SLACK) -> IntArray:
    """Label the pieces of a surface from a field at its vertices and at the midpoints of its edges.

    The method is ours, in three steps.

    1. A node (a vertex or a midpoint) is the centre of a disc that no crack enters, whose radius is the field there.
       Where two discs overlap, both nodes are on one piece: a vertex and the midpoint of one of its edges of length L,
       if their radii add up to more than ``SURE`` L; two midpoints of a face, if theirs add up to more than ``SURE``
       times the third edge of that face.
    2. A vertex close to a crack, whose disc overlaps no other, joins one neighbour: the one across the edge with the
       highest midpoint, among edges along which the field is nearly linear and whose midpoint is above half of the
       higher end. Across a crack the field falls and rises again, so the midpoint is below that. A vertex without such
       an edge stays a piece of its own: either side would be as likely.
    3. Patches of one piece may meet only inside the solid. They are joined by links: if at least ``WITNESSES`` links
       run between the two patches, and these are more than half of the links of one of them. Links with an end close
       to a crack (``CLEAR``) do not count.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface, with its links if it has any.
    nodes : ndarray of float, shape (V + E,)
        Distance to the nearest crack at the vertices and then at the midpoints of ``graph.edges``, in units of the
        largest extent.
    slack : float
        By how much the field may be wrong, in units of the largest extent. Overlaps must exceed it.

    Returns
    -------
    ndarray of int64, shape (V,)
        Piece of each vertex, from 0.
    """
    edges, heights, middle = graph.surface, nodes[: len(graph)], nodes[len(graph) :]
    start, end = heights.take(edges.first), heights.take(edges.second)
    reach = SURE * graph.lengths + slack
    sure = np.minimum(start, end) + middle > reach  # both halves of the edge overlap

    # The midpoints of the remaining edges become nodes of the graph, V + 0, V + 1, ...
    rest = np.flatnonzero(~sure)
    first, second = edges.first[rest], edges.second[rest]
    start, end, middle_rest = start[rest], end[rest], middle[rest]
    higher = np.maximum(start, end)
    half = higher + middle_rest > reach[rest]  # the half towards the higher end overlaps
    higher_end = np.where(start >= end, first, second)
    itself = np.arange(len(graph), len(graph) + len(rest), dtype=np.int32)
    node = edges.first.copy()  # (E,) a node on the piece of each midpoint
    node[rest] = itself
    adjacent, third_lengths = (values[rest] for values in graph.adjacent_edges)
    overlap = middle_rest[:, None] + middle[adjacent] > SURE * third_lengths + slack
    extra = np.column_stack([np.where(half, higher_end, itself), np.where(overlap, node[adjacent], itself[:, None])])

    # Vertices whose disc overlaps no other. Candidates are written in rising order of the midpoint, so that the
    # highest one stays.
    alone = np.bincount(np.concatenate([first, second]), minlength=len(graph)) == edges.degrees
    alone[higher_end[half]] = False
    straight = np.abs(middle_rest - 0.5 * (start + end)) <= STRAIGHT * np.minimum(start, end) + slack
    rows = np.flatnonzero(straight & (middle_rest > 0.5 * higher))
    rows = rows[np.argsort(middle_rest[rows], kind="stable")]
    vertex = np.column_stack([first[rows], second[rows]]).ravel()
    neighbour = np.column_stack([second[rows], first[rows]]).ravel()
    joins = alone[vertex]
    follows = np.arange(len(graph), dtype=np.int32)
    follows[vertex[joins]] = neighbour[joins]

    labels = edges.connected(sure, follows, extra)
    return _join_by_links(graph, labels, heights) if len(graph.links) else labels


def _join_by_links(graph: SurfaceGraph, labels: IntArray, heights: AnyFloatArray) -> IntArray:
    """Join patches of the labels (V,) that enough links connect; returns labels (V,)."""
    first, second, lengths = graph.link_ends
    a, b = labels.take(first), labels.take(second)
    counts = np.minimum(heights.take(first), heights.take(second)) > CLEAR * lengths
    across = (a != b) & counts
    if not across.any():
        return labels
    patch_count = int(labels.max()) + 1
    links_of = np.bincount(a[counts], minlength=patch_count) + np.bincount(b[counts], minlength=patch_count)
    key = np.minimum(a, b)[across] * patch_count + np.maximum(a, b)[across]
    between, votes = np.unique(key, return_counts=True)
    patches = np.stack(np.divmod(between, patch_count), axis=1)
    joined = (votes >= WITNESSES) & (2 * votes > links_of[patches].min(axis=1))
    return Pairs(patches, patch_count).connected(joined)[labels]
