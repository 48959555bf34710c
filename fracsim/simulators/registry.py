"""TODO simulators.registry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..common.errors import BakeError, MissingExtraError
from ..solids.surface import Surface
from .base import FractureSimulator
from .modal import modal_simulator

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError("threadpoolctl", "bake") from error


SIMULATORS = ("modal", "elastic", "radial")


@dataclass(frozen=True)
class SimulatorOptions:
    """What ``make_simulator`` builds.

    truth: "modal"; "elastic", the modal atoms driven apart by elastic stress; or "radial". cells: of the solid, about.
    modes: fracture modes, which radial cracks do without. min_piece_volume_fraction: of the volume; smaller pieces join a
    neighbour.
    """

    name: str = "modal"
    cells: int = 5000
    modes: int = 20
    min_piece_volume_fraction: float = 1e-3

    def __post_init__(self) -> None:
        if self.name not in SIMULATORS:
            raise BakeError(f"unknown truth {self.name!r}; use {' or '.join(SIMULATORS)}")
        for name, least in (("cells", 50), ("modes", 0)):
            if not (isinstance(getattr(self, name), int) and getattr(self, name) >= least):
                raise BakeError(f"{name} must be a whole number and at least {least}, got {getattr(self, name)}")
        if not 0.0 <= self.min_piece_volume_fraction < 1.0:
            raise BakeError(
                f"min_piece_volume_fraction must be at least 0 and below 1, got {self.min_piece_volume_fraction}"
            )


def make_simulator(
    surface: Surface,
    options: SimulatorOptions,
    seed: int,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> FractureSimulator:
    """The truth of a surface, the same for the same seed (the elastic one but nearly so: fTetWild, which makes its
    mesh, does not repeat itself). Raises BakeError when the surface cannot be cut up."""
    if seed < 0:
        raise BakeError(f"a seed must be at least 0, got {seed}")
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        if options.name == "radial":
            from .radial import radial_simulator

            progress("solid", 0.0)
            return radial_simulator(surface, rng, options.cells, options.min_piece_volume_fraction)
        modal = modal_simulator(surface, rng, options.cells, options.modes, options.min_piece_volume_fraction, progress)
    if options.name == "elastic":
        from .elastic import elastic_simulator

        return elastic_simulator(modal, progress=progress)
    return modal
