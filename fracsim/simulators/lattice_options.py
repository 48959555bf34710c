"""The options of the lattice simulators, and what of them follows from a body's material and size. Offline only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.checks import is_number
from ..common.contact import hertz_stiffness, pair_modulus
from ..common.errors import BakeError
from ..common.material import PRESETS, Material
from .registry import SimulatorOptions

SPEED = 3.0  # m/s, of approach, for which the duration of a contact is worked out; it depends on its fifth root
SIZE = 0.1  # m, of the ceramic body that the defaults are for
POSITIVE = ("brittleness", "strain", "approach_speed")


def material_options(material: Material, size: float) -> dict[str, float]:
    """Work out the options that follow from a body's material and size.

    Parameters
    ----------
    material : Material
        What it is made of.
    size : float
        m, its largest extent.

    Returns
    -------
    dict of str to float
        ``brittleness``, ``strain``, ``poisson_ratio`` and ``approach_speed``.
    """
    modulus, strength = material.youngs_modulus, material.tensile_strength
    return {
        "brittleness": modulus * material.fracture_energy / (strength**2 * size),
        "strain": strength / modulus,
        "poisson_ratio": material.poisson_ratio,
        "approach_speed": float(SPEED / np.sqrt(modulus / material.density)),
    }


DEFAULTS = material_options(PRESETS["ceramic"], SIZE)


@dataclass(frozen=True)
class LatticeOptions(SimulatorOptions):
    """What a lattice simulator is built with.

    Attributes
    ----------
    cells : int
        About how many cells the body is divided into.
    modes : int
        Not used: there are no modes.
    brittleness : float
        E G_c / (strength² L), the material's own length over the body's; above 0. A small one breaks like glass.
    strain : float
        Strength / E; above 0.
    poisson_ratio : float
        Of the contact; at least 0 and below 0.5.
    approach_speed : float
        Speed at which contacts come together, in units of sqrt(E / density); above 0.
    speed_number : float
        pi L / (t c), for contacts of duration t; 0: the median over falls at ``approach_speed``.

    Raises
    ------
    BakeError
        If a value is out of range.
    """

    cells: int = 300
    modes: int = 0
    min_piece_volume_fraction: float = 0.01
    brittleness: float = DEFAULTS["brittleness"]
    strain: float = DEFAULTS["strain"]
    poisson_ratio: float = DEFAULTS["poisson_ratio"]
    approach_speed: float = DEFAULTS["approach_speed"]
    speed_number: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in POSITIVE:
            if not (is_number(value := getattr(self, name)) and value > 0.0):
                raise BakeError(f"{name} must be finite and above 0, got {value}")
        if not (is_number(self.poisson_ratio) and 0.0 <= self.poisson_ratio < 0.5):
            raise BakeError(f"poisson_ratio must be at least 0 and below 0.5, got {self.poisson_ratio}")
        if not (is_number(self.speed_number) and self.speed_number >= 0.0):
            raise BakeError(f"speed_number must be finite and at least 0, got {self.speed_number}")

    @property
    def hertz(self) -> float:
        """K of a contact with what is hard, F = k d^(3/2), in E L^(1/2)."""
        return hertz_stiffness(pair_modulus(1.0, self.poisson_ratio), 1.0)
