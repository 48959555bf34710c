"""The graph that every segmentation walks: a surface's vertices, edges and links, built once and queried often.

It imports numpy and scipy only, and may be used by every room above ``common``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ..common.arrays import BoolArray, FloatArray, Int32Array, IntArray
from ..common.errors import FieldError, MeshError


class SurfaceLike(Protocol):
    """A triangle mesh, such as a ``trimesh.Trimesh`` or a ``BreakableAsset``.

    Attributes
    ----------
    vertices : array_like of float, shape (V, 3)
        Positions, in metres.
    faces : array_like of int, shape (F, 3)
        Indices of the three vertices of each triangle.
    """

    @property
    def vertices(self) -> Any:
        """Positions of the vertices (V, 3), in metres."""

    @property
    def faces(self) -> Any:
        """Indices of the three vertices of each triangle (F, 3)."""


class Pairs:
    """Pairs of vertices, from which the connected components of any subset can be computed quickly.

    Parameters
    ----------
    ends : ndarray of int64, shape (P, 2)
        The two vertices of each pair, the lower index first, in lexicographic order.
    count : int
        The number of vertices, V.

    Attributes
    ----------
    count : int
        The number of vertices, V.
    first, second : ndarray of int32, shape (P,)
        The two vertices of each pair, ``first < second``.
    """

    def __init__(self, ends: IntArray, count: int) -> None:
        self.count = count
        self.first, self.second = (np.ascontiguousarray(side, dtype=np.int32) for side in ends.T)
        # A sparse matrix of fixed structure. Each row has one entry for the vertex that this vertex follows, and one
        # for each pair whose first vertex it is. An entry that is not used holds the row's own index, which connects
        # nothing.
        starts = np.searchsorted(self.first, np.arange(count + 1)) + np.arange(count + 1)
        self._starts = starts.astype(np.int32)
        self._places = np.arange(len(self.first)) + self.first + 1
        self._all = np.repeat(np.arange(count, dtype=np.int32), np.diff(starts))
        self._all[self._places] = self.second

    def connected(
        self, joined: BoolArray, follows: npt.NDArray[Any] | None = None, extra: Int32Array | None = None
    ) -> IntArray:
        """Label the connected components of the vertices.

        Parameters
        ----------
        joined : ndarray of bool, shape (P,)
            Which pairs connect their two vertices.
        follows : ndarray of int, shape (V,), optional
            One more vertex that each vertex is connected to; its own index for none.
        extra : ndarray of int32, shape (M, K), optional
            Row m belongs to a further node V + m, and lists K vertices or further nodes that it is connected to.

        Returns
        -------
        ndarray of int64, shape (V,)
            Labels of the vertices, 0, 1, 2, ... in the order in which the components first appear.
        """
        columns = self._all.copy()
        apart = np.flatnonzero(~joined)
        columns[self._places[apart]] = self.first[apart]
        if follows is not None:
            columns[self._starts[:-1]] = follows
        starts = self._starts
        if extra is not None and len(extra):
            columns = np.concatenate([columns, extra.ravel()])
            starts = np.concatenate(
                [starts, starts[-1] + extra.shape[1] * np.arange(1, len(extra) + 1, dtype=np.int32)]
            )
        size = len(starts) - 1
        matrix = csr_array((np.ones(len(columns)), columns, starts), shape=(size, size))
        return np.asarray(connected_components(matrix, directed=False)[1][: self.count], dtype=np.int64)

    @cached_property
    def degrees(self) -> IntArray:
        """The number of pairs that each vertex is in, shape (V,)."""
        return np.bincount(np.concatenate([self.first, self.second]), minlength=self.count)

    @cached_property
    def neighbours(self) -> tuple[IntArray, IntArray]:
        """Each vertex followed by its neighbours.

        Returns
        -------
        starts : ndarray of int64, shape (V,)
            Where the list of each vertex begins in ``vertices``.
        vertices : ndarray of int64, shape (V + 2 P,)
            The lists, one after another.
        """
        itself = np.arange(self.count)
        owner = np.concatenate([itself, self.first, self.second])
        order = np.argsort(owner, kind="stable")
        return np.searchsorted(owner[order], itself), np.concatenate([itself, self.second, self.first])[order]


@dataclass(frozen=True, eq=False)
class SurfaceGraph:
    """A surface of V vertices, F faces, E edges and L links, prepared for segmentations.

    Lengths, and the distance fields given to segmentations, are in units of the largest extent of the surface.

    Attributes
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Positions, in units of the largest extent.
    faces : ndarray of int64, shape (F, 3)
        Vertices of the triangles.
    edges : ndarray of int64, shape (E, 2)
        Vertices of the edges, the lower index first, in lexicographic order.
    lengths : ndarray of float64, shape (E,)
        Lengths of the edges, in units of the largest extent.
    links : ndarray of int64, shape (L, 2)
        Pairs of vertices that face each other through the solid, each pair once.
    size : float
        The largest extent, in the units of the surface.
    """

    vertices: FloatArray
    faces: IntArray
    edges: IntArray
    lengths: FloatArray
    links: IntArray
    size: float

    @classmethod
    def of(cls, surface: SurfaceLike, links: npt.ArrayLike | None = None) -> Self:
        """Build the graph of a surface.

        Parameters
        ----------
        surface : SurfaceLike
            Anything with ``vertices`` (V, 3) and ``faces`` (F, 3).
        links : array_like of int, shape (L, 2), optional
            Pairs of vertices that face each other through the solid.

        Returns
        -------
        SurfaceGraph
            The graph.

        Raises
        ------
        MeshError
            If the arrays of the surface have a wrong shape or dtype, or no finite extent.
        FieldError
            If the links are not pairs of vertices of the surface.
        """
        vertices, faces = _checked_surface(surface)
        size = float(np.ptp(vertices, axis=0).max())
        if not (np.isfinite(size) and size > 0):
            raise MeshError(f"a surface to segment must have a finite extent above 0, got {size}")
        vertices = vertices / size
        edges = surface_edges(faces)
        lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        return cls(vertices, faces, edges, lengths, _checked_links(links, len(vertices)), size)

    def __len__(self) -> int:
        """Return the number of vertices."""
        return len(self.vertices)

    @cached_property
    def surface(self) -> Pairs:
        """The pairs of vertices that edges connect."""
        return Pairs(self.edges, len(self))

    @cached_property
    def pairs(self) -> Pairs:
        """The pairs of vertices that edges or links connect, each pair once."""
        if not len(self.links):
            return self.surface
        return Pairs(np.unique(np.vstack([self.edges, self.links]), axis=0), len(self))

    @cached_property
    def face_edges(self) -> IntArray:
        """Indices of the three edges of each face, shape (F, 3): edge k joins corners k and k + 1."""
        code = self.edges @ [len(self), 1]
        ends = np.sort(np.stack([self.faces, np.roll(self.faces, -1, axis=1)]), axis=0)
        return np.searchsorted(code, ends[0] * len(self) + ends[1])

    @cached_property
    def adjacent_edges(self) -> tuple[IntArray, FloatArray]:
        """The edges that share a face with each edge.

        An edge at the rim of an open surface has fewer such edges than others; it lists one of them several times.

        Returns
        -------
        adjacent : ndarray of int64, shape (E, K)
            Indices of the edges.
        third_lengths : ndarray of float64, shape (E, K)
            The length of the remaining edge of the face that the two edges share.
        """
        x, y, z = self.face_edges.T
        edge, other = np.concatenate([x, y, z, y, z, x]), np.concatenate([y, z, x, x, y, z])
        third_lengths = self.lengths[np.concatenate([z, x, y, z, x, y])]
        order = np.argsort(edge, kind="stable")
        starts = np.searchsorted(edge[order], np.arange(len(self.edges) + 1))
        width = int(np.diff(starts).max())
        place = order[np.minimum(starts[:-1, None] + np.arange(width), starts[1:, None] - 1)]
        return other[place], third_lengths[place]

    @cached_property
    def link_ends(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The first vertex, the second vertex and the length of each link, three arrays of shape (L,)."""
        first, second = (np.ascontiguousarray(side) for side in self.links.T)
        return first, second, np.linalg.norm(self.vertices[first] - self.vertices[second], axis=1)


