"""Importing fracsim is light, registers the environment, and knows every name of its contract."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import pytest

import fracsim

HEAVY = ("scipy", "pybullet", "torch", "trimesh", "coacd", "potpourri3d", "networkx", "matplotlib", "sklearn")


def loaded_by(code: str) -> set[str]:
    script = f"import sys\n{code}\nprint(*sorted(sys.modules), sep='\\n')"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return {name.split(".")[0] for name in result.stdout.split()}


def test_import_loads_numpy_and_gymnasium_and_nothing_heavier():
    assert loaded_by("import fracsim").isdisjoint(HEAVY)


def test_breaking_an_asset_needs_nothing_that_only_baking_needs():
    modules = loaded_by(
        "import fracsim; a = fracsim.load('bunny'); a.fracture(a.sample_impulses(1, 0)).pieces[0].faces"
    )
    assert modules.isdisjoint({"torch", "trimesh", "coacd", "potpourri3d", "networkx", "manifold3d", "sklearn"})


def test_the_environment_is_registered_by_the_import():
    assert gym.spec("FractureDrop-v0").max_episode_steps == 300


@pytest.mark.parametrize("name", fracsim.__all__)
def test_every_public_name_resolves(name):
    assert getattr(fracsim, name) is not None


def test_metrics_and_environments_are_at_hand_without_another_import():
    assert loaded_by("import fracsim; fracsim.metrics.mse; fracsim.envs.FractureDropEnv").isdisjoint(
        {"torch", "sklearn"}
    )


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        fracsim.nonsense  # noqa: B018
