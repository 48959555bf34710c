"""Gradient, divergence and what follows from them on a surface: the discrete operators of DeltaConv. Offline only.

``deltaconv`` is made of them. Scalars have a value at each vertex, tangent vectors two along the vertex's own frame.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError, ModelError
from ..geometry.frames import tangent_basis
from ..solids.surface import Surface

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

REGULARISER = 1e-3  # of the least squares, against the mean square of a neighbourhood's extent
PLANES_FACE_AWAY = 1e-6  # twice a cosine: below it, two tangent planes face away from each other


@dataclass(frozen=True, eq=False)
class Calculus:
    """Derivatives at the V vertices of a surface.

    Scalars are f (V,). Tangent vectors are u (2V,), whose rows 2i and 2i + 1 are along the frame of vertex i.

    Attributes
    ----------
    frames : ndarray of float64, shape (V, 2, 3)
        Two unit vectors at each vertex, orthogonal to its normal and to each other.
    gradient : csr_matrix of float64, shape (2V, V)
        Of scalars.
    divergence : csr_matrix of float64, shape (V, 2V)
        Of tangent vectors.
    neighbours : ndarray of int64, shape (V, K)
        The vertices that each derivative looks at.
    """

    frames: FloatArray
    gradient: sp.csr_matrix
    divergence: sp.csr_matrix
    neighbours: IntArray


def tangent_frames(surface: Surface) -> FloatArray:
    """Choose two unit vectors at each vertex, orthogonal to its normal and to each other.

    Parameters
    ----------
    surface : Surface
        With V vertices.

    Returns
    -------
    ndarray of float64, shape (V, 2, 3)
        The frames.
    """
    normals = np.asarray(surface.trimesh.vertex_normals)
    return -np.stack(tangent_basis(normals), axis=1)  # the sign that trained models know


def calculus(vertices: FloatArray, frames: FloatArray, neighbours: int, kernel: float) -> Calculus:
    """Work out derivatives by least squares over the nearest neighbours in space.

    The gradient is fitted in each tangent plane, with the neighbours weighted by a Gaussian. The divergence is worked
    out the same way, of vectors that are first rotated from each neighbour's tangent plane into the vertex's own.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        Points of the surface.
    frames : ndarray of float64, shape (V, 2, 3)
        See ``tangent_frames``.
    neighbours : int
        Of each vertex, itself not counted; K.
    kernel : float
        Width of the Gaussian, in mean distances between neighbours.

    Returns
    -------
    Calculus
        The derivatives.

    Raises
    ------
    ModelError
        Where there are not that many neighbours.

    References ---------- Wiersma et al., DeltaConv: Anisotropic Operators for Geometric Deep Learning on Point Clouds,
    2022, section 3; thesis, section 3.1.
    """
    count = len(vertices)
    if neighbours >= count:
        raise ModelError(f"neighbours must be below the number of vertices, {count}; got {neighbours}")
    far, near = cKDTree(vertices).query(vertices, neighbours + 1)
    far, near = far[:, 1:], near[:, 1:]
    weight = np.exp(-((far / (kernel * far.mean())) ** 2))
    arm = np.einsum("vka,vda->vkd", vertices[near] - vertices[:, None], frames)  # (V, K, 2)
    moment = np.einsum("vk,vkd,vke->vde", weight, arm, arm)
    trace = np.trace(moment, axis1=1, axis2=2)
    moment += REGULARISER * 0.5 * trace[:, None, None] * np.eye(2)
    stencil = np.linalg.solve(moment, np.einsum("vk,vkd->vdk", weight, arm))  # (V, 2, K): of f_j - f_i
    # The least rotation that takes one tangent plane to another is the orthogonal part of the projection between.
    onto = np.einsum("vda,vkea->vkde", frames, frames[near])
    cosine, sine = onto[..., 0, 0] + onto[..., 1, 1], onto[..., 1, 0] - onto[..., 0, 1]
    length = np.hypot(cosine, sine)
    defined = length > PLANES_FACE_AWAY  # else no rotation is the least
    cosine, sine = (np.divide(x, length, out=np.zeros_like(length), where=defined) for x in (cosine, sine))
    rotation = np.stack([np.stack([cosine, -sine], axis=-1), np.stack([sine, cosine], axis=-1)], axis=-2)
    spread = np.einsum("vdk,vkde->vke", stencil, rotation)

    index = np.arange(count)
    rows = 2 * index[:, None, None] + np.arange(2)[:, None]  # (V, 2, 1)
    gradient = sp.csr_matrix(
        (stencil.ravel(), (np.broadcast_to(rows, stencil.shape).ravel(), np.repeat(near, 2, axis=0).ravel())),
        shape=(2 * count, count),
    ) - sp.csr_matrix((stencil.sum(axis=2).ravel(), (np.arange(2 * count), np.repeat(index, 2))), (2 * count, count))
    columns = 2 * near[:, :, None] + np.arange(2)  # (V, K, 2)
    divergence = sp.csr_matrix(
        (spread.ravel(), (np.repeat(index, 2 * neighbours), columns.ravel())), shape=(count, 2 * count)
    ) - sp.csr_matrix((stencil.sum(axis=2).ravel(), (np.repeat(index, 2), np.arange(2 * count))), (count, 2 * count))
    return Calculus(frames, sp.csr_matrix(gradient), sp.csr_matrix(divergence), near)


def rotated(u: torch.Tensor) -> torch.Tensor:
    """Rotate tangent vectors (V, 2, ...) by 90 degrees about the normal: the operator J.

    Parameters
    ----------
    u : Tensor, shape (V, 2, ...)
        Tangent vectors.

    Returns
    -------
    Tensor, shape (V, 2, ...)
        J u.
    """
    return torch.stack([-u[:, 1], u[:, 0]], dim=1)


class SparseProduct(torch.autograd.Function):
    """A constant sparse matrix times dense columns, with the transposed matrix for its derivative."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, matrix: torch.Tensor, transposed: torch.Tensor) -> torch.Tensor:
        """Work out matrix @ x."""
        ctx.transposed = transposed
        return matrix @ x

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        """Work out transposed @ gradient."""
        return ctx.transposed @ gradients[0].contiguous(), None, None


