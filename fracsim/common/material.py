"""Materials: the few numbers that turn an impulse into a severity."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np

from .errors import MaterialError

# The diffused velocity field of fracture_modes.impact_field is no elastic wave front, so its jumps need one
# dimensionless gauge before they can be held against the critical velocity: an interface breaks when its
# effective jump of velocity reaches GAUGE * critical_velocity. It is set by everyday experience, that a 0.1 m
# ceramic mug survives a fall from 0.2 m and breaks from 1 m; benchmarks/calibration.py measures it.
GAUGE = 0.24


@dataclass(frozen=True)
class Material:
    """An isotropic brittle material.

    density: kg/m³. tensile_strength, compressive_strength: Pa. sound_speed: m/s, longitudinal.
    fracture_energy: J/m², to open a unit of crack area. restitution, friction: of contacts with it.
    """

    name: str
    density: float
    tensile_strength: float
    compressive_strength: float
    sound_speed: float
    fracture_energy: float
    restitution: float = 0.1
    friction: float = 0.5

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "name":
                continue
            allowed = (0.0 if field.name in ("restitution", "friction") else np.nextafter(0, 1), np.inf)
            try:
                valid = bool(np.isfinite(value)) and allowed[0] <= float(value) < allowed[1]
            except (TypeError, ValueError):
                valid = False
            if not valid:
                raise MaterialError(f"material {self.name!r}: {field.name} must be positive, got {value!r}")
            object.__setattr__(self, field.name, float(value))

    @property
    def critical_velocity(self) -> float:
        """m/s: the jump of velocity at which an elastic wave carries the tensile strength, σ = ρ c Δv."""
        return self.tensile_strength / (self.density * self.sound_speed)

    @property
    def breaking_velocity(self) -> float:
        """m/s: the jump of the diffused velocity field that breaks an interface."""
        return GAUGE * self.critical_velocity

    def to_dict(self) -> dict[str, float | str]:
        return asdict(self)


# Small objects as one meets them, not the best or worst of their kind; docs/simulators.md gives the source of every
# number. Sound speeds follow from E and ν, c² = E (1 - ν) / (ρ (1 + ν) (1 - 2ν)), fracture energies from the fracture
# toughness, G = K² (1 - ν²) / E, where no measured one is cited.
PRESETS = {
    material.name: material
    for material in (
        Material("glass", 2480.0, 50e6, 1000e6, 5900.0, 7.8),
        Material("ceramic", 2400.0, 45e6, 350e6, 5700.0, 14.0),
        Material("plaster", 1100.0, 2.3e6, 12e6, 2130.0, 4.2),
        Material("stone", 2650.0, 11.7e6, 141e6, 5500.0, 80.0),
        Material("ice", 917.0, 1.7e6, 10e6, 3830.0, 1.4),
    )
}


def as_material(material: str | Material) -> Material:
    """A preset by name, or the material itself; MaterialError lists the presets when there is none."""
    if isinstance(material, Material):
        return material
    try:
        return PRESETS[material]
    except (KeyError, TypeError):
        raise MaterialError(
            f"unknown material {material!r}; use {', '.join(sorted(PRESETS))}, or a fracsim.Material"
        ) from None
