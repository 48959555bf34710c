"""Where a model's options are sought, and what an architecture costs. A model class carries both; tuning reads them.

No module of optuna is imported here, so that a model can be used where nothing is tuned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from ..common.errors import ModelError

# Of the squared error against the squared time, in the choice of an architecture (thesis, Eq. 5.1).
ERROR_WEIGHT = 3.0


class Trial(Protocol):
    """The two methods of ``optuna.Trial`` that a range asks for a value."""

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = ...) -> int:
        """Choose a whole number between two others."""
        ...

    def suggest_float(self, name: str, low: float, high: float, *, log: bool = ...) -> float:
        """Choose a number between two others."""
        ...


@dataclass(frozen=True)
class Range:
    """The values among which one option is sought.

    Attributes
    ----------
    low, high : float
        The ends; both belong to the range. Whole numbers are sought where both ends are of type int.
    log : bool
        Whether values are drawn evenly by their logarithm.

    Raises
    ------
    ModelError
        Where an end is not finite, the ends fall, or a logarithmic range reaches 0.

    Examples
    --------
    >>> Range(32, 512, log=True).narrowed("width", "64:128")
    Range(low=64, high=128, log=True)
    """

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ModelError(f"a range must be two finite numbers that do not fall, got {self.low} to {self.high}")
        if self.log and self.low <= 0:
            raise ModelError(f"a logarithmic range must be above 0, got {self.low}")

    def suggest(self, trial: Trial, name: str) -> float:
        """Let a trial choose a value.

        Parameters
        ----------
        trial : Trial
            An ``optuna.Trial``.
        name : str
            The option's name in the study.

        Returns
        -------
        float
            The value; an int where both ends are.
        """
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    def narrowed(self, name: str, text: str) -> Range:
        """Give the range other ends.

        Parameters
        ----------
        name : str
            The option, for the message of an error.
        text : str
            Two ends, such as "32:128", or a single value, such as "64".

        Returns
        -------
        Range
            The same scale with the new ends.

        Raises
        ------
        ModelError
            Where the text holds no numbers of the range's type.
        """
        low, _, high = text.partition(":")
        whole = isinstance(self.low, int)
        try:
            first, last = (int(end) if whole else float(end) for end in (low, high or low))
        except ValueError as error:
            kind = "whole numbers" if whole else "numbers"
            raise ModelError(f"--range {name} takes LOW:HIGH, {kind}, got {text!r}") from error
        return Range(first, last, self.log)


@dataclass(frozen=True)
class Cost:
    """The cost of an architecture, sqrt(t² + w AMAE²), by which one is chosen on the Pareto front.

    Time is in seconds: in milliseconds, which the thesis prints beside it, the fastest architecture would be chosen
    whatever its error.

    Attributes
    ----------
    error_weight : float
        w, the weight of the squared error against the squared time.

    References
    ----------
    Thesis, Eq. 5.1.
    """

    error_weight: float = ERROR_WEIGHT

    def __call__(self, amae: float, seconds: float) -> float:
        """Weigh an error against a time.

        Parameters
        ----------
        amae : float
            Mean error over the folds, see ``metrics.amae``.
        seconds : float
            Median time of a query.

        Returns
        -------
        float
            The cost; less is better.
        """
        return math.sqrt(seconds**2 + self.error_weight * amae**2)

    @property
    def rule(self) -> str:
        """The rule of the choice, in words."""
        return f"least sqrt(seconds^2 + {self.error_weight:g} amae^2) on the Pareto front (thesis, Eq. 5.1)"
