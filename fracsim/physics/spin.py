"""Keeping fast shards from gaining energy as they spin.

The engine turns a body by an explicit step of Euler's equations, ω ← ω − dt I⁻¹(ω × I ω), which adds energy at a rate
of about ω² dt: nothing to an object that tumbles, a hundred thousand times in a second to a shard at 200 rad/s.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.arrays import FloatArray
from .bodies import Body
from .bullet import Engine
from .rotations import cross, rotation_of
from .states import BodyNotFound, Motion, Triple

FAST = 0.05  # 1/s, the ω² dt from which a body's spin is held
TURN = 1.0  # rad a step: what would turn further is slowed down to it; no step of any kind resolves that
STILL = 0.01  # m/s, and rad²/s²
EVERY = 2  # steps between looks at one that lies still


@dataclass(eq=False)
class _Spinner:
    body: Body
    angular: Triple  # rad/s, after the last step
    fresh: bool = True  # whether no step has been taken since that is known
    still: bool = False


class GyroscopicCorrection:
    """The bodies whose spin is held."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._all: dict[int, _Spinner] = {}
        self._steps = 0

    def add(self, bodies: Iterable[Body], angular: Triple) -> None:
        """Bodies that turn alike from now on."""
        self._all.update({body.id: _Spinner(body, angular) for body in bodies})

    def drop(self, body: int) -> None:
        self._all.pop(body, None)

    def changed(self, body: int, angular: Triple) -> None:
        """Somebody put it elsewhere or gave it another velocity, after the last step."""
        if body in self._all:
            self._all[body] = _Spinner(self._all[body].body, angular)

    @property
    def moving(self) -> set[int]:
        """The ids of those that do not lie still."""
        return {key for key, spinner in self._all.items() if not spinner.still}

    def hold(self, dt: float) -> list[tuple[int, Motion]]:
        """After a step: give what spins fast the angular momentum that the step should have left it, and no more
        energy than it had; contacts' part in both is kept. Returns the motions that it gave."""
        self._steps += 1
        engine, phase = self._engine, self._steps % EVERY
        held: list[tuple[_Spinner, FloatArray, FloatArray, FloatArray]] = []
        for key, spinner in tuple(self._all.items()):
            if spinner.fresh:
                spinner.fresh = False
                continue
            if spinner.still and key % EVERY != phase:
                continue
            try:
                linear, angular = engine.motion(key)
            except BodyNotFound:
                del self._all[key]
                continue
            x, y, z = angular
            square = x * x + y * y + z * z
            if not square * dt > FAST:
                spinner.angular = angular
                spinner.still = square + abs(linear[0]) + abs(linear[1]) + abs(linear[2]) < STILL
                continue
            now = np.array(angular)
            if not engine.is_marked(key, spinner.body.token):  # removed, and its id somebody else's
                del self._all[key]
            elif np.isfinite(now).all():
                held.append((spinner, np.array(linear), now, rotation_of(engine.placement(key)[1])))
        if not held:
            return []
        moments = np.array([spinner.body.moments for spinner, *_ in held])
        before = np.array([spinner.angular for spinner, *_ in held])
        now = np.array([angular for _, _, angular, _ in held])
        new = np.array([rotation for *_, rotation in held])
        old = Rotation.from_rotvec(-dt * now).as_matrix() @ new  # the step turned it by what it ended with
        # In principal axes at the start of the step: the velocity that contacts alone would have left.
        start = np.einsum("nji,nj->ni", old, before)
        end = np.einsum("nji,nj->ni", old, now) + dt * cross(start, moments * start) / moments
        momentum = moments * end
        energy = (momentum * end).sum(axis=1)
        # And in those at its end: the velocity of the same momentum, held down to the same energy.
        turned = np.einsum("nji,njk,nk->ni", new, old, momentum)
        velocity = turned / moments
        found = (turned * velocity).sum(axis=1)
        scale = np.sqrt(np.minimum(1.0, energy / np.maximum(found, 1e-300)))
        scale = np.minimum(scale, TURN / dt / np.maximum(np.linalg.norm(velocity, axis=1), 1e-300))
        velocity *= scale[:, None]
        velocity = np.einsum("nij,nj->ni", new, velocity)
        given: list[tuple[int, Motion]] = []
        for (spinner, speed, *_), spin in zip(held, velocity, strict=True):
            engine.set_velocity(spinner.body.id, speed, spin)
            x, y, z = spin.tolist()
            spinner.angular = x, y, z
            given.append((spinner.body.id, (tuple(speed.tolist()), spinner.angular)))
        return given
