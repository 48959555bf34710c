"""The graph that segmentations walk: a surface's vertices, edges and links, worked out once and asked often."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from ..common.arrays import BoolArray, FloatArray, Int32Array, IntArray
from ..common.errors import FieldError, MeshError


class Pairs:
    """Pairs of vertices, (P, 2) in lexicographic order, of which any choice can be joined.

    first, second: (P,) int32, their ends, first <= second.
    """

    def __init__(self, ends: IntArray, count: int) -> None:
        self.count = count
        self.first, self.second = (np.ascontiguousarray(side, dtype=np.int32) for side in ends.T)
        # A sparse matrix of fixed structure: in each row one place for where the vertex climbs to and one for each
        # pair that it is first in. A place without use holds the row's own index, which joins nothing.
        starts = np.searchsorted(self.first, np.arange(count + 1)) + np.arange(count + 1)
        self._starts = starts.astype(np.int32)
        self._places = np.arange(len(self.first)) + self.first + 1
        self._all = np.repeat(np.arange(count, dtype=np.int32), np.diff(starts))
        self._all[self._places] = self.second
        self._ones = np.ones(len(self._all))

    def connected(self, joined: BoolArray, climb: npt.NDArray[Any] | None = None) -> IntArray:
        """(V,) labels from 0 of what hangs together by the pairs joined (P,) and, where given, by every vertex and
        the vertex ``climb`` (V,) that it goes with."""
        columns = self._all.copy()
        apart = np.flatnonzero(~joined)
        columns[self._places[apart]] = self.first[apart]
        if climb is not None:
            columns[self._starts[:-1]] = climb
        matrix = csr_array((self._ones, columns, self._starts), shape=(self.count, self.count))
        return np.asarray(connected_components(matrix, directed=False)[1], dtype=np.int64)

    @cached_property
    def degrees(self) -> IntArray:
        """(V,) how many pairs each vertex is in."""
        return np.bincount(np.concatenate([self.first, self.second]), minlength=self.count)

    @cached_property
    def around(self) -> tuple[IntArray, IntArray]:
        """Starts (V,) and vertices (V + 2 P,): row by row, each vertex and then all that it is paired with."""
        alone = np.arange(self.count)
        start = np.concatenate([alone, self.first, self.second])
        order = np.argsort(start, kind="stable")
        return np.searchsorted(start[order], alone), np.concatenate([alone, self.second, self.first])[order]


@dataclass(frozen=True, eq=False)
class Skeleton:
    """As few of a surface's E edges as hang together like all of them, for as long as none is cut.

    parent: (V,) int32, a tree of edges over the vertices, or forest; a root is its own. child: (E,), the vertex below
    an edge of the tree, or -1. spare: edges that are always asked beside the tree's. dependents: (E, K), what is asked
    only where the edge is cut, or -1.

    Cross from face to face in another tree. An edge crossed on the way into a face has its ends joined by the face's
    two other edges, which are not crossed or crossed on the way further. So it adds nothing, unless one of the two is
    cut; and what is never crossed is as good as all.
    """

    parent: Int32Array
    child: IntArray
    spare: IntArray
    dependents: IntArray

    @classmethod
    def of(cls, pairs: Pairs, face_edges: IntArray) -> Self:
        """face_edges: (F, 3), the edges of each face."""
        order = np.argsort(face_edges.ravel(), kind="stable")
        edge, face = face_edges.ravel()[order], order // 3
        twice = np.flatnonzero((edge[1:] == edge[:-1]) & (face[1:] != face[:-1]))
        entered, way = _tree(face[twice], face[twice + 1], len(face_edges))
        inner = np.flatnonzero(entered >= 0)
        crossed = edge[twice][way[inner]]
        crossed, first = np.unique(crossed, return_index=True)
        others = face_edges[inner[first]]
        need = np.broadcast_to(crossed[:, None], others.shape)[others != crossed[:, None]]
        cut = others[others != crossed[:, None]]
        rows = np.argsort(cut, kind="stable")
        starts = np.searchsorted(cut[rows], np.arange(len(pairs.first) + 1))
        place = starts[:-1, None] + np.arange(max(int(np.diff(starts).max(initial=0)), 1))
        there = place < starts[1:, None]
        dependents = np.full(place.shape, -1)
        dependents[there] = need[rows][place[there]]
        kept = np.setdiff1d(np.arange(len(pairs.first)), crossed)
        above, way = _tree(pairs.first[kept], pairs.second[kept], pairs.count)
        below = np.flatnonzero(above >= 0)
        child = np.full(len(pairs.first), -1)
        child[kept[way[below]]] = below
        parent = np.where(above >= 0, above, np.arange(pairs.count)).astype(np.int32)
        return cls(parent, child, kept[child[kept] < 0], dependents)


@dataclass(frozen=True, eq=False)
class SurfaceGraph:
    """A surface of V vertices and E edges for segmentations. Lengths, and fields over it, are in units of its largest
    extent.

    vertices: (V, 3). faces: (F, 3). edges: (E, 2) in lexicographic order, and lengths (E,). links: (L, 2), vertices
    that face each other through the solid, each pair once. size: the largest extent, in the units of the surface.
    """

    vertices: FloatArray
    faces: IntArray
    edges: IntArray
    lengths: FloatArray
    links: IntArray
    size: float

    @classmethod
    def of(cls, surface: Any, links: npt.ArrayLike | None = None) -> Self:
        """surface: anything with ``vertices`` (V, 3) and ``faces`` (F, 3). links: (L, 2).

        Raises MeshError for a surface, and FieldError for links, that cannot be walked.
        """
        vertices, faces = _surface(surface)
        size = float(np.ptp(vertices, axis=0).max())
        if not (np.isfinite(size) and size > 0):
            raise MeshError(f"a surface to segment must have a finite extent above 0, got {size}")
        vertices = vertices / size
        edges = surface_edges(faces)
        lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        return cls(vertices, faces, edges, lengths, _links(links, len(vertices)), size)

    def __len__(self) -> int:
        return len(self.vertices)

    @cached_property
    def surface(self) -> Pairs:
        """What the edges join."""
        return Pairs(self.edges, len(self))

    @cached_property
    def pairs(self) -> Pairs:
        """What edges and links join, each pair once."""
        if not len(self.links):
            return self.surface
        return Pairs(np.unique(np.vstack([self.edges, self.links]), axis=0), len(self))

    @cached_property
    def face_edges(self) -> IntArray:
        """(F, 3) edge k of a face joins its corners k and k + 1."""
        code = self.edges @ [len(self), 1]
        ends = np.sort(np.stack([self.faces, np.roll(self.faces, -1, axis=1)]), axis=0)
        return np.searchsorted(code, ends[0] * len(self) + ends[1])

    @cached_property
    def skeleton(self) -> Skeleton:
        return Skeleton.of(self.surface, self.face_edges)

    @cached_property
    def beside(self) -> tuple[IntArray, FloatArray]:
        """(E, K) the edges that meet each in a corner of a face, and the lengths of the faces' third edges. Edges that
        meet fewer, at a rim, have one of theirs several times."""
        x, y, z = self.face_edges.T
        one, other = np.concatenate([x, y, z, y, z, x]), np.concatenate([y, z, x, x, y, z])
        third = self.lengths[np.concatenate([z, x, y, z, x, y])]
        order = np.argsort(one, kind="stable")
        starts = np.searchsorted(one[order], np.arange(len(self.edges) + 1))
        most = int(np.diff(starts).max())
        place = order[np.minimum(starts[:-1, None] + np.arange(most), starts[1:, None] - 1)]
        return other[place], third[place]

    @cached_property
    def link_ends(self) -> tuple[IntArray, IntArray, FloatArray]:
        """(L,) either end of the links, and their lengths."""
        one, other = (np.ascontiguousarray(side) for side in self.links.T)
        return one, other, np.linalg.norm(self.vertices[one] - self.vertices[other], axis=1)


def _tree(one: npt.NDArray[Any], other: npt.NDArray[Any], count: int) -> tuple[IntArray, IntArray]:
    """A spanning forest of a graph: above each node the next one (count,), or -1 for roots, and the pair by which."""
    ones = np.ones(len(one))
    graph = coo_array((ones, (one, other)), shape=(count, count))
    # A node more, beside one of each component, to come to all from.
    label = connected_components(graph, directed=False)[1]
    roots = np.unique(label, return_index=True)[1]
    start, end = np.concatenate([one, roots]), np.concatenate([other, np.full(len(roots), count)])
    whole = coo_array((np.ones(len(start)), (start, end)), shape=(count + 1, count + 1)).tocsr()
    above = breadth_first_order(whole, count, directed=False)[1][:count].astype(np.int64)
    above[above == count] = -1
    code = np.minimum(one, other).astype(np.int64) * count + np.maximum(one, other)
    order = np.argsort(code, kind="stable")
    below = np.arange(count)
    wanted = np.minimum(above, below) * count + np.maximum(above, below)
    return above, np.where(above >= 0, order[np.searchsorted(code[order], wanted).clip(max=len(one) - 1)], -1)


def surface_edges(faces: IntArray) -> IntArray:
    """(E, 2) the edges of a surface, each once, sorted."""
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return edges[edges[:, 0] != edges[:, 1]]  # a face that is a line has an edge that is a point


def falling(udf: FloatArray) -> tuple[IntArray, IntArray]:
    """The order (V,) of vertices by falling field, ties by index, and the rank (V,) of each in it, the last being 0."""
    order = np.argsort(-udf, kind="stable")
    rank = np.empty(len(udf), dtype=np.int64)
    rank[order] = np.arange(len(udf) - 1, -1, -1)
    return order, rank


def highest_around(pairs: Pairs, udf: FloatArray) -> IntArray:
    """(V,) the highest of each vertex and its neighbours, ties to the lower index.

    Local maxima are those that are their own. On a plateau the thesis's maxima, strictly larger than all neighbours
    (section 4.8.1), would not exist, and a field that is capped has plateaus; in this order, no two are alike.
    """
    order, rank = falling(udf)
    starts, vertices = pairs.around
    return order[len(udf) - 1 - np.maximum.reduceat(rank[vertices], starts)]


def _surface(surface: Any) -> tuple[FloatArray, IntArray]:
    try:
        vertices = np.asarray(surface.vertices, dtype=np.float64)
        faces = np.asarray(surface.faces)
    except (AttributeError, TypeError, ValueError) as error:
        raise MeshError(f"a surface to segment must have vertices and faces of numbers ({error})") from error
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise MeshError(f"vertices must have shape (V, 3), got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        raise MeshError(f"faces must be integers of shape (F, 3), got {faces.dtype} of {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"faces must name vertices from 0 to {len(vertices) - 1}")
    return vertices, faces.astype(np.int64, copy=False)


def _links(links: npt.ArrayLike | None, count: int) -> IntArray:
    if links is None:
        return np.zeros((0, 2), dtype=np.int64)
    try:
        array = np.asarray(links)
    except (TypeError, ValueError) as error:
        raise FieldError("links must be pairs of vertices") from error
    if array.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        raise FieldError(f"links must be integers of shape (L, 2), got {array.dtype} of {array.shape}")
    if array.min() < 0 or array.max() >= count:
        raise FieldError(f"links must name vertices from 0 to {count - 1}, got {array.min()} to {array.max()}")
    array = np.unique(np.sort(array.astype(np.int64, copy=False), axis=1), axis=0)
    return array[array[:, 0] != array[:, 1]]
