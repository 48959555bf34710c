"""An environment is registered by one line, and a user's own by one call."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

import fracsim

TOY = '''
import gymnasium as gym, numpy as np

class ToyEnv(gym.Env):
    """Always over at once."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}
'''


@pytest.fixture
def toy(tmp_path, monkeypatch):
    (tmp_path / "toy_environment.py").write_text(TOY)
    monkeypatch.syspath_prepend(tmp_path)
    yield "toy_environment:ToyEnv"
    for table in (gym.registry, fracsim.envs.ENVIRONMENTS):
        table.pop("Toy-v0", None)


def test_an_environment_of_a_users_own_is_made_by_name(toy):
    fracsim.register_environment("Toy-v0", toy, max_episode_steps=3)
    assert "toy_environment" not in sys.modules  # until one is made
    env = gym.make("Toy-v0")
    env.reset(seed=0)
    truncated = [env.step(0)[3] for _ in range(3)]
    assert truncated == [False, False, True]
    assert fracsim.envs.ENVIRONMENTS["Toy-v0"].entry_point == toy
    np.testing.assert_array_equal(env.observation_space.high, [1])


def test_a_name_that_is_taken_is_refused(toy):
    for name in ("FractureDrop-v0", "CartPole-v1"):
        with pytest.raises(fracsim.FracsimError, match=f"{name}' is registered already"):
            fracsim.register_environment(name, toy)


def test_the_import_registers_what_ships_and_loads_no_environment():
    script = (
        "import sys, fracsim, gymnasium as gym\n"
        "assert all(name in gym.registry for name in fracsim.SHIPPED_ENVIRONMENTS)\n"
        "assert not any(name.startswith('fracsim.envs') for name in sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_every_environment_that_ships_is_in_the_registry_under_its_class_name():
    assert set(fracsim.envs.ENVIRONMENTS) == set(fracsim.SHIPPED_ENVIRONMENTS)
    for entry_point, _ in fracsim.SHIPPED_ENVIRONMENTS.values():
        assert getattr(fracsim.envs, entry_point.split(":")[1]).metadata["render_modes"]
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        fracsim.envs.nonsense  # noqa: B018
