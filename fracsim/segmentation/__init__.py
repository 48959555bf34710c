"""Segmentation: from a distance field on a surface to a piece label for every vertex.

``segment`` segments one field. To segment many fields of one mesh, build its ``SurfaceGraph`` once and call the
methods in ``METHODS``, or ``midpoint_segmentation``, which check nothing. numpy and scipy are enough, except for
k-means, which needs scikit-learn. To add a method, write one file and one line in ``METHODS``, or call
``register_segmentation``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..common.errors import FieldError
from ..common.registry import check_new_name
from . import felzenszwalb as _felzenszwalb
from . import hierarchical as _hierarchical
from . import kmeans as _kmeans
from . import region_growing as _region_growing
from . import watershed as _watershed
from .graph import SurfaceGraph, SurfaceLike
from .midpoints import SLACK, midpoint_segmentation

__all__ = [
    "METHODS",
    "Segmentation",
    "SurfaceGraph",
    "SurfaceLike",
    "midpoint_segmentation",
    "register_segmentation",
    "segment",
]


@dataclass(frozen=True)
class Segmentation:
    """A segmentation of a field at the vertices, and the default of its one parameter.

    Attributes
    ----------
    function : callable
        ``function(graph, udf, parameter)`` gets a SurfaceGraph, the field (V,) float64 in units of the largest extent,
        and the parameter; it returns labels (V,) int64 from 0.
    default : float
        The parameter where none is given.
    """

    function: Callable[[SurfaceGraph, FloatArray, float], IntArray]
    default: float

    def __call__(self, graph: SurfaceGraph, udf: FloatArray, parameter: float | None = None) -> IntArray:
        """Label the vertices of a surface; nothing is checked.

        Parameters
        ----------
        graph : SurfaceGraph
            The surface.
        udf : ndarray of float64, shape (V,)
            Distance to the nearest crack, in units of the largest extent.
        parameter : float, optional
            The default where it is left out.

        Returns
        -------
        ndarray of int64, shape (V,)
            Piece of each vertex, from 0.
        """
        return self.function(graph, udf, self.default if parameter is None else parameter)


# The thesis's segmentations at the thesis's parameters, and those that users register.
METHODS: dict[str, Segmentation] = {
    "watershed": Segmentation(_watershed.watershed, _watershed.THRESHOLD),
    "region_growing": Segmentation(_region_growing.region_growing, _region_growing.MERGED),
    "hierarchical": Segmentation(_hierarchical.hierarchical, _hierarchical.STOP),
    "kmeans": Segmentation(_kmeans.kmeans, _kmeans.CLUSTERS),
    "felzenszwalb": Segmentation(_felzenszwalb.felzenszwalb, _felzenszwalb.SCALE),
}


def register_segmentation(
    name: str, function: Callable[[SurfaceGraph, FloatArray, float], IntArray], default: float
) -> None:
    """Add a segmentation, which ``segment``, ``fracsim evaluate`` and ``fracsim tune`` then know by its name.

    Parameters
    ----------
    name : str
        A name that is not taken.
    function : callable
        ``function(graph, udf, parameter)`` gets a SurfaceGraph, the field (V,) float64 in units of the largest extent,
        and the parameter; it returns labels (V,) int64 from 0.
    default : float
        The parameter where none is given.

    Raises
    ------
    FieldError
        If the name is taken or empty, the function cannot be called, or the default is not a finite number.
    """
    check_new_name(name, METHODS, "segmentation", FieldError)
    if not callable(function):
        raise FieldError(f"segmentation {name!r}: the function cannot be called, got {function!r}")
    if isinstance(default, bool) or not isinstance(default, (int, float)) or not math.isfinite(default):
        raise FieldError(f"segmentation {name!r}: the default must be a finite number, got {default!r}")
    METHODS[name] = Segmentation(function, default)


def segment(
    mesh: SurfaceLike,
    udf: npt.ArrayLike,
    method: str = "watershed",
    midpoints: npt.ArrayLike | None = None,
    links: npt.ArrayLike | None = None,
    threshold: float | None = None,
) -> IntArray:
    """Segment a surface along the cracks of its unsigned distance field.

    Parameters
    ----------
    mesh : SurfaceLike
        Anything with ``vertices`` (V, 3) and ``faces`` (F, 3), such as a ``trimesh.Trimesh`` or a ``BreakableAsset``.
    udf : array_like of float, shape (V,)
        Distance to the nearest crack, in the units of the mesh.
    method : str
        ``watershed``, ``region_growing``, ``hierarchical``, ``kmeans`` or ``felzenszwalb``, which are the thesis's, or
        a name given to ``register_segmentation``.
    midpoints : array_like of float, shape (E,), optional
        The field at the midpoint of each of ``mesh.edges_unique``; if the mesh has no such list, of its edges in
        lexicographic order. With it, the method must be ``watershed``, and ``midpoint_segmentation`` is used, which
        also separates pieces when a crack runs between vertices.
    links : array_like of int, shape (L, 2), optional
        Pairs of vertices that face each other through the solid. The methods treat them as edges; k-means ignores
        them; midpoint segmentation joins patches that enough of them connect.
    threshold : float, optional
        The parameter of the method; its default is the thesis's. ``watershed``: the height of a pass from which basins
        join (0.2). ``region_growing``: the height of both ends of an edge from which regions join (0.1).
        ``hierarchical``: the sum of both ends at which merging ends (0.2). ``kmeans``: the number of clusters (3).
        ``felzenszwalb``: its scale k (4). With ``midpoints``: by how much the field may be wrong (0). Heights are in
        units of the largest extent of the mesh.

    Returns
    -------
    ndarray of int64, shape (V,)
        Piece of each vertex, from 0.

    Raises
    ------
    FieldError
        If an array has a wrong shape or dtype or a value that is not finite, if the method is unknown, or if its
        function returns something else than labels (V,).
    MeshError
        If the arrays of the mesh are not those of a triangle mesh.

    Examples
    --------
    >>> import numpy as np
    >>> import fracsim
    >>> bunny = fracsim.load("bunny")
    >>> height = bunny.vertices[:, 2]
    >>> crack = height.mean()  # a horizontal cut
    >>> labels = fracsim.segment(bunny, np.abs(height - crack), "region_growing")
    >>> labels.shape == (len(bunny.vertices),)
    True
    """
    if method not in METHODS:
        raise FieldError(f"unknown segmentation {method!r}; use one of {', '.join(METHODS)}")
    graph = SurfaceGraph.of(mesh, links)
    field = _finite(udf, (len(graph),), "udf") / graph.size
    parameter = None if threshold is None else float(_finite(threshold, (), "threshold"))
    if midpoints is None:
        return _checked_labels(METHODS[method](graph, field, parameter), len(graph), method)
    if method != "watershed":
        raise FieldError(f"{method} takes no midpoints; leave them out or use watershed")
    between = _finite(midpoints, (len(graph.edges),), "midpoints") / graph.size
    mesh_edges = getattr(mesh, "edges_unique", None)  # of a trimesh.Trimesh
    if mesh_edges is not None:
        between = between[_edge_order(np.asarray(mesh_edges), graph)]
    return midpoint_segmentation(graph, np.concatenate([field, between]), SLACK if parameter is None else parameter)


def _edge_order(edges: npt.NDArray[Any], graph: SurfaceGraph) -> IntArray:
    """Find where the mesh's own list has each edge of the graph, shape (E,)."""
    edges = np.sort(edges, axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    if not np.array_equal(edges[order], graph.edges):
        raise FieldError("mesh.edges_unique does not list each edge of the mesh's faces once")
    return order


def _finite(values: npt.ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
    """Return an argument as float64 if it holds finite numbers of this shape."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise FieldError(f"{name} must be an array of numbers") from error
    if array.dtype.kind not in "fiu":
        raise FieldError(f"{name} must be an array of numbers, got {array.dtype}")
    if array.shape != shape:
        raise FieldError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise FieldError(f"{name} holds values that are not finite")
    return array.astype(np.float64)


def _checked_labels(labels: npt.ArrayLike, count: int, method: str) -> IntArray:
    """Return what a method gave if it is labels (V,); a registered method may give anything."""
    array = np.asarray(labels)
    if array.shape != (count,) or array.dtype.kind not in "iu":
        raise FieldError(
            f"segmentation {method!r} must return integers of shape ({count},), got {array.dtype} of {array.shape}"
        )
    return array.astype(np.int64, copy=False)