def surface_edges(faces: IntArray) -> IntArray:
    """List the edges of a triangle mesh.

    Parameters
    ----------
    faces : ndarray of int64, shape (F, 3)
        Vertices of the triangles.

    Returns
    -------
    ndarray of int64, shape (E, 2)
        Every edge once, the lower index first, in lexicographic order.
    """
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return edges[edges[:, 0] != edges[:, 1]]  # a face with a repeated vertex has an edge of length 0


def descending_order(udf: FloatArray) -> tuple[IntArray, IntArray]:
    """Sort vertices by falling field value; of equal values, the lower index comes first.

    Parameters
    ----------
    udf : ndarray of float64, shape (V,)
        The field.

    Returns
    -------
    order : ndarray of int64, shape (V,)
        The vertices in that order.
    rank : ndarray of int64, shape (V,)
        ``rank[order[i]] == V - 1 - i``: the highest vertex has rank V - 1, the last one 0.
    """
    order = np.argsort(-udf, kind="stable")
    rank = np.empty(len(udf), dtype=np.int64)
    rank[order] = np.arange(len(udf) - 1, -1, -1)
    return order, rank


def highest_neighbour(pairs: Pairs, udf: FloatArray) -> IntArray:
    """Find the highest of each vertex and its neighbours; of equal values, the lower index.

    A vertex that is its own highest neighbour is a local maximum. The thesis asks a maximum to be strictly larger than
    all its neighbours (section 4.8.1). A field that is capped has plateaus, which would have no maximum then; in this
    order no two vertices are equal.

    Parameters
    ----------
    pairs : Pairs
        Which vertices are neighbours.
    udf : ndarray of float64, shape (V,)
        The field.

    Returns
    -------
    ndarray of int64, shape (V,)
        Index of the highest vertex.
    """
    order, rank = descending_order(udf)
    starts, vertices = pairs.neighbours
    return order[len(udf) - 1 - np.maximum.reduceat(rank[vertices], starts)]


def _checked_surface(surface: SurfaceLike) -> tuple[FloatArray, IntArray]:
    """Check the vertices and faces of a surface that a user gave, and return them."""
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


def _checked_links(links: npt.ArrayLike | None, count: int) -> IntArray:
    """Check links that a user gave, and return each pair once, sorted."""
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
