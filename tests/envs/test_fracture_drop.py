"""FractureDrop-v0: a Gymnasium environment in every detail, and the same twice."""

from __future__ import annotations

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pybullet as p
import pytest
from gymnasium.utils.env_checker import check_env
from scenes import SlabBox

import fracsim

ROLLOUT = """
import hashlib, sys
import gymnasium as gym, numpy as np, fracsim
env = gym.make("FractureDrop-v0", drop_height=2.0)
observation, _ = env.reset(seed=7)
env.action_space.seed(7)
digest, done = hashlib.sha256(observation.tobytes()), False
while not done:
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    digest.update(observation.tobytes() + np.float64(reward).tobytes())
    done = terminated or truncated
heavy = {"torch", "optuna", "networkx", "coacd", "matplotlib", "trimesh"} & set(sys.modules)
assert not heavy, heavy
print(info["pieces"], digest.hexdigest())
"""


@pytest.fixture
def make():
    envs = []

    def make(**arguments):
        env = gym.make("FractureDrop-v0", **{"mesh": SlabBox(density=300.0), **arguments})
        envs.append(env)
        return env

    yield make
    for env in envs:
        env.close()


def play(env, action=None, **reset):
    """One episode -> its observations, rewards and last info; what broke is kept in info["broken"]."""
    observation, info = env.reset(**reset)
    observations, rewards, broken, done = [observation], [], [], False
    action = np.zeros(6, np.float32) if action is None else np.asarray(action, np.float32)
    while not done:
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        broken += info["events"]
        done = terminated or truncated
    return np.array(observations), np.array(rewards), {**info, "broken": broken, "truncated": truncated}


@pytest.mark.parametrize("goal", ["preserve", "shatter"])
def test_gymnasium_finds_nothing_to_say_about_it(make, goal):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(goal=goal).unwrapped, skip_render_check=True)


def test_importing_fracsim_registers_it_and_the_module_prefix_needs_no_import():
    assert "FractureDrop-v0" in gym.registry
    env = gym.make("fracsim:FractureDrop-v0", mesh=SlabBox())
    assert env.spec.max_episode_steps == 300
    env.close()


def test_the_lowest_point_starts_at_the_drop_height(make):
    env = make(drop_height=0.7).unwrapped
    for seed in range(3):
        env.reset(seed=seed)
        position, orientation = env.stage.world.pose(env.stage.body)
        rotation = np.reshape(p.getMatrixFromQuaternion(orientation), (3, 3))
        assert (env.asset.vertices @ rotation.T + position)[:, 2].min() == pytest.approx(0.7)


def test_options_set_orientation_and_drop_height(make):
    env = make()
    observation, _ = env.reset(seed=0, options={"orientation": (0, 0, 0, 1), "drop_height": 0.2})
    np.testing.assert_allclose(observation[3:7], (0, 0, 0, 1), atol=1e-6)
    assert observation[2] == pytest.approx(0.2 + 0.15, abs=1e-6)


def test_orientations_are_uniform_over_rotations(make):
    env = make()
    up = []
    for seed in range(200):
        x, y, *_ = env.reset(seed=seed)[0][3:7]
        up.append(1 - 2 * (x * x + y * y))
    assert abs(np.mean(up)) < 0.15
    assert np.var(up) == pytest.approx(1 / 3, abs=0.08)


def test_a_hard_drop_breaks_and_ends_half_a_second_later(make):
    observations, _, info = play(make(mesh=SlabBox(density=300.0, toughness=0.1)), seed=1)
    [event] = info["broken"]
    assert info["pieces"] == observations[-1][13] == len(event.children) == 4
    assert info["time"] == pytest.approx(event.time + 0.5, abs=1 / 60)
    assert info["intact_fraction"] == pytest.approx(0.25)
    assert observations[-1][15] == pytest.approx(event.impulse.magnitude, rel=1e-6)


@pytest.mark.parametrize(
    ("goal", "toughness", "success"), [("preserve", 0, 0), ("shatter", 0, 1), ("preserve", 1e9, 1)]
)
def test_success_and_the_sign_of_the_return_follow_the_goal(make, goal, toughness, success):
    env = make(mesh=SlabBox(density=300.0, toughness=toughness), goal=goal, drop_height=0.3)
    _, rewards, info = play(env, seed=3, options={"orientation": (0.2, 0.1, 0, 1)})
    assert not info["truncated"]
    assert info["is_success"] == bool(success)
    assert (rewards.sum() > 0) == bool(success)


def test_thrust_steers_softens_and_turns_but_does_not_hover(make):
    env = make(mesh=SlabBox(density=300.0, toughness=1e9))
    options = {"orientation": (0, 0, 0, 1)}
    for action, index, expected in (
        ((0, 0, 1, 0, 0, 0), 9, -0.5 * 9.81 * 0.2),
        ((1, 0, 0, 0, 0, 0), 7, 0.5 * 9.81 * 0.2),
        ((0, 0, 0, 0, 0, 1), 12, 0.1 * 9.81 * 0.3 * 6 / 0.3**2 * 0.2),
    ):
        env.reset(seed=0, options=options)
        for _ in range(12):
            observation, *_ = env.step(np.array(action, np.float32))
        assert observation[index] == pytest.approx(expected, rel=0.03)


