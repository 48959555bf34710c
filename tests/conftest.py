"""What several test files share: the shipped assets, and two small assets baked once a session."""

from __future__ import annotations

from dataclasses import replace

import pytest
import trimesh

import fracsim
from fracsim.baking import BakeOptions
from fracsim.data.writing import make_dataset
from fracsim.learning.field import FieldOptions
from fracsim.learning.options import TrainingOptions
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.surface import read_surface

SHIPPED = ("bunny", "chair", "vase")
LEARNING = TrainingOptions("adamw", 3e-3, 1e-3, "cosine", batch=256, steps=300)
QUICK = BakeOptions(
    cells=800,
    modes=3,
    samples=3000,
    evaluated=60,
    workers=1,
    model=FieldOptions(eigenfunctions=24, training=LEARNING),
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


@pytest.fixture(scope="session")
def crate():
    """A box of eight vertices, baked from a truth that cuts freely into an asset of a few atoms."""
    options = replace(QUICK, simulator="radial", cells=400, model=replace(QUICK.model, response=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fracsim.learning.atoms.OBSERVED", 8)
        return fracsim.bake(trimesh.creation.box((0.3, 0.2, 0.1)), options=options)


@pytest.fixture(scope="session")
def torus_dataset(tmp_path_factory):
    """A file of 800 fractures of a small torus, for what learns from datasets."""
    surface = read_surface(trimesh.creation.torus(0.5, 0.2, major_sections=24, minor_sections=12))
    path = tmp_path_factory.mktemp("torus") / "torus.h5"
    make_dataset(path, surface, 800, 1, SimulatorOptions(cells=800, modes=5))
    return path
