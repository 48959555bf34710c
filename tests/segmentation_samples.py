"""Fields and comparisons that the tests of segmentations share."""

from __future__ import annotations

import numpy as np

from fracsim.solids.geodesics import CAP


def same(first, second):
    """Whether two labellings are the same partition."""
    together = len(np.unique(np.stack([first, second]), axis=1).T)
    return together == len(np.unique(first)) == len(np.unique(second))


def planes(points, rng, count):
    """Distance to the nearest of several random planes, capped: it has plateaus, ridges and junctions."""
    normal = rng.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = points @ normal.T - points[rng.integers(len(points), size=count)].mean(axis=0) @ normal.T
    return np.minimum(np.abs(height).min(axis=1), CAP)