def test_a_seed_repeats_an_episode_in_one_process(make):
    env = make()
    action = (0.3, -0.2, 0.5, 0.1, 0.4, -0.6)
    first, second = (play(env, action, seed=5)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_environments_share_a_process_without_touching_each_other(make):
    alone = play(make(), seed=2)[0]
    left, right = make(), make(drop_height=0.4)
    left.reset(seed=2)
    right.reset(seed=9)
    for row in alone[1:]:
        right.step(np.ones(6, np.float32))
        np.testing.assert_array_equal(left.step(np.zeros(6, np.float32))[0], row)


def test_images_show_the_fall_and_the_landing(make):
    """The object is warm in colour, and the floor and the sky are grey: red beyond blue is the object."""

    def warm(image):
        red, _, blue = np.moveaxis(image.astype(int), -1, 0)
        return red - blue > 12

    env = make(mesh=SlabBox(density=300.0, toughness=1e9), render_mode="rgb_array", width=96, height=72)
    env.reset(seed=1, options={"orientation": (0, 0, 0, 1)})
    first = env.render()
    assert first.shape == (72, 96, 3)
    assert first.dtype == np.uint8
    assert 30 < warm(first).sum() < 0.2 * 96 * 72
    for _ in range(40):
        env.step(np.zeros(6, np.float32))
    last = env.render()
    assert 0.7 < warm(last).sum() / warm(first).sum() < 1.4  # as large, and further down
    high, low = (np.argwhere(warm(image)).mean(axis=0) for image in (first, last))
    assert low[0] - high[0] > 15
    assert abs(low[1] - high[1]) < 3


def test_what_has_broken_is_drawn_in_pieces_of_several_colours(make):
    env = make(render_mode="rgb_array", width=96, height=72)
    env.reset(seed=1)
    info = {"pieces": 1}
    whole = env.render()
    while info["pieces"] == 1:
        *_, info = env.step(np.zeros(6, np.float32))
    pieces = env.render()
    changed = np.abs(pieces.astype(int) - whole).max(axis=2) > 20
    assert 60 < changed.sum() < 0.4 * 96 * 72  # gone from above, and new on the floor


def test_a_window_without_a_display_is_refused_before_it_kills_the_process(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(fracsim.RenderError, match="DISPLAY"):
        gym.make("FractureDrop-v0", mesh=SlabBox(), render_mode="human")


@pytest.mark.parametrize(
    ("arguments", "error", "fault"),
    [
        ({"goal": "win"}, fracsim.FracsimError, "unknown goal"),
        ({"size": 0.0}, fracsim.FracsimError, "size must be a positive number"),
        ({"drop_height": float("nan")}, fracsim.FracsimError, "drop_height must be a positive number, got nan"),
        ({"drop_height": "a"}, fracsim.FracsimError, "drop_height must be a positive number, got 'a'"),
        ({"time_step": None}, fracsim.FracsimError, "time_step must be a positive number"),
        ({"frame_skip": 0.5}, fracsim.FracsimError, "frame_skip must be a whole number, got 0.5"),
        ({"frame_skip": 1000}, fracsim.FracsimError, "would last 4.16667 s; lower frame_skip"),
        ({"width": 0}, fracsim.FracsimError, "width must be a positive number"),
        ({"mesh": None}, fracsim.FracsimError, "mesh must be an asset's name, a path or a BreakableAsset, got None"),
        ({"mesh": "no such asset"}, fracsim.AssetError, "no such asset"),
        ({"material": "cheese"}, fracsim.MaterialError, "unknown material"),
    ],
)
def test_arguments_that_make_no_sense_raise_typed_errors(arguments, error, fault):
    with pytest.raises(error, match=fault):
        gym.make("FractureDrop-v0", **{"mesh": "chair", **arguments})


@pytest.mark.parametrize("action", [np.full(6, np.nan), np.zeros(5), np.zeros((6, 1)), 0.0, "up", None])
def test_an_action_that_is_not_six_numbers_is_refused_and_changes_nothing(make, action):
    env, twin = make().unwrapped, make().unwrapped
    for one in (env, twin):
        one.reset(seed=4)
    with pytest.raises(fracsim.FracsimError, match="an action must be 6 numbers"):
        env.step(action)
    np.testing.assert_array_equal(env.step(np.ones(6))[0], twin.step(np.ones(6))[0])


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"orientation": (0, 0, 0, 0)}, "orientation must be a rotation"),
        ({"orientation": "up"}, "orientation, a quaternion"),
        ({"orientation": (0, 0, 1)}, "orientation, a quaternion"),
        ({"drop_height": "high"}, "drop_height must be a positive number"),
    ],
)
def test_options_that_make_no_sense_are_refused(make, options, fault):
    with pytest.raises(fracsim.FracsimError, match=fault):
        make().reset(seed=0, options=options)


def test_what_is_done_before_a_reset_or_after_the_close_is_refused_by_name(make):
    env = make(render_mode="rgb_array").unwrapped
    with pytest.raises(fracsim.FracsimError, match=r"call reset\(\)"):
        env.step(np.zeros(6))
    env.reset(seed=0)
    env.close()
    for late in (env.reset, env.render, lambda: env.step(np.zeros(6))):
        with pytest.raises(fracsim.FracsimError, match="closed; make another"):
            late()


def test_closing_twice_is_fine_and_frees_the_client(make):
    env = make().unwrapped
    client = env.stage.scene.client
    env.close()
    env.close()
    assert not p.getConnectionInfo(client)["isConnected"]


def test_two_processes_with_one_seed_agree_to_the_last_bit():
    runs = [subprocess.run([sys.executable, "-c", ROLLOUT], capture_output=True, text=True) for _ in range(2)]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout
