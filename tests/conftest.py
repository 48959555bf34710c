"""What several test files share: the shipped assets, and one small asset baked once a session."""

from __future__ import annotations

import pytest
import trimesh

import fracsim
from fracsim.baking import BakeOptions
from fracsim.train import TrainingOptions

SHIPPED = ("bunny", "chair", "vase")
QUICK = BakeOptions(
    cells=800, modes=5, samples=3000, eigenfunctions=24, evaluated=60, workers=1, training=TrainingOptions(steps=300)
)


@pytest.fixture(scope="session", params=SHIPPED)
def shipped(request):
    return fracsim.load(request.param)


@pytest.fixture(scope="session")
def slab_mesh():
    """A closed box of 0.4 x 0.2 x 0.1 m, off the origin, with faces small enough to hold a field."""
    mesh = trimesh.creation.box((0.4, 0.2, 0.1)).subdivide().subdivide().subdivide().subdivide()
    mesh.apply_translation((1.0, -2.0, 0.5))
    return mesh


@pytest.fixture(scope="session")
def slab(slab_mesh):
    return fracsim.bake(slab_mesh, material="glass", seed=3, options=QUICK)
