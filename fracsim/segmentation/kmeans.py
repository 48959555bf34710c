"""k-means over positions and distances. It does not use the edges of the surface.

The only segmentation that needs scikit-learn, which it imports when it is called; every room above ``common`` may use
it.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import FieldError, MissingExtraError
from .graph import SurfaceGraph

CLUSTERS = 3  # thesis, section 4.8.1
CLIP = 0.5  # of the largest extent: larger distances count as this (thesis, section 4.8.1)
ITERATIONS = 300  # at most; a bound that fields do not come near
SEED = 1  # of the first centres, so that a field always gives the same labels


def kmeans(graph: SurfaceGraph, udf: FloatArray, clusters: float = CLUSTERS) -> IntArray:
    """Label the clusters of positions and distances (thesis, Algorithm 4), iterated until no label changes.

    The first centres are chosen as in k-means++ (Arthur and Vassilvitskii 2007), from a fixed seed. A vertex that is
    equally near to two centres goes to either, as rounding decides.

    Parameters
    ----------
    graph : SurfaceGraph
        The surface, of which only the vertices are used.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.
    clusters : float
        The number of clusters, a whole number from 1 to V.

    Returns
    -------
    ndarray of int64, shape (V,)
        Cluster of each vertex, from 0.

    Raises
    ------
    FieldError
        If the number of clusters is not a whole number in that range.
    MissingExtraError
        If scikit-learn is not installed.
    """
    try:
        from sklearn.cluster import KMeans
    except ImportError as error:
        raise MissingExtraError("scikit-learn", "bake") from error
    points = features(graph.vertices, udf)
    first = first_centres(points, clusters)
    fitted = KMeans(len(first), init=first, n_init=1, max_iter=ITERATIONS, tol=0.0, algorithm="lloyd").fit(points)
    return np.asarray(fitted.labels_, dtype=np.int64)


def features(vertices: FloatArray, udf: FloatArray) -> FloatArray:
    """Stack what is clustered: x, y, z and the clipped field.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Positions, in units of the largest extent.
    udf : ndarray of float64, shape (V,)
        Distance to the nearest crack, in units of the largest extent.

    Returns
    -------
    ndarray of float64, shape (V, 4)
        One row a vertex.
    """
    return np.column_stack([vertices, np.minimum(udf, CLIP)])


def first_centres(points: FloatArray, clusters: float) -> FloatArray:
    """Choose the centres that the iteration starts from.

    Parameters
    ----------
    points : ndarray of float64, shape (V, 4)
        What ``features`` returns.
    clusters : float
        The number of clusters, a whole number from 1 to V.

    Returns
    -------
    ndarray of float64, shape (K, 4)
        One row a cluster.

    Raises
    ------
    FieldError
        If the number of clusters is not a whole number in that range.
    """
    from sklearn.cluster import kmeans_plusplus

    count = int(clusters)
    if count != clusters or not 1 <= count <= len(points):
        raise FieldError(f"k-means needs a whole number of clusters from 1 to {len(points)}, got {clusters}")
    return np.asarray(kmeans_plusplus(points, count, random_state=SEED)[0])
