"""The options of a simulator, and ``make_simulator``, which builds any registered one from them. Offline only.

Datasets, studies and baking come in here; no simulator is known by its name in this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..common.errors import BakeError, MissingExtraError
from ..common.material import Material
from ..common.options import option_from_text, option_types
from ..solids.surface import Surface
from . import SIMULATORS, simulator_class, unknown_simulator
from .base import FractureSimulator, MaterialDependent, Progress, no_progress

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError("threadpoolctl", "bake") from error

LEAST_CELLS = 50  # fewer do not resolve any shape


@dataclass(frozen=True)
class SimulatorOptions:
    """What ``make_simulator`` builds.

    A simulator with more options has an ``options_type`` derived from this class; ``options_for`` finds it.

    Attributes
    ----------
    name : str
        A registered simulator: "modal", "structural", "sequential", "elastic", "radial", or one of your own.
    cells : int
        About how many cells the body is cut into, at least 50.
    modes : int
        Fracture modes, at least 0; a simulator without modes takes no notice of it.
    min_piece_volume_fraction : float
        Pieces of less than this fraction of the body's volume join a neighbour; at least 0 and below 1.

    Raises
    ------
    BakeError
        If a value is out of range, or no simulator has that name.
    """

    name: str = "modal"
    cells: int = 5000
    modes: int = 20
    min_piece_volume_fraction: float = 1e-3

    def __post_init__(self) -> None:
        if self.name not in SIMULATORS:
            raise unknown_simulator(self.name)
        for name, value, limit in (("cells", self.cells, LEAST_CELLS), ("modes", self.modes, 0)):
            if not (isinstance(value, int) and value >= limit):
                raise BakeError(f"{name} must be a whole number and at least {limit}, got {value}")
        if not 0.0 <= self.min_piece_volume_fraction < 1.0:
            raise BakeError(
                f"min_piece_volume_fraction must be at least 0 and below 1, got {self.min_piece_volume_fraction}"
            )


def options_for(name: str = "modal", **values: Any) -> SimulatorOptions:
    """Make the options of a registered simulator, of its own ``options_type``.

    Parameters
    ----------
    name : str
        The simulator's.
    **values
        Its options; those not named keep their defaults.

    Returns
    -------
    SimulatorOptions
        Or what the simulator derives from it.

    Raises
    ------
    BakeError
        If no simulator has that name, it has no such option, or a value is out of range.
    """
    kind = simulator_class(name).options_type
    known = [field.name for field in fields(kind)]
    for option in values:
        if option not in known:
            raise BakeError(f"simulator {name!r} has no option {option!r}; it has {', '.join(known)}")
    return kind(name=name, **values)


def options_for_body(name: str, material: Material, size: float, **values: Any) -> SimulatorOptions:
    """Make the options of a registered simulator for a body of some material and size.

    Parameters
    ----------
    name : str
        The simulator's.
    material : Material
        What the body is made of.
    size : float
        m, its largest extent.
    **values
        Options that are set whatever the body is; the others follow from it where the simulator's class is
        ``MaterialDependent``, or keep their defaults.

    Returns
    -------
    SimulatorOptions
        Or what the simulator derives from it.

    Raises
    ------
    BakeError
        If no simulator has that name, it has no such option, or a value is out of range.
    """
    cls = simulator_class(name)
    of_body: dict[str, Any] = cls.material_options(material, size) if isinstance(cls, MaterialDependent) else {}
    return options_for(name, **{**of_body, **values})


def options_from(name: str, texts: Mapping[str, str]) -> dict[str, Any]:
    """Read options of a registered simulator that are given as text.

    Parameters
    ----------
    name : str
        The simulator's.
    texts : mapping of str to str
        Values as somebody wrote them, by the names of the options.

    Returns
    -------
    dict
        The values, as `options_for` takes them.

    Raises
    ------
    BakeError
        If no simulator has that name, it has no such option, or a text is no such value.
    """
    types = option_types(simulator_class(name).options_type)
    for option in texts:
        if option not in types or option == "name":
            known = ", ".join(known for known in types if known != "name")
            raise BakeError(f"simulator {name!r} has no option {option!r}; it has {known}")
    return {option: option_from_text(option, text, types[option], BakeError) for option, text in texts.items()}


def make_simulator(
    surface: Surface, options: SimulatorOptions, seed: int, progress: Progress = no_progress
) -> FractureSimulator:
    """Build the simulator of a surface.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    options : SimulatorOptions
        Which simulator, and how fine.
    seed : int
        At least 0. The same seed gives the same simulator, bit by bit where its class is ``repeatable``.
    progress : callable
        Hears the stage and the share of it that is done.

    Returns
    -------
    FractureSimulator
        An instance of the registered class.

    Raises
    ------
    BakeError
        If the surface cannot be cut into cells, or the simulator cannot work with it.
    MissingExtraError
        If what the simulator needs is not installed.
    """
    if seed < 0:
        raise BakeError(f"a seed must be at least 0, got {seed}")
    cls = simulator_class(options.name)
    if not isinstance(options, cls.options_type):
        options = options_for(**asdict(options))
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        return cls.build(surface, options, rng, progress)
