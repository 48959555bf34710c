"""Segmentation: a distance field on a surface, in; a piece label for every vertex, out."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import FieldError
from .watershed import THRESHOLD, watershed, watershed_passes

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

METHODS = ("watershed",)


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
    udf: (V,), distance to the nearest crack, in the mesh's units. midpoints: (E,), the same halfway along each
    of ``mesh.edges_unique`` (where a mesh has none, the edges sorted in lexicographic order); with it, cracks
    that run between two vertices are told apart. links: (L, 2), vertices joined through the solid.
    threshold: for the vertex-only method, as a fraction of the largest extent (0.2 in the thesis).

    Returns (V,) labels from 0. Raises FieldError on a wrong shape, a value that is not finite, or an unknown
    method.
    """
    if method not in METHODS:
        raise FieldError(f"unknown segmentation {method!r}; use one of {', '.join(METHODS)}")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    size = float(np.ptp(vertices, axis=0).max())
    field = _finite(udf, (len(vertices),), "udf") / size
    edges = np.asarray(mesh.edges_unique) if hasattr(mesh, "edges_unique") else surface_edges(faces)
    extra = np.zeros((0, 2), np.int64) if links is None else np.asarray(links, dtype=np.int64).reshape(-1, 2)
    if midpoints is None:
        return watershed(field, np.vstack([edges, extra]), THRESHOLD if threshold is None else threshold)
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) / size
    passes = _finite(midpoints, (len(edges),), "midpoints") / size
    return watershed_passes(field, passes, edges, lengths, extra)


def surface_edges(faces: IntArray) -> IntArray:
    """(E, 2) the edges of a surface, each once, sorted."""
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def _finite(values: npt.ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FieldError(f"{name} must be an array of numbers") from error
    if array.shape != shape:
        raise FieldError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise FieldError(f"{name} holds values that are not finite")
    return array
