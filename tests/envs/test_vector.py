"""Environments in processes of their own: they live through breaks, and their events come back through the pipe."""

from __future__ import annotations

import copy
import multiprocessing
import pickle

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest

import fracsim

ARGUMENTS = {"mesh": "vase", "drop_height": 4.0, "goal": "shatter"}


def check_event(event):
    """An event that came through a pipe is whole: everything that it tells can be read here."""
    assert isinstance(event, fracsim.FractureEvent)
    assert len(event.children) == len(event.fracture.pieces) > 1
    assert event.impulse.magnitude > 0
    assert set(np.unique(event.fracture.labels)) <= set(range(-1, len(event.fracture.pieces)))
    assert np.isfinite(event.fracture.udf).all()
    for piece in event.fracture.pieces:
        assert piece.mass > 0
        assert len(piece.faces)
    total = sum(piece.mass for piece in event.fracture.pieces)
    assert max(piece.mass for piece in event.fracture.pieces) < total


@pytest.mark.parametrize("mode", ["async", "sync"])
def test_a_vector_environment_lives_through_breaks_and_hands_events_on(mode):
    envs = gym.make_vec("fracsim:FractureDrop-v0", num_envs=2, vectorization_mode=mode, **ARGUMENTS)
    try:
        observations, _ = envs.reset(seed=3)
        broke = [0, 0]
        for _ in range(200):
            observations, _, _, _, infos = envs.step(np.zeros((2, 6), np.float32))
            for k in range(2):
                for event in infos["events"][k] or ():
                    check_event(event)
                    broke[k] += 1
            if min(broke) > 0:
                break
        assert min(broke) > 0
        assert (observations[:, 13] > 1).all()
        for _ in range(60):  # over the end of both episodes, into the next
            observations, *_ = envs.step(np.zeros((2, 6), np.float32))
        assert (observations[:, 13] == 1).any()
    finally:
        envs.close()


def serve(pipe, make):
    """What a worker of Stable-Baselines3's SubprocVecEnv does: answers through a plain pipe, infos included."""
    env = cloudpickle.loads(make)()
    while True:
        command, data = pipe.recv()
        if command == "step":
            observation, reward, terminated, truncated, info = env.step(data)
            done = terminated or truncated
            if done:
                info["terminal_observation"] = observation
                observation, _ = env.reset()
            pipe.send((observation, reward, done, info))
        elif command == "reset":
            pipe.send(env.reset(seed=data))
        elif command == "get_spaces":
            pipe.send((env.observation_space, env.action_space))
        else:
            env.close()
            pipe.close()
            break


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_a_worker_that_starts_afresh_survives_whole_episodes(method):
    context = multiprocessing.get_context(method)
    pipe, remote = context.Pipe()
    make = cloudpickle.dumps(lambda: gym.make("fracsim:FractureDrop-v0", **ARGUMENTS))
    worker = context.Process(target=serve, args=(remote, make), daemon=True)
    worker.start()
    remote.close()
    try:
        pipe.send(("get_spaces", None))
        observations, actions = pipe.recv()
        assert observations.shape == (16,)
        pipe.send(("reset", 3))
        pipe.recv()
        events, episodes = [], 0
        while episodes < 2:
            pipe.send(("step", np.zeros(actions.shape, np.float32)))
            observation, _, done, info = pipe.recv()
            assert observation in observations
            events += info["events"]
            episodes += done
        assert events
        for event in events:
            check_event(event)
        pipe.send(("close", None))
        worker.join(20)
        assert worker.exitcode == 0
    finally:
        worker.kill()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, pickle.dumps, cloudpickle.dumps])
def test_no_copy_of_an_environment_steps_the_same_scene(duplicate):
    env = gym.make("fracsim:FractureDrop-v0", mesh="vase")
    env.reset(seed=1)
    for thing in (env, env.unwrapped):
        with pytest.raises(fracsim.FracsimError, match="an environment cannot be copied or pickled"):
            duplicate(thing)
    # A shallow copy of a wrapper is another wrapper of the same environment, which is how Gymnasium has it.
    with pytest.raises(fracsim.FracsimError, match="an environment cannot be copied or pickled"):
        copy.copy(env.unwrapped)
    height = env.step(np.zeros(6, np.float32))[0][2]
    assert env.step(np.zeros(6, np.float32))[0][2] < height  # the original goes on
    env.close()


def test_no_copy_of_a_world_or_a_scene_steps_the_same_simulation():
    env = gym.make("fracsim:FractureDrop-v0", mesh="vase").unwrapped
    env.reset(seed=1)
    for thing in (env.stage, env.stage.scene, env.stage.world):
        with pytest.raises(fracsim.PhysicsError, match="cannot be copied or pickled"):
            copy.deepcopy(thing)
    env.close()
