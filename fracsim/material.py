"""Materials: the few numbers that turn an impulse into a severity."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np

from .errors import MaterialError

# The diffused velocity field of fracture_modes.impact_field is no elastic wave front, so its jumps need one
# dimensionless gauge before they can be held against the critical velocity: an interface breaks when its
# effective jump of velocity reaches GAUGE * critical_velocity. It is set by everyday experience, that a 0.1 m
# ceramic mug survives a fall from 0.2 m and breaks from 1 m; benchmarks/calibration.py measures it.
GAUGE = 0.2


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


# Rounded, typical values. Glass: soda-lime float glass, EN 572-1 and EN 1288 (flexural strength of annealed
# glass), fracture energy after Wiederhorn 1969. Ceramic: vitrified stoneware and porcelain, Callister,
# Materials Science and Engineering, appendix B. Plaster: set gypsum, EN 13279. Stone: granite, Goodman,
# Introduction to Rock Mechanics, chapter 3. Ice: polycrystalline at -10 °C, Petrovic 2003, Schulson 1999.
PRESETS = {
    material.name: material
    for material in (
        Material("glass", 2500.0, 50e6, 900e6, 5500.0, 8.0),
        Material("ceramic", 2400.0, 50e6, 500e6, 5500.0, 20.0),
        Material("plaster", 1100.0, 2.5e6, 10e6, 2200.0, 5.0),
        Material("stone", 2650.0, 10e6, 170e6, 4500.0, 80.0),
        Material("ice", 917.0, 1.2e6, 10e6, 3800.0, 1.0),
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
