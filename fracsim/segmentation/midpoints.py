"""Ours, where the field is also known halfway along every edge: join what no crack can part."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ..common.arrays import AnyFloatArray, Int32Array, IntArray
from .graph import Pairs, SurfaceGraph

SLACK = 0.0  # of the largest extent: what a field may be wrong by
SURE = 0.52  # of an edge's length: a half, and what a field on a curved or flattened surface may stray from the bound
STRAIGHT = 0.1  # of the lower end: how far a pass may be off the mean of its ends and count as on one side of a crack
CLEAR = 0.25  # of a link's length: nearer to a crack than that, its ends may lie on either side of it
WITNESSES = 2  # links that it takes to join two patches


def midpoint_segmentation(graph: SurfaceGraph, nodes: AnyFloatArray, slack: float = SLACK) -> IntArray:
    """(V,) piece labels of a field (V + E,) at the vertices and then at the edge midpoints.

    A node of the field stands in the middle of a disc that no crack enters, as wide as the field is high. Where two
    discs overlap, both nodes are on one piece: a vertex and the midpoint of its edge of length L, if their heights add
    up to more than L / 2, and two midpoints of a face, if theirs add up to more than half of its third edge. Both with
    a margin (SURE), and by more than ``slack`` where the field is not exact.

    A vertex that touches no other disc, being near to a crack, goes with one neighbour: the one over the highest pass,
    of those where the field runs straight. Across a crack it does not, but counts down and up again, and dips below
    half of the higher end. Where none is straight, either side is as likely, and the vertex stays alone.

    Patches of one piece that only meet inside the solid join by links: most of the links of the one patch lead to the
    other, and two or more do. Links near a crack at either end are not asked.
    """
    edges, heights, middle = graph.surface, nodes[: len(graph)], nodes[len(graph) :]
    start, end = heights.take(edges.first), heights.take(edges.second)
    reach = SURE * graph.lengths + slack
    sure = np.minimum(start, end) + middle > reach
    rest = np.flatnonzero(~sure)
    first, second = edges.first[rest], edges.second[rest]
    start, end, pass_ = start[rest], end[rest], middle[rest]
    # Midpoints of the other edges, as nodes. One of the halves may be sure, that to the higher end.
    higher = np.maximum(start, end)
    half = higher + pass_ > reach[rest]
    top = np.where(start >= end, first, second)
    node = edges.first.copy()  # where the midpoint of a sure edge belongs
    own = np.arange(len(graph), len(graph) + len(rest), dtype=np.int32)
    node[rest] = own
    others, thirds = (x[rest] for x in graph.beside)
    near = pass_[:, None] + middle[others] > SURE * thirds + slack
    more = np.column_stack([np.where(half, top, own), np.where(near, node[others], own[:, None])])
    # Vertices without a sure edge or half edge climb; in order of rising passes, so that the highest is what stays.
    alone = np.bincount(np.concatenate([first, second]), minlength=len(graph)) == edges.degrees
    alone[top[half]] = False
    straight = np.abs(pass_ - 0.5 * (start + end)) <= STRAIGHT * np.minimum(start, end) + slack
    rows = np.flatnonzero(straight & (pass_ > 0.5 * higher))
    rows = rows[np.argsort(pass_[rows], kind="stable")]
    here = np.column_stack([first[rows], second[rows]]).ravel()
    there = np.column_stack([second[rows], first[rows]]).ravel()
    lost = alone[here]
    # Of the sure edges only those that are not implied, see Skeleton. A vertex that climbs is cut off, so its place in
    # the tree is free.
    skeleton = graph.skeleton
    columns = skeleton.parent.copy()
    cut = skeleton.child[rest]
    cut = cut[cut >= 0]
    columns[cut] = cut
    columns[here[lost]] = there[lost]
    asked = np.concatenate([skeleton.spare, skeleton.dependents[rest].ravel()])
    asked = asked[asked >= 0]
    asked = asked[sure[asked]]
    direct = np.column_stack([edges.first[asked], edges.second[asked]])
    labels = _connected(columns, more, direct)
    return _linked(graph, labels, heights) if len(graph.links) else labels


def _connected(parent: Int32Array, *more: Int32Array) -> IntArray:
    """(V,) labels from 0 of vertices that hang together with ``parent`` (V,), and by further nodes, of which each row
    (M, K) holds what one joins."""
    sizes = np.concatenate([np.full(len(rows), rows.shape[1]) for rows in (parent[:, None], *more)])
    starts = np.zeros(len(sizes) + 1, dtype=np.int32)
    np.cumsum(sizes, out=starts[1:])
    columns = np.concatenate([parent, *(rows.ravel() for rows in more)])
    matrix = csr_array((np.ones(len(columns)), columns, starts), shape=(len(sizes), len(sizes)))
    # Components are numbered as their first nodes come, so those of vertices before those of other nodes.
    return np.asarray(connected_components(matrix, directed=False)[1][: len(parent)], dtype=np.int64)


def _linked(graph: SurfaceGraph, labels: IntArray, heights: AnyFloatArray) -> IntArray:
    """The patches of labels (V,) that links join, as labels."""
    one, other, lengths = graph.link_ends
    a, b = labels.take(one), labels.take(other)
    asked = np.minimum(heights.take(one), heights.take(other)) > CLEAR * lengths
    across = (a != b) & asked
    if not across.any():
        return labels
    count = int(labels.max()) + 1
    answers = np.bincount(a[asked], minlength=count) + np.bincount(b[asked], minlength=count)
    key = np.minimum(a, b)[across] * count + np.maximum(a, b)[across]
    between, votes = np.unique(key, return_counts=True)
    patches = np.stack(np.divmod(between, count), axis=1)
    joined = (votes >= WITNESSES) & (2 * votes > answers[patches].min(axis=1))
    return Pairs(patches, count).connected(joined)[labels]
