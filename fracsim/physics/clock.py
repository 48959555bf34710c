"""The clock of a world: simulated time, and the time step and gravity that the engine has.

The stages of a world read it; only `World.step` advances it.
"""

from __future__ import annotations

from .bullet import Engine
from .impacts import impact_speed_threshold
from .states import Triple

# Steps after which a change of the time step or of gravity is noticed at the latest. Reading them in every step
# would be one more call of the engine in steps in which nothing happens.
STEPS_BETWEEN_READINGS = 8


class Clock:
    """Time, time step and gravity of a world.

    Parameters
    ----------
    engine : Engine
        Engine whose time step and gravity it reads.

    Attributes
    ----------
    steps : int
        Steps taken.
    time_step : float
        Duration of a step, s.
    gravity : tuple of float
        Acceleration, shape (3,), m/s².
    impact_speed_threshold : float
        Closing speed below which a contact is no impact, m/s.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.steps = 0
        self._time_read = 0.0  # s, at the last reading
        self._steps_read = 0
        self.time_step: float
        self.gravity: Triple
        self.time_step, self.gravity = engine.clock()
        self.impact_speed_threshold = impact_speed_threshold(self.time_step, self.gravity)

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._time_read + (self.steps - self._steps_read) * self.time_step

    def tick(self) -> bool:
        """Count a step.

        Returns
        -------
        bool
            Whether the engine's settings should be read again.
        """
        self.steps += 1
        return self.steps - self._steps_read == STEPS_BETWEEN_READINGS

    def read(self) -> bool:
        """Read the engine's time step and gravity, which somebody may have changed.

        Returns
        -------
        bool
            Whether they have changed.
        """
        self._time_read, self._steps_read = self.time, self.steps
        known = self.time_step, self.gravity
        self.time_step, self.gravity = self._engine.clock()
        if (self.time_step, self.gravity) == known:
            return False
        self.impact_speed_threshold = impact_speed_threshold(self.time_step, self.gravity)
        return True
