"""Importing fracsim is light, a simulation loads nothing of the offline half, and every public name is there."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import pytest

import fracsim

OFFLINE = {
    *("torch", "trimesh", "networkx", "manifold3d", "clarabel", "potpourri3d", "coacd", "sklearn", "joblib"),
    *("threadpoolctl", "h5py", "tqdm", "tensorboard", "skfem", "wildmeshing", "matplotlib", "PIL", "optuna", "ray"),
}
BREAK = """
import pybullet
client = pybullet.connect(pybullet.DIRECT)
pybullet.setGravity(0, 0, -9.81)
pybullet.createMultiBody(0, pybullet.createCollisionShape(pybullet.GEOM_PLANE))
world = fracsim.World(client, fatigue=1.0)
world.add(fracsim.load("vase"), position=(0, 0, 1.5), scale=0.3)
while not (events := world.step()):
    pass
for _ in range(60):
    events += world.step()
event = events[0]
assert event.children, "it did not break"
event.fracture.labels, event.fracture.udf, event.fracture.pieces[0].faces
"""
EPISODE = """
import gymnasium
env = gymnasium.make("fracsim:FractureDrop-v0", mesh="vase", goal="shatter", drop_height=3.0)
env.reset(seed=0)
info, over = {"pieces": 1}, False
while not over:
    _, _, terminated, truncated, info = env.step(env.action_space.sample() * 0)
    over = terminated or truncated
assert info["pieces"] > 1, "it did not break"
"""


def loaded_by(code: str) -> set[str]:
    """The packages that a new interpreter has loaded after some code."""
    script = f"import sys\n{code}\nprint(*sorted(sys.modules), sep='\\n')"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return {name.split(".")[0] for name in result.stdout.split()}


def test_import_loads_numpy_and_gymnasium_and_nothing_else():
    beside = loaded_by("import numpy, gymnasium, gymnasium.envs.registration") | set(sys.stdlib_module_names)
    assert loaded_by("import fracsim") - beside == {"fracsim"}


@pytest.mark.parametrize("code", [BREAK, EPISODE], ids=["world", "environment"])
def test_a_simulation_in_which_something_breaks_loads_nothing_of_the_offline_half(code):
    assert loaded_by(f"import fracsim\n{code}") & OFFLINE == set()


def test_breaking_an_asset_without_an_engine_loads_no_engine():
    code = "import fracsim; a = fracsim.load('bunny'); a.fracture(a.sample_impulses(1, 0)).pieces[0].faces"
    assert loaded_by(code) & (OFFLINE | {"pybullet"}) == set()


def test_the_program_says_what_it_can_do_without_loading_the_offline_half():
    code = "from fracsim.cli.main import build_parser; build_parser().format_help()"
    assert loaded_by(code) & (OFFLINE | {"scipy", "pybullet"}) == set()


def test_metrics_and_environments_are_at_hand_without_another_import():
    assert loaded_by("import fracsim; fracsim.metrics.mse; fracsim.envs.FractureDropEnv") & OFFLINE == set()


def test_the_environment_is_registered_by_the_import():
    assert gym.spec("FractureDrop-v0").max_episode_steps == 300


@pytest.mark.parametrize("name", fracsim.__all__)
def test_every_public_name_resolves_and_is_documented(name):
    try:
        value = getattr(fracsim, name)
    except fracsim.MissingExtraError as error:
        pytest.skip(str(error))
    assert value.__name__ == name
    assert value.__doc__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        fracsim.nonsense  # noqa: B018
