"""Bases of the planes at right angles to given directions; every room that needs one takes it from here."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..common.arrays import FloatArray

NEXT_AXIS, LAST_AXIS = np.array([1, 2, 0]), np.array([2, 0, 1])
STEEP = 0.9  # a normal whose x component is larger is too near to the x axis to be crossed with it


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Take cross products.

    Parameters
    ----------
    a, b : ndarray of float64, shape (..., 3)
        The vectors; the leading axes broadcast.

    Returns
    -------
    ndarray of float64, shape (..., 3)
        The products, to the bit those of ``numpy.cross``, without its checks, which outweigh the sums of a few rows.
    """
    return a[..., NEXT_AXIS] * b[..., LAST_AXIS] - a[..., LAST_AXIS] * b[..., NEXT_AXIS]


def tangent_basis(normals: FloatArray, seed: Literal["first", "smallest"] = "first") -> tuple[FloatArray, FloatArray]:
    """Find two unit vectors at right angles to each normal and to each other.

    The three are right-handed: ``cross(first, second)`` is the normal.

    Parameters
    ----------
    normals : ndarray of float64, shape (..., 3)
        Unit vectors.
    seed : {"first", "smallest"}
        The axis that a normal is crossed with. "first": x, or y where the normal is nearly along x. "smallest": the
        one along which the normal has the smallest component. Datasets drawn and assets baked before depend on the
        choice, to the bit.

    Returns
    -------
    first, second : ndarray of float64, shape (..., 3)
        The tangents.

    Examples
    --------
    >>> import numpy as np
    >>> first, second = tangent_basis(np.array([[0.0, 0.0, 1.0]]))
    >>> first.tolist(), second.tolist()
    ([[0.0, 1.0, 0.0]], [[-1.0, 0.0, 0.0]])
    """
    if seed == "first":
        axis = np.where(np.abs(normals[..., :1]) < STEEP, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    else:
        axis = np.eye(3)[np.argmin(np.abs(normals), axis=-1)]
    first = cross(normals, axis)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, cross(normals, first)
