"""Gyroscopic correction: keeping pieces that spin fast from gaining energy.

The engine turns a body by an explicit step of Euler's equations, ω ← ω − dt I⁻¹(ω × I ω), which adds energy at a rate
of about ω² dt: nothing to an object that tumbles, a hundred thousand times in a second to a piece at 200 rad/s.
`World.step` corrects that after each step.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray
from ..geometry.frames import cross
from .bodies import Body
from .bullet import Engine
from .rotations import rotation_of
from .states import BodyNotFound, Motion, Triple


@dataclass(frozen=True)
class SpinSettings:
    """From when on spin is corrected, and which pieces lie still.

    Attributes
    ----------
    correction_rate : float
        The ω² dt from which on a piece's spin is corrected, 1/s; below it the engine adds less than 5 % of energy a
        second.
    largest_turn : float
        Turn in one step, rad. What would turn further is slowed down to it; no step of any kind resolves that.
    still_speed : float
        Speed below which a piece may lie still, m/s, as the sum of its components' sizes.
    still_spin : float
        Angular speed below which it may lie still, rad/s.
    steps_between_looks : int
        Steps between looks at a piece that lies still.
    """

    correction_rate: float = 0.05
    largest_turn: float = 1.0
    still_speed: float = 0.01
    still_spin: float = 0.1
    steps_between_looks: int = 2


SETTINGS = SpinSettings()


@dataclass(eq=False)
class _Spinner:
    """A piece whose spin is corrected; angular: rad/s, after the last step."""

    body: Body
    angular: Triple
    is_fresh: bool = True  # whether no step has been taken since `angular` is known
    is_still: bool = False


class GyroscopicCorrection:
    """Pieces whose spin is corrected.

    Parameters
    ----------
    engine : Engine
        Engine that they are in.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._spinners: dict[int, _Spinner] = {}
        self._steps = 0

    def add(self, bodies: Iterable[Body], angular: Triple) -> None:
        """Take in bodies that turn alike from now on.

        Parameters
        ----------
        bodies : iterable of Body
            The bodies.
        angular : tuple of float
            Their angular velocity, shape (3,), rad/s, world frame.
        """
        self._spinners.update({body.id: _Spinner(body, angular) for body in bodies})

    def drop(self, body: int) -> None:
        """Correct a body no more.

        Parameters
        ----------
        body : int
            Its id; it may be gone.
        """
        self._spinners.pop(body, None)

    def changed(self, body: int, angular: Triple) -> None:
        """Take note that a body was put elsewhere or given another velocity after the last step.

        Parameters
        ----------
        body : int
            Its id; nothing happens where it is not corrected.
        angular : tuple of float
            Its angular velocity, shape (3,), rad/s, world frame.
        """
        if body in self._spinners:
            self._spinners[body] = _Spinner(self._spinners[body].body, angular)

    @property
    def moving(self) -> set[int]:
        """Ids of the pieces that do not lie still."""
        return {body for body, spinner in self._spinners.items() if not spinner.is_still}

    def correct(self, time_step: float) -> list[tuple[int, Motion]]:
        """Give pieces that spin fast the angular momentum that the last step should have left them.

        They get no more energy than they had; what contacts did to both is kept.

        Parameters
        ----------
        time_step : float
            Duration of the step, s.

        Returns
        -------
        list of tuple of int and Motion
            Ids of the pieces that were corrected and their new motions (m/s, rad/s).
        """
        self._steps += 1
        fast = self._fast_spinners(time_step)
        if not fast:
            return []
        moments = np.array([spinner.body.moments for spinner, *_ in fast])
        before = np.array([spinner.angular for spinner, *_ in fast])
        now = np.array([angular for _, _, angular, _ in fast])
        new_axes = np.array([rotation for *_, rotation in fast])
        # The engine turned the body by the velocity that it ended the step with.
        old_axes = Rotation.from_rotvec(-time_step * now).as_matrix() @ new_axes
        # In principal axes at the start of the step: the velocity that contacts alone would have left.
        start = np.einsum("nji,nj->ni", old_axes, before)
        end = np.einsum("nji,nj->ni", old_axes, now) + time_step * cross(start, moments * start) / moments
        momentum = moments * end
        energy = (momentum * end).sum(axis=1)
        # In principal axes at its end: the velocity of the same momentum, scaled down to the same energy.
        turned = np.einsum("nji,njk,nk->ni", new_axes, old_axes, momentum)
        velocity = turned / moments
        energy_now = (turned * velocity).sum(axis=1)
        tiny = 1e-300  # so that nothing is divided by zero
        scale = np.sqrt(np.minimum(1.0, energy / np.maximum(energy_now, tiny)))
        speed = np.maximum(np.linalg.norm(velocity, axis=1), tiny)
        scale = np.minimum(scale, SETTINGS.largest_turn / time_step / speed)
        velocity *= scale[:, None]
        velocity = np.einsum("nij,nj->ni", new_axes, velocity)
        corrected: list[tuple[int, Motion]] = []
        for (spinner, linear, *_), angular in zip(fast, velocity, strict=True):
            self._engine.set_velocity(spinner.body.id, linear, angular)
            x, y, z = angular.tolist()
            spinner.angular = x, y, z
            corrected.append((spinner.body.id, (tuple(linear.tolist()), spinner.angular)))
        return corrected

    def _fast_spinners(self, time_step: float) -> list[tuple[_Spinner, FloatArray, FloatArray, FloatArray]]:
        """Those to correct, with linear and angular velocity and principal axes; notes how all others move."""
        engine, phase = self._engine, self._steps % SETTINGS.steps_between_looks
        limit = SETTINGS.correction_rate
        still_speed, still_square = SETTINGS.still_speed, SETTINGS.still_spin**2
        fast: list[tuple[_Spinner, FloatArray, FloatArray, FloatArray]] = []
        for body, spinner in tuple(self._spinners.items()):
            if spinner.is_fresh:
                spinner.is_fresh = False
                continue
            if spinner.is_still and body % SETTINGS.steps_between_looks != phase:
                continue
            try:
                linear, angular = engine.motion(body)
            except BodyNotFound:
                del self._spinners[body]
                continue
            x, y, z = angular
            square = x * x + y * y + z * z
            if not square * time_step > limit:
                spinner.angular = angular
                speed = abs(linear[0]) + abs(linear[1]) + abs(linear[2])
                spinner.is_still = speed < still_speed and square < still_square
                continue
            now = np.array(angular)
            if not engine.is_marked(body, spinner.body.token):  # removed, and its id another body's
                del self._spinners[body]
            elif np.isfinite(now).all():
                fast.append((spinner, np.array(linear), now, rotation_of(engine.placement(body)[1])))
        return fast
