"""FractureDrop: steer a falling brittle object so that it lands whole, or so that it shatters."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

import fracsim
from fracsim import FracsimError, RenderError
from fracsim.physics.scene import GRAVITY

from .arguments import Scalable, numbers, positive, rotation, whole
from .object_scene import ObjectScene

if TYPE_CHECKING:
    from fracsim import BreakableAsset, Material

Action = npt.NDArray[np.float32]
Observation = npt.NDArray[np.float32]

GOALS = ("preserve", "shatter")
LONGEST_ACTION = 1.0  # s; an action that lasts longer leaves less than one image a second
# Of the observation, in its order: how many numbers, the least and the largest of each.
_RANGES = (
    (3, -100.0, 100.0),  # centre of mass, m
    (4, -1.0, 1.0),  # orientation
    (3, -100.0, 100.0),  # velocity, m/s
    (3, -1000.0, 1000.0),  # angular velocity, rad/s
    (1, 1.0, 1000.0),  # pieces
    (1, 0.0, 1.0),  # mass of the largest
    (1, 0.0, 1e4),  # strongest impulse, N·s
)


@dataclass(frozen=True)
class DropTask:
    """What counts in a drop: how much the thrusters can do, what is rewarded, and when an episode ends.

    Attributes
    ----------
    goal : str
        "preserve" or "shatter".
    force : float
        Largest thrust along each axis, of the weight m g: too little to hover.
    torque : float
        Largest torque about each axis, of m g L, with the largest extent L.
    aftermath : float
        Time that an episode goes on for after the first break, s.
    rest : float
        Time at rest after which an object has landed whole, s.
    rest_speed : float
        Speed below which it is at rest, m/s.
    rest_spin : float
        Angular speed below which it is at rest, rad/s.
    """

    goal: str
    force: float = 0.5
    torque: float = 0.1
    aftermath: float = 0.5
    rest: float = 0.25
    rest_speed: float = 0.05
    rest_spin: float = 0.5

    def is_at_rest(self, speed: float, spin: float) -> bool:
        """Tell whether a body at this speed (m/s) and angular speed (rad/s) is at rest."""
        return speed <= self.rest_speed and spin <= self.rest_spin

    def reward(
        self, broke: bool, landed: bool, loss: float, new: int, speed_share: float, thrust: npt.NDArray[np.float64]
    ) -> float:
        """Compute the reward of a step by the formula of `FractureDropEnv`.

        Parameters
        ----------
        broke, landed : bool
            Whether something broke in this step, or the object has come to rest whole.
        loss : float
            Share of the whole by which the largest piece shrank.
        new : int
            Number by which the pieces increased.
        speed_share : float
            Kinetic energy of the whole object as a share of the drop's, at most 1; 0 once it broke.
        thrust : ndarray of float64, shape (6,)
            The action, from -1 to 1.

        Returns
        -------
        float
            The reward.
        """
        sign = 1.0 if self.goal == "shatter" else -1.0
        return sign * (broke - landed + loss + 0.02 * new + 0.01 * speed_share) - 0.01 * float(np.mean(thrust**2))


class FractureDropEnv(gym.Env[Observation, Action]):
    """Steer a falling brittle object so that it lands whole, or so that it shatters.

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
    - Termination: 0.5 s after it first broke, or when it has been at rest, whole, for 0.25 s. At rest is slower than
      0.05 m/s and 0.5 rad/s. In the meantime pieces may break again.
    - Truncation: after 300 steps, 5 s at the default rate.

    ## Information
    - `pieces`: number of pieces, 1 while it is whole.
    - `events`: list of `fracsim.FractureEvent`, what broke in this step. They can be pickled.
    - `impulse`: strongest impulse of this step, N·s.
    - `intact_fraction`: mass of the largest piece as a share of the whole.
    - `time`: simulated time since the reset, s.
    - `is_success`: whether the episode has ended with its goal met.

    ## Arguments
    - `mesh`: an asset that ships ("bunny", "chair", "vase"), a path to a baked one, or a `BreakableAsset`.
    - `material`: a preset's name or a `fracsim.Material`; None keeps the asset's own.
    - `size`: largest extent, m.
    - `goal`: "preserve" or "shatter".
    - `drop_height`: height of the lowest point at the start, m.
    - `time_step`: length of a time step, s.
    - `frame_skip`: time steps per action; 4 of 1/240 s make 60 Hz. An action lasts 1 s at most.
    - `render_mode`: None, "rgb_array" or "human".
    - `width`, `height`: size of the image, pixels.

    An environment cannot be copied or pickled, since the copy would step the same simulation. In a vector environment
    each one is made in its own process, and events come through.

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
        size, time_step = positive(size, "size"), positive(time_step, "time_step")
        self.task, self.frame_skip = DropTask(goal), whole(frame_skip, "frame_skip")
        self.drop_height = positive(drop_height, "drop_height")
        self.render_mode, self.width, self.height = render_mode, whole(width, "width"), whole(height, "height")
        self.action_time = time_step * self.frame_skip  # s
        if self.action_time > LONGEST_ACTION:
            raise FracsimError(
                f"an action would last {self.action_time:g} s; lower frame_skip or time_step "
                f"to {LONGEST_ACTION:g} s or less"
            )
        self.metadata = {**self.metadata, "render_fps": round(1 / self.action_time)}
        asset = _asset_of(mesh)
        if material is not None:
            asset = asset.with_material(material)
        asset = asset.scaled(size / asset.size)
        counts, low, high = zip(*_RANGES, strict=True)
        self._low, self._high = (np.repeat(np.array(ends, dtype=np.float32), counts) for ends in (low, high))
        self.observation_space = spaces.Box(self._low, self._high)
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.stage = ObjectScene(asset, time_step, window=render_mode == "human", show=render_mode is not None)
        self._running, self._closed = False, False

    def __getstate__(self) -> NoReturn:
        """Refuse to be copied or pickled."""
        raise FracsimError(
            "an environment cannot be copied or pickled, as both would step one simulation; "
            "make another one with gymnasium.make, and repeat the seed and the actions"
        )

    @property
    def asset(self) -> BreakableAsset:
        """The object that falls, in its size."""
        return self.stage.asset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed : int, optional
            Seed of the orientations of this and the following episodes.
        options : dict, optional
            "orientation": quaternion (x, y, z, w). "drop_height": m.

        Returns
        -------
        observation : ndarray of float32, shape (16,)
            As the class describes it.
        info : dict
            As the class describes it.

        Raises
        ------
        FracsimError
            Where an option makes no sense, or the environment is closed.
        """
        if self._closed:
            raise FracsimError("this environment is closed; make another one")
        super().reset(seed=seed)
        options = options or {}
        draw = self.np_random.normal(size=4)  # uniform over all rotations, once it has length 1
        orientation = rotation(options.get("orientation", draw), "orientation")
        self._fall = positive(options.get("drop_height", self.drop_height), "drop_height")
        self.stage.reset(orientation, self._fall)
        self._broke_at, self._moved_at = np.inf, 0.0  # s
        self._running = True
        return self._observe(), self._info([], False)

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold an action for `frame_skip` time steps.

        Parameters
        ----------
        action : ndarray of float32, shape (6,)
            As the class describes it; what lies beyond the limits counts as the limit.

        Returns
        -------
        observation : ndarray of float32, shape (16,)
            As the class describes it.
        reward : float
            As the class describes it.
        terminated : bool
            Whether the episode has ended.
        truncated : bool
            False; Gymnasium's time limit sets it.
        info : dict
            As the class describes it.

        Raises
        ------
        FracsimError
            Where the action is not six numbers, or no episode has begun.
        """
        self._require_running()
        stage, task = self.stage, self.task
        thrust = np.clip(numbers(action, 6, "an action"), -1.0, 1.0)
        weight = stage.asset.mass * GRAVITY
        force, torque = thrust[:3] * task.force * weight, thrust[3:] * task.torque * weight * stage.asset.size
        pieces, intact = stage.pieces, stage.intact_fraction
        events = stage.advance(force, torque, self.frame_skip)

        now = stage.world.time
        linear, angular = stage.motion
        speed = float(np.linalg.norm(linear))
        if not task.is_at_rest(speed, float(np.linalg.norm(angular))):
            self._moved_at = now
        if events:
            self._broke_at = min(self._broke_at, events[0].time)
        landed = stage.is_whole and now - self._moved_at >= task.rest
        terminated = bool(landed or now - self._broke_at >= task.aftermath)
        speed_share = min(1.0, speed**2 / (2 * GRAVITY * self._fall)) if stage.is_whole else 0.0
        loss, new = intact - stage.intact_fraction, stage.pieces - pieces
        reward = task.reward(bool(events), landed, loss, new, speed_share, thrust)
        success = terminated and stage.is_whole == (task.goal == "preserve")
        if self.render_mode == "human":
            time.sleep(self.action_time)
        return self._observe(), float(reward), terminated, False, self._info(events, success)

    def render(self) -> npt.NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw the scene as it is now.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3), or None
            The image; None unless `render_mode` is "rgb_array".

        Raises
        ------
        FracsimError
            Where no episode has begun.
        """
        if self.render_mode != "rgb_array":
            return None
        self._require_running()
        reach = self.drop_height + 1.5 * self.asset.size
        eye = (1.1 * reach, -1.3 * reach, 0.45 * reach)
        return self.stage.scene.image(eye, (0.0, 0.0, 0.42 * reach), self.width, self.height)

    def close(self) -> None:
        """Disconnect from the simulation; a second time does nothing."""
        self._running, self._closed = False, True
        self.stage.scene.close()

    def _require_running(self) -> None:
        """Refuse what needs an episode that has begun."""
        if not self._running:
            raise FracsimError(
                "this environment is closed; make another one" if self._closed else "call reset() before anything else"
            )

    def _observe(self) -> Observation:
        """Compose the observation, shape (16,)."""
        stage = self.stage
        linear, angular = stage.motion
        outcome = (stage.pieces, stage.intact_fraction, stage.last_impulse)
        state = np.concatenate([stage.center_of_mass, stage.orientation, linear, angular, outcome])
        clipped: Observation = np.clip(state, self._low, self._high).astype(np.float32)
        return clipped

    def _info(self, events: list[fracsim.FractureEvent], success: bool) -> dict[str, Any]:
        """Compose what a researcher would log."""
        stage = self.stage
        return {
            "pieces": stage.pieces,
            "events": events,
            "impulse": stage.strongest_impulse,
            "intact_fraction": stage.intact_fraction,
            "time": stage.world.time,
            "is_success": success,
        }


def _asset_of(mesh: str | os.PathLike[str] | BreakableAsset) -> BreakableAsset:
    """Load an asset by name or path; what is one already is returned as it is."""
    if isinstance(mesh, (str, os.PathLike)):
        return fracsim.load(mesh)
    if not isinstance(mesh, Scalable):
        raise FracsimError(f"mesh must be an asset's name, a path or a BreakableAsset, got {mesh!r}")
    return mesh
