"""Surfaces with known cracks, for the tests of segmentations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from fracsim.segmentation.graph import SurfaceGraph
from fracsim.solids.geodesics import CAP
from fracsim.solids.surface import Surface, read_surface, refine
from fracsim.solids.walls import facing_vertices

MESHES = Path(__file__).parents[2] / "meshes"
CRACK = 0.013  # rad, the latitude of the ball's crack


@pytest.fixture(scope="module", params=["bunny", "vase"])
def real(request):
    surface = refine(read_surface(MESHES / f"{request.param}.obj"))
    return SurfaceGraph.of(surface, facing_vertices(surface))


@pytest.fixture(scope="module")
def ball():
    """A sphere of diameter 1 m, and the distance of its vertices and midpoints to a parallel near its equator."""
    mesh = trimesh.creation.icosphere(4, radius=0.5)

    def latitude(points):
        return 0.5 * np.abs(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)) - CRACK)

    return mesh, latitude(mesh.vertices), latitude(mesh.vertices[mesh.edges_unique].mean(axis=1))


@pytest.fixture(scope="module")
def plate():
    """A plate cracked along a circle, whose two sides only links connect inside the circle.

    Its graph with and without links, the field at its nodes, and which vertices are inside the circle.
    """
    box = trimesh.creation.box((1.0, 1.0, 0.04))
    surface = refine(
        Surface(np.asarray(box.vertices), np.asarray(box.faces, np.int64), 1.0, np.zeros(3), "plate"), 0.04
    )
    linked, plain = SurfaceGraph.of(surface, facing_vertices(surface)), SurfaceGraph.of(surface)
    nodes = np.vstack([plain.vertices, plain.vertices[plain.edges].mean(axis=1)])
    radius = np.linalg.norm(nodes[:, :2], axis=1)
    return linked, plain, np.minimum(np.abs(radius - 0.23), CAP), radius[: len(plain)] < 0.23
