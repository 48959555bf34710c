"""Drawing impulses over a surface: points uniform over its area, directions in a cone, severities to suit.

Datasets and assets draw from it alike, so that an asset is asked what it was trained on.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import AnyFloatArray, FloatArray, IntArray
from .frames import tangent_basis

CONE = np.deg2rad(60.0)  # half angle about the inward normal that directions are drawn from
SEVERITY = (0.3, 5.0)  # log-uniform range, times what breaks the body, or opens a first crack


class SurfacePoints:
    """Points of a surface, as a face and barycentric coordinates.

    Parameters
    ----------
    vertices : ndarray of float64, shape (V, 3)
        The vertices.
    faces : ndarray of int64, shape (F, 3)
        The faces, outward.

    Attributes
    ----------
    vertices : ndarray of float64, shape (V, 3)
        The vertices.
    faces : ndarray of int64, shape (F, 3)
        The faces, outward.
    normals : ndarray of float64, shape (F, 3)
        Outward unit normals.
    share : ndarray of float64, shape (F,)
        Of the area; they add up to 1.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self.vertices, self.faces = vertices, faces
        corner = self.vertices[self.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        double = np.linalg.norm(normal, axis=1)
        self.normals = normal / double[:, None]
        self.share = double / double.sum()

    def draw(self, count: int, rng: np.random.Generator) -> tuple[IntArray, FloatArray]:
        """Draw points uniformly over the area.

        Parameters
        ----------
        count : int
            N, how many.
        rng : numpy.random.Generator
            Where randomness comes from.

        Returns
        -------
        face : ndarray of int64, shape (N,)
            The face that each lies on.
        bary : ndarray of float64, shape (N, 3)
            Its barycentric coordinates there.
        """
        face = rng.choice(len(self.faces), size=count, p=self.share)
        bary = rng.dirichlet(np.ones(3), size=count)
        return face, bary

    def at(self, face: IntArray, bary: FloatArray) -> FloatArray:
        """Return where points lie.

        Parameters
        ----------
        face : ndarray of int64, shape (N,)
            The face that each lies on.
        bary : ndarray of float64, shape (N, 3)
            Its barycentric coordinates there.

        Returns
        -------
        ndarray of float64, shape (N, 3)
            The points, in the unit of the vertices.
        """
        return np.asarray(np.einsum("nk,nki->ni", bary, self.vertices[self.faces[face]]))

    def rows(self, field: AnyFloatArray, face: IntArray, bary: FloatArray) -> FloatArray:
        """Interpolate rows of values between the vertices; linear, so an impact field's mean stays 1.

        Parameters
        ----------
        field : ndarray, shape (V, A)
            A row of values at every vertex.
        face : ndarray of int64, shape (N, K)
            The face that each point lies on.
        bary : ndarray of float64, shape (N, K, 3)
            Its barycentric coordinates there.

        Returns
        -------
        ndarray of float64, shape (N, K, A)
            A row of values at every point.
        """
        corner = self.faces[face]
        return sum(bary[..., k, None] * field[corner[..., k]] for k in range(3))  # type: ignore[return-value]


def ratios(count: int, rng: np.random.Generator) -> FloatArray:
    """Draw severities as multiples of the one at which an impact first breaks the body, log-uniform over SEVERITY.

    Parameters
    ----------
    count : int
        N, how many.
    rng : numpy.random.Generator
        Where randomness comes from.

    Returns
    -------
    ndarray of float64, shape (N,)
        The multiples.
    """
    return np.asarray(np.exp(rng.uniform(np.log(SEVERITY[0]), np.log(SEVERITY[1]), count)))


def cone(axes: FloatArray, half_angle: float, rng: np.random.Generator) -> FloatArray:
    """Draw directions uniformly over spherical caps.

    Parameters
    ----------
    axes : ndarray of float64, shape (N, 3)
        Unit vectors, the middle of each cap.
    half_angle : float
        rad, from the middle of a cap to its rim.
    rng : numpy.random.Generator
        Where randomness comes from.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Unit vectors.
    """
    cosine = rng.uniform(np.cos(half_angle), 1.0, len(axes))
    turn = rng.uniform(0.0, 2 * np.pi, len(axes))
    first, second = tangent_basis(axes)
    sine = np.sqrt(1.0 - cosine**2)
    return np.asarray(
        cosine[:, None] * axes + (sine * np.cos(turn))[:, None] * first + (sine * np.sin(turn))[:, None] * second
    )
