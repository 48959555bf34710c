"""Segmentation: a distance field on a surface, in; a piece label for every vertex, out.

``segment`` is the door for one field. To cut many fields of one mesh, build its SurfaceGraph once and call a function
of METHODS, or ``passes``, which check nothing. Runs online: numpy and scipy, and scikit-learn for k-means alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..common.errors import FieldError
from . import felzenszwalb as _felzenszwalb
from . import hierarchical as _hierarchical
from . import kmeans as _kmeans
from . import region_growing as _region_growing
from . import watershed as _watershed
from .graph import SurfaceGraph
from .midpoints import SLACK, midpoint_segmentation

Method = Callable[[SurfaceGraph, FloatArray, float], IntArray]

# The thesis's segmentations of a field at the vertices (V,), in units of the largest extent, and their parameters.
METHODS: dict[str, Method] = {
    "watershed": _watershed.watershed,
    "region_growing": _region_growing.region_growing,
    "hierarchical": _hierarchical.hierarchical,
    "kmeans": _kmeans.kmeans,
    "felzenszwalb": _felzenszwalb.felzenszwalb,
}
DEFAULTS: dict[str, float] = {
    "watershed": _watershed.THRESHOLD,
    "region_growing": _region_growing.MERGED,
    "hierarchical": _hierarchical.STOP,
    "kmeans": _kmeans.CLUSTERS,
    "felzenszwalb": _felzenszwalb.SCALE,
}

__all__ = ["DEFAULTS", "METHODS", "SurfaceGraph", "passes", "segment"]


def segment(
    mesh: Any,
    udf: npt.ArrayLike,
    method: str = "watershed",
    midpoints: npt.ArrayLike | None = None,
    links: npt.ArrayLike | None = None,
    threshold: float | None = None,
) -> IntArray:
    """Cut a surface along the cracks of its unsigned distance field.

    mesh: anything with ``vertices`` (V, 3) and ``faces`` (F, 3), such as a trimesh.Trimesh or a BreakableAsset.
    udf: (V,), distance to the nearest crack, in the mesh's units.
    method: watershed, region_growing, hierarchical, kmeans or felzenszwalb, the thesis's.
    midpoints: (E,), the field halfway along each of ``mesh.edges_unique`` (where a mesh has none, the edges sorted in
    lexicographic order); with it, the watershed is ours, which tells cracks apart that run between two vertices.
    links: (L, 2), vertices that face each other through the solid; k-means has no use for them, ours takes them for
    witnesses, to the others they are edges.
    threshold: the method's parameter, the thesis's unless given. watershed: the height, as a fraction of the largest
    extent, over which basins join (0.2); with midpoints, how far the field may be wrong (0). region_growing: the
    height of both ends from which regions join (0.1). hierarchical: the sum of both ends at which merging ends (0.2).
    kmeans: the number of clusters (3). felzenszwalb: its scale k (4).

    Returns (V,) labels from 0. Raises FieldError on a wrong shape or dtype, a value that is not finite, or an unknown
    method, and MeshError for a mesh that is none.
    """
    if method not in METHODS:
        raise FieldError(f"unknown segmentation {method!r}; use one of {', '.join(METHODS)}")
    graph = SurfaceGraph.of(mesh, links)
    field = _finite(udf, (len(graph),), "udf") / graph.size
    parameter = None if threshold is None else float(_finite(threshold, (), "threshold"))
    if midpoints is None:
        return METHODS[method](graph, field, DEFAULTS[method] if parameter is None else parameter)
    if method != "watershed":
        raise FieldError(f"{method} takes no midpoints; leave them out or use watershed")
    between = _finite(midpoints, (len(graph.edges),), "midpoints") / graph.size
    if hasattr(mesh, "edges_unique"):
        between = between[_order(np.asarray(mesh.edges_unique), graph)]
    return midpoint_segmentation(graph, np.concatenate([field, between]), SLACK if parameter is None else parameter)


def _order(edges: npt.NDArray[Any], graph: SurfaceGraph) -> IntArray:
    """(E,) where a mesh's own list has each edge of the graph."""
    edges = np.sort(edges, axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    if not np.array_equal(edges[order], graph.edges):
        raise FieldError("mesh.edges_unique does not list each edge of the mesh's faces once")
    return order


def _finite(values: npt.ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
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
