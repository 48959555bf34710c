"""Drawing impulses over a surface: points uniform over its area, directions in a cone, severities to suit."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray

CONE = np.deg2rad(60.0)  # half angle about the inward normal that directions are drawn from
SEVERITY = (0.3, 5.0)  # log-uniform range, of the severity at which the impact would first part the body


class SurfacePoints:
    """Points of a surface, as a face and barycentric coordinates."""

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self.vertices, self.faces = vertices, faces
        corner = self.vertices[self.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        double = np.linalg.norm(normal, axis=1)
        self.normals = normal / double[:, None]
        self.share = double / double.sum()

    def draw(self, count: int, rng: np.random.Generator) -> tuple[IntArray, FloatArray]:
        face = rng.choice(len(self.faces), size=count, p=self.share)
        bary = rng.dirichlet(np.ones(3), size=count)
        return face, bary

    def at(self, face: IntArray, bary: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nk,nki->ni", bary, self.vertices[self.faces[face]]))

    def rows(self, field: npt.NDArray[np.floating[Any]], face: IntArray, bary: FloatArray) -> FloatArray:
        """Values (N, K, A) at points between vertices; linear, so an impact field's mean stays 1."""
        corner = self.faces[face]
        return sum(bary[..., k, None] * field[corner[..., k]] for k in range(3))  # type: ignore[return-value]


def ratios(count: int, rng: np.random.Generator) -> FloatArray:
    """(N,) severities as multiples of the threshold, log-uniform over SEVERITY."""
    return np.asarray(np.exp(rng.uniform(np.log(SEVERITY[0]), np.log(SEVERITY[1]), count)))


def cone(axes: FloatArray, half_angle: float, rng: np.random.Generator) -> FloatArray:
    """Directions uniform over the spherical caps of ``half_angle`` about unit ``axes`` (N, 3)."""
    cosine = rng.uniform(np.cos(half_angle), 1.0, len(axes))
    turn = rng.uniform(0.0, 2 * np.pi, len(axes))
    helper = np.where(np.abs(axes[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(axes, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(axes, first)
    sine = np.sqrt(1.0 - cosine**2)
    return np.asarray(
        cosine[:, None] * axes + (sine * np.cos(turn))[:, None] * first + (sine * np.sin(turn))[:, None] * second
    )
