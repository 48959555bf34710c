"""FractureDrop: steer a falling brittle object so that it lands whole, or so that it shatters."""

from __future__ import annotations

import os
import time
from numbers import Real
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

import fracsim
from fracsim.common.checks import vector_of
from fracsim.common.errors import FracsimError, RenderError
from fracsim.physics.bullet import Engine
from fracsim.physics.impacts import ContactImpulse
from fracsim.physics.rotations import rotation_of
from fracsim.physics.scene import GRAVITY, Scene

if TYPE_CHECKING:
    from fracsim import BreakableAsset, Material

FloatArray = npt.NDArray[np.float64]
Observation = npt.NDArray[np.float32]

GOALS = ("preserve", "shatter")
FORCE, TORQUE = 0.5, 0.1  # the action's limits, of m g and of m g size
AFTERMATH, REST = 0.5, 0.25  # s, after the break and at rest, before an episode ends
STILL = (0.05, 0.5)  # m/s and rad/s: slower is at rest
SPAN = 100.0  # m and m/s, clips the observation
LONGEST = 1.0  # s, of an action; no image a second is no rate


class FractureDropEnv(gym.Env[Observation, npt.NDArray[np.float32]]):
    """
    ## Description
    A brittle object falls onto a floor. Until it breaks, weak thrusters turn it, push it aside and soften its
    fall, but cannot hold it up. With the goal "preserve" it should land whole: on a sturdy spot, turned well.
    With "shatter" it should break, the finer the better.

    ## Action Space
    `Box(-1, 1, (6,), float32)`, held for `frame_skip` time steps; it acts at the centre of mass, along the
    world's axes, and has no effect on pieces. m is the object's mass, L its largest extent, g = 9.81 m/s².

    | Index | Action          | Min  | Max | Unit      |
    |-------|-----------------|------|-----|-----------|
    | 0-2   | force x, y, z   | -1   | 1   | 0.5 m g   |
    | 3-5   | torque x, y, z  | -1   | 1   | 0.1 m g L |

    ## Observation Space
    `Box(low, high, (16,), float32)`. Once it broke, the motion is that of the largest piece.

    | Index | Observation                                  | Min   | Max  | Unit  |
    |-------|----------------------------------------------|-------|------|-------|
    | 0-2   | centre of mass x, y, z                       | -100  | 100  | m     |
    | 3-6   | orientation x, y, z, w, with w >= 0          | -1    | 1    |       |
    | 7-9   | velocity of the centre of mass               | -100  | 100  | m/s   |
    | 10-12 | angular velocity                             | -1000 | 1000 | rad/s |
    | 13    | number of pieces                             | 1     | 1000 |       |
    | 14    | mass of the largest piece, of the whole      | 0     | 1    |       |
    | 15    | strongest impulse of the last hit            | 0     | 1e4  | N·s   |

    ## Rewards
    With s = 1 for "shatter" and s = -1 for "preserve", the reward of a step is

    `s * (broke - landed + loss + 0.02 * new + 0.01 * speed) - 0.01 * mean(action²)`

    - broke, landed: 1 in a step in which something breaks, or in which it has come to rest whole; otherwise 0.
    - loss: the share of the whole by which the largest piece shrank. new: by how many the pieces increased.
    - speed: min(1, v² / (2 g drop_height)), while it is whole.

    ## Starting State
    At rest, turned at random, uniformly over all rotations, above the origin of the floor, with its lowest
    point `drop_height` above it. `reset(options=...)` may set "orientation" (x, y, z, w) and "drop_height".

    ## Episode End
    Pieces may break again. Termination: 0.5 s after it first broke, or when it has been at rest, whole, for 0.25 s.
    Truncation: after 300 steps, 5 s at the default rate.

    ## Information
    `pieces`: their number. `events`: this step's list of `fracsim.FractureEvent`. `impulse`: the strongest
    of this step, N·s. `intact_fraction`: as observed. `time`: s since the reset. `is_success`: whether the
    episode ended with its goal met.

    ## Arguments
    - `mesh`: an asset that ships ("bunny", "chair", "vase"), a path to a baked one, or a `BreakableAsset`.
    - `material`: a preset's name or a `fracsim.Material`; None keeps the asset's own.
    - `size`: largest extent, m. `goal`: "preserve" or "shatter". `drop_height`: m.
    - `time_step`: s. `frame_skip`: time steps per action; 4 of 1/240 s make 60 Hz.
    - `render_mode`: None, "rgb_array" or "human". `width`, `height`: of the image, pixels.

    ## Version History
    * v0: initial version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 60}  # noqa: RUF012 (Gymnasium's)

    def __init__(
        self,
        mesh: str | os.PathLike[str] | BreakableAsset = "bunny",
        material: str | Material | None = None,
        size: float = 0.3,
        goal: str = "preserve",
        drop_height: float = 1.0,
        time_step: float = 1 / 240,
        frame_skip: int = 4,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        if goal not in GOALS:
            raise FracsimError(f"unknown goal {goal!r}; use one of {', '.join(GOALS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise RenderError(f"unknown render_mode {render_mode!r}; use None, 'rgb_array' or 'human'")
        size, time_step = _positive(size, "size"), _positive(time_step, "time_step")
        self.goal, self.frame_skip = goal, _whole(frame_skip, "frame_skip")
        self.drop_height = _positive(drop_height, "drop_height")
        self.render_mode, self.width, self.height = render_mode, _whole(width, "width"), _whole(height, "height")
        action = time_step * self.frame_skip
        if action > LONGEST:
            raise FracsimError(
                f"an action would last {action:g} s; lower frame_skip or time_step to {LONGEST:g} s or less"
            )
        self.metadata = {**self.metadata, "render_fps": round(1 / action)}
        if not (isinstance(mesh, (str, os.PathLike)) or hasattr(mesh, "scaled")):
            raise FracsimError(f"mesh must be an asset's name, a path or a BreakableAsset, got {mesh!r}")
        asset = fracsim.load(mesh) if isinstance(mesh, (str, os.PathLike)) else mesh
        if material is not None:
            asset = asset.with_material(material)
        self.asset = asset.scaled(size / asset.size)
        high = np.repeat([SPAN, 1.0, SPAN, 1000.0, 1000.0, 1.0, 1e4], [3, 4, 3, 3, 1, 1, 1])
        low = np.where(np.arange(16) < 13, -high, np.where(np.arange(16) == 13, 1.0, 0.0))
        self._low, self._high = low.astype(np.float32), high.astype(np.float32)
        self.observation_space = spaces.Box(self._low, self._high)
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self._scene = Scene(time_step, window=render_mode == "human", show=render_mode is not None)
        self._engine = Engine(self._scene.client)
        self._running, self._closed = False, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        if self._closed:
            raise FracsimError("this environment is closed; make another one")
        super().reset(seed=seed)
        options = options or {}
        draw = self.np_random.normal(size=4)
        orientation = _numbers(options.get("orientation", draw), 4, "orientation, a quaternion (x, y, z, w),")
        if not 0 < np.linalg.norm(orientation) < np.inf:
            raise FracsimError(f"orientation must be a rotation, such as (0, 0, 0, 1), got {orientation.tolist()}")
        orientation = orientation / np.linalg.norm(orientation)
        self._fall = _positive(options.get("drop_height", self.drop_height), "drop_height")
        rotation = rotation_of(orientation.tolist())
        center = rotation @ self.asset.center_of_mass
        lowest = (self.asset.vertices @ rotation.T)[:, 2].min()

        self._scene.reset()
        self._world = fracsim.World(self._scene.client, visuals=self._scene.show)
        position = (-center[0], -center[1], self._fall - lowest)
        self._body = self._world.add(self.asset, position, orientation)
        self._world.on_contact(self._feel)
        self._masses = {self._body: self.asset.mass}  # of the body or, once it broke, of every piece
        self._pieces, self._intact = 1, 1.0
        self._impulse = self._strongest = 0.0
        self._broke_at, self._still_since = np.inf, 0.0
        self._running = True
        return self._observe(), self._info([], False)

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        self._require_running()
        thrust = np.clip(_numbers(action, 6, "an action"), -1.0, 1.0)
        weight = self.asset.mass * GRAVITY
        force, torque = thrust[:3] * FORCE * weight, thrust[3:] * TORQUE * weight * self.asset.size
        pieces, intact = self._pieces, self._intact
        self._strongest = 0.0
        events = []
        for _ in range(self.frame_skip):
            if self._pieces == 1:
                self._scene.push(self._body, force, torque)
            for event in self._world.step():
                self._masses.pop(event.parent)
                masses = (piece.mass for piece in event.fracture.pieces)
                self._masses.update(zip(event.children, masses, strict=True))
                self._body = max(self._masses, key=self._masses.__getitem__)
                self._pieces, self._intact = len(self._masses), self._masses[self._body] / self.asset.mass
                self._broke_at = min(self._broke_at, self._world.time)
                events.append(event)

        now = self._world.time
        linear, angular = self._engine.motion(self._body)
        speed = float(np.linalg.norm(linear))
        if speed > STILL[0] or float(np.linalg.norm(angular)) > STILL[1]:
            self._still_since = now
        whole = self._pieces == 1
        landed = whole and now - self._still_since >= REST
        terminated = bool(landed or now - self._broke_at >= AFTERMATH)
        sign = 1.0 if self.goal == "shatter" else -1.0
        hurry = min(1.0, speed**2 / (2 * GRAVITY * self._fall)) if whole else 0.0
        damage = intact - self._intact + 0.02 * (self._pieces - pieces)
        reward = sign * (bool(events) - landed + damage + 0.01 * hurry) - 0.01 * float(np.mean(thrust**2))
        success = terminated and whole == (self.goal == "preserve")
        if self.render_mode == "human":
            time.sleep(self._scene.time_step * self.frame_skip)
        return self._observe(), float(reward), terminated, False, self._info(events, success)

    def render(self) -> npt.NDArray[np.uint8] | None:
        if self.render_mode != "rgb_array":
            return None
        self._require_running()
        reach = self.drop_height + 1.5 * self.asset.size
        eye = (1.1 * reach, -1.3 * reach, 0.45 * reach)
        return self._scene.image(eye, (0.0, 0.0, 0.42 * reach), self.width, self.height)

    def close(self) -> None:
        self._running, self._closed = False, True
        self._scene.close()

    def _require_running(self) -> None:
        if not self._running:
            raise FracsimError(
                "this environment is closed; make another one" if self._closed else "call reset() before anything else"
            )

    def _feel(self, hit: ContactImpulse) -> None:
        self._strongest = self._impulse = max(self._strongest, hit.impulse.magnitude)

    def _observe(self) -> Observation:
        center, _ = self._engine.placement(self._body)
        _, quaternion = self._world.pose(self._body)
        linear, angular = self._engine.motion(self._body)
        quaternion = quaternion if quaternion[3] >= 0.0 else -quaternion
        tail = (self._pieces, self._intact, self._impulse)
        state = np.concatenate([center, quaternion, linear, angular, tail])
        clipped: Observation = np.clip(state, self._low, self._high).astype(np.float32)
        return clipped

    def _info(self, events: list[fracsim.FractureEvent], success: bool) -> dict[str, Any]:
        return {
            "pieces": self._pieces,
            "events": events,
            "impulse": self._strongest,
            "intact_fraction": self._intact,
            "time": self._world.time,
            "is_success": success,
        }


def _positive(value: Any, name: str) -> float:
    if not (isinstance(value, Real) and 0.0 < float(value) < np.inf):
        raise FracsimError(f"{name} must be a positive number, got {value!r}")
    return float(value)


def _whole(value: Any, name: str) -> int:
    if not _positive(value, name).is_integer():
        raise FracsimError(f"{name} must be a whole number, got {value!r}")
    return int(value)


def _numbers(value: Any, count: int, name: str) -> FloatArray:
    vector = vector_of(value, count)
    if vector is None or np.isnan(vector).any():
        raise FracsimError(f"{name} must be {count} numbers, got {value}")
    return vector
