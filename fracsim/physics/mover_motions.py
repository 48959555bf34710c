"""How things without a record moved, now and before the last step, for as long as they are near a breakable body.

`Activity` keeps it; impacts are predicted from the motion before a step, which the engine does not remember.
"""

from __future__ import annotations

from collections.abc import Collection

from .bullet import Engine
from .states import BodyLink, BodyState, JointRates, Motion


class MoverMotions:
    """How movers near breakable bodies moved, now and before the last step.

    Parameters
    ----------
    engine : Engine
        The engine.

    Attributes
    ----------
    any_read : bool
        Whether any motion is kept, of now or of before the last step.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.any_read = False
        self._before: dict[BodyLink, Motion] = {}
        self._now: dict[BodyLink, Motion] = {}
        self._rates_before: dict[int, JointRates] = {}
        self._rates_now: dict[int, JointRates] = {}

    def read(self, movers: Collection[BodyLink]) -> None:
        """Read how these move now; what was read last is then before the last step.

        Parameters
        ----------
        movers : collection of (int, int)
            Body and link of each.
        """
        self.any_read = True
        self._before, self._rates_before = self._now, self._rates_now
        self._now = self._engine.motions(movers)
        self._rates_now = {body: self._engine.joints.rates(body) for body, link in self._now if link < 0}

    def read_none(self) -> None:
        """Take note of a step with no mover near."""
        self._before, self._rates_before = self._now, self._rates_now
        self._now, self._rates_now = {}, {}
        self.any_read = bool(self._before)

    def last(self, mover: BodyLink) -> Motion | None:
        """Give the motion that was read last.

        Parameters
        ----------
        mover : tuple of (int, int)
            Body and link.

        Returns
        -------
        Motion or None
            None where it was not near.
        """
        return self._now.get(mover)

    def before(self, mover: BodyLink) -> Motion | None:
        """Give the motion before the last step.

        Parameters
        ----------
        mover : tuple of (int, int)
            Body and link.

        Returns
        -------
        Motion or None
            None where it was not near.
        """
        return self._before.get(mover)

    def rates_before(self, body: int) -> JointRates | None:
        """Give the velocities of a mover's joints before the last step.

        Parameters
        ----------
        body : int
            Its id.

        Returns
        -------
        tuple of tuple of float, or None
            None where it was not near.
        """
        return self._rates_before.get(body)

    def restore(self, state: BodyState) -> None:
        """Take note that a mover was put back to before the last step.

        Parameters
        ----------
        state : BodyState
            Its state now.
        """
        if (state.body, -1) in self._now:
            for key in [key for key in self._now if key[0] == state.body]:
                self._now[key] = self._before.get(key, state.motion)
            self._rates_now[state.body] = state.rates

    def set(self, body: int, motion: Motion) -> None:
        """Take note that a mover was given another velocity.

        Parameters
        ----------
        body : int
            Its id.
        motion : Motion
            Its motion now.
        """
        if (body, -1) in self._now:
            self._now[body, -1] = motion
