"""What a simulator says of itself where it says it at all: what severities are to it, whether it is slow, and so on.

Baking, datasets and ``fracsim.Simulator`` ask here. A class need not say any of it; users' classes often do not.
"""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from ..common.arrays import FloatArray
from ..common.errors import BakeError
from .base import FractureSimulator, Impacts

SEVERITY_KINDS = ("impulse", "force")  # what a severity may measure; ``base.Impacts`` says how
DEFAULT_SAMPLES = 250_000  # impacts that a bake draws of a simulator that answers them at once


@runtime_checkable
class Slow(Protocol):
    """A simulator's class whose answers take long, so that a bake draws fewer of them unless it is told how many.

    Attributes
    ----------
    default_samples : int
        How many.
    """

    default_samples: ClassVar[int]


@runtime_checkable
class FirstCrack(Protocol):
    """A simulator that finds where a first crack opens in far less time than where the body comes apart."""

    def first_crack(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to open a first crack.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            Factors on each impact's severities, finite, above 0, and at most what ``thresholds`` gives.
        """
        ...


def reference_factors(simulator: FractureSimulator, impacts: Impacts) -> FloatArray:
    """Find how severe impacts must be to begin to matter; severities of samples are drawn about that.

    Parameters
    ----------
    simulator : FractureSimulator
        What breaks the body.
    impacts : Impacts
        N impacts.

    Returns
    -------
    ndarray of float64, shape (N,)
        The factors at which a first crack opens, of a simulator that knows them (``FirstCrack``); of any other, those
        at which the body falls into two pieces.
    """
    return simulator.first_crack(impacts) if isinstance(simulator, FirstCrack) else simulator.thresholds(impacts)


def severity_kind_of(simulator: FractureSimulator | type[FractureSimulator]) -> str:
    """Say what severities are to a simulator.

    Parameters
    ----------
    simulator : FractureSimulator or type
        A simulator or its class, registered or not.

    Returns
    -------
    str
        "force" or "impulse", which it is where the simulator does not say.

    Raises
    ------
    BakeError
        If it says something else.
    """
    kind = getattr(simulator, "severity_kind", SEVERITY_KINDS[0])
    if kind not in SEVERITY_KINDS:
        name = simulator.__name__ if isinstance(simulator, type) else type(simulator).__name__
        raise BakeError(f"{name}: severity_kind must be {' or '.join(SEVERITY_KINDS)}, got {kind!r}")
    return str(kind)


def default_samples(cls: type[FractureSimulator]) -> int:
    """Say how many impacts a bake draws of a simulator unless it is told.

    Parameters
    ----------
    cls : type
        The simulator's class.

    Returns
    -------
    int
        Its own number where it is ``Slow``, else ``DEFAULT_SAMPLES``.
    """
    return cls.default_samples if isinstance(cls, Slow) else DEFAULT_SAMPLES