class Operators:
    """The derivatives of ``Calculus`` on tensors of features: scalars (V, B, C) and tangent vectors (V, 2, B, C).

    Both are divided by the largest norm of the gradient at a vertex, so that features keep their size whatever the
    mesh's resolution, as published.

    Parameters
    ----------
    derivatives : Calculus
        The derivatives.
    device : device
        Where features are.

    References
    ----------
    Wiersma et al., DeltaConv, 2022, section 3.
    """

    def __init__(self, derivatives: Calculus, device: torch.device) -> None:
        lengths = (
            derivatives.gradient[::2].power(2) + derivatives.gradient[1::2].power(2)
        ).sqrt()  # the same in all frames
        scale = 1.0 / float(lengths.sum(axis=1).max())
        self.matrices = {
            name: (_csr(scale * matrix, device), _csr(scale * matrix.T, device))
            for name, matrix in (("gradient", derivatives.gradient), ("divergence", derivatives.divergence))
        }
        neighbours = np.hstack([np.arange(len(derivatives.neighbours))[:, None], derivatives.neighbours])
        self.neighbours = torch.as_tensor(neighbours, device=device)

    def _times(self, name: str, x: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
        matrix, transposed = self.matrices[name]
        with torch.autocast(x.device.type, enabled=False):
            return SparseProduct.apply(x.float().reshape(matrix.shape[1], -1), matrix, transposed).reshape(shape)  # type: ignore[no-untyped-call]

    def gradient(self, x: torch.Tensor) -> torch.Tensor:
        """Take scalars (V, B, C) to their gradients (V, 2, B, C)."""
        return self._times("gradient", x, (len(x), 2, *x.shape[1:]))

    def divergence(self, u: torch.Tensor) -> torch.Tensor:
        """Take vectors (V, 2, B, C) to their divergences (V, B, C)."""
        return self._times("divergence", u, (len(u), *u.shape[2:]))

    def curl(self, u: torch.Tensor) -> torch.Tensor:
        """Take vectors (V, 2, B, C) to their curls (V, B, C): minus the divergence of J u."""
        return -self.divergence(rotated(u))

    def hodge_laplacian(self, divergence: torch.Tensor, curl: torch.Tensor) -> torch.Tensor:
        """Work out the Hodge Laplacian -(G D - J G D J) u, with G for the gradient and D for the divergence.

        Parameters
        ----------
        divergence, curl : Tensor, shape (V, B, C)
            Of the vectors u.

        Returns
        -------
        Tensor, shape (V, 2, B, C)
            The Laplacian of u.
        """
        count = divergence.shape[-1]
        both = self.gradient(torch.cat([divergence, curl], dim=-1))
        return -(both[..., :count] + rotated(both[..., count:]))

    def largest(self, x: torch.Tensor) -> torch.Tensor:
        """Take the greatest value among a vertex and its neighbours, (V, B, C)."""
        result = x
        for column in self.neighbours.T[1:]:
            result = torch.maximum(result, x[column])
        return result


def _csr(matrix: sp.spmatrix, device: torch.device) -> torch.Tensor:
    matrix = sp.csr_matrix(matrix)
    matrix.sort_indices()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta state")
        return torch.sparse_csr_tensor(
            torch.as_tensor(matrix.indptr, dtype=torch.int64),
            torch.as_tensor(matrix.indices, dtype=torch.int64),
            torch.as_tensor(matrix.data, dtype=torch.float32),
            matrix.shape,
            check_invariants=True,
        ).to(device)
