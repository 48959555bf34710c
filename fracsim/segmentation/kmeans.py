"""k-means over positions and distances; it knows no surface. The only segmentation that needs scikit-learn."""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import FieldError, MissingExtraError
from .graph import SurfaceGraph

CLUSTERS = 3
CLIP = 0.5  # of the largest extent, to which larger distances are clipped (both: thesis, section 4.8.1)
ITERATIONS = 300
SEED = 1


def kmeans(graph: SurfaceGraph, udf: FloatArray, clusters: float = CLUSTERS) -> IntArray:
    """(V,) cluster labels of a vertex field (thesis, Algorithm 4), iterated until none changes, ITERATIONS at most.

    The first centres are chosen as by k-means++ (Arthur and Vassilvitskii 2007), from a fixed seed. A vertex as near
    to two centres goes where rounding takes it.
    """
    try:
        from sklearn.cluster import KMeans
    except ImportError as error:
        raise MissingExtraError("scikit-learn", "bake") from error
    points = features(graph.vertices, udf)
    first = centres(points, clusters)
    found = KMeans(len(first), init=first, n_init=1, max_iter=ITERATIONS, tol=0.0, algorithm="lloyd").fit(points)
    return np.asarray(found.labels_, dtype=np.int64)


def features(vertices: FloatArray, udf: FloatArray) -> FloatArray:
    """(V, 4): x, y, z and the clipped field."""
    return np.column_stack([vertices, np.minimum(udf, CLIP)])


def centres(points: FloatArray, clusters: float) -> FloatArray:
    """(K, 4) where the iteration starts."""
    from sklearn.cluster import kmeans_plusplus

    count = int(clusters)
    if count != clusters or not 1 <= count <= len(points):
        raise FieldError(f"k-means needs a whole number of clusters from 1 to {len(points)}, got {clusters}")
    return np.asarray(kmeans_plusplus(points, count, random_state=SEED)[0])
