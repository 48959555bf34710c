"""What several test files share: the shipped assets, and two small assets baked once a session.

What bakes is imported by the fixtures that need it, so that the tests of a simulation run where only the core is
installed; a test that asks for such a fixture is skipped there.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

import fracsim

SHIPPED = ("bunny", "chair", "vase")


@pytest.fixture(scope="session", params=SHIPPED)
def shipped(request):
    return fracsim.load(request.param)


@pytest.fixture(scope="session")
def bake_extra():
    """The extra that bakes, or a skip."""
    for module in ("torch", "trimesh", "manifold3d", "coacd"):
        pytest.importorskip(module)


@pytest.fixture(scope="session")
def quick(bake_extra):
    """Options of a bake that takes seconds."""
    from fracsim.baking import BakeOptions
    from fracsim.learning.field import FieldOptions
    from fracsim.learning.options import TrainingOptions

    training = TrainingOptions("adamw", 3e-3, 1e-3, "cosine", batch=256, steps=300)
    model = FieldOptions(eigenfunctions=24, training=training)
    return BakeOptions(cells=800, modes=3, samples=3000, evaluated=60, workers=1, model=model)


@pytest.fixture(scope="session")
def slab_mesh(bake_extra):
    """A closed box of 0.4 x 0.2 x 0.1 m, off the origin, with faces small enough to hold a field."""
    import trimesh

    mesh = trimesh.creation.box((0.4, 0.2, 0.1)).subdivide().subdivide().subdivide().subdivide()
    mesh.apply_translation((1.0, -2.0, 0.5))
    return mesh


@pytest.fixture(scope="session")
def slab(slab_mesh, quick):
    return fracsim.bake(slab_mesh, material="glass", seed=3, options=quick)


@pytest.fixture(scope="session")
def crate(quick):
    """A box of eight vertices, baked from a simulator that cuts freely into an asset of a few atoms."""
    import trimesh

    options = replace(quick, simulator="radial", cells=400, model=replace(quick.model, response=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fracsim.learning.atoms.OBSERVED", 8)
        return fracsim.bake(trimesh.creation.box((0.3, 0.2, 0.1)), options=options)


@pytest.fixture(scope="session")
def torus_dataset(bake_extra, tmp_path_factory):
    """A file of 800 fractures of a small torus, for what learns from datasets."""
    import trimesh

    from fracsim.data.writing import make_dataset
    from fracsim.simulators.registry import SimulatorOptions
    from fracsim.solids.surface import read_surface

    surface = read_surface(trimesh.creation.torus(0.5, 0.2, major_sections=24, minor_sections=12))
    path = tmp_path_factory.mktemp("torus") / "torus.h5"
    make_dataset(path, surface, 800, 1, SimulatorOptions(cells=800, modes=5))
    return path
