"""Materials: the few numbers that turn an impulse into a severity; every room may read them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

from .checks import is_number
from .errors import MaterialError

# The diffused velocity field of simulators.diffusion is no elastic wave front, so its jumps need one dimensionless
# gauge before they can be held against the critical velocity: an interface breaks when its effective jump of velocity
# reaches GAUGE * critical_velocity. It is set by everyday experience, that a 0.1 m ceramic mug survives a fall from
# 0.2 m and breaks from 1 m; benchmarks/calibration.py measures it.
GAUGE = 0.24


@dataclass(frozen=True)
class Material:
    """An isotropic brittle material.

    Attributes
    ----------
    name : str
        What messages call it.
    density : float
        kg/m³, above 0.
    tensile_strength, compressive_strength : float
        Pa, above 0.
    sound_speed : float
        m/s, of longitudinal waves; above 0.
    fracture_energy : float
        J/m², that a unit of crack area takes to open; above 0.
    restitution : float
        Of a contact with it, from 0 to 1.
    friction : float
        Coulomb's coefficient of a contact with it, at least 0.

    Raises
    ------
    MaterialError
        If a property lies outside its range.

    Examples
    --------
    >>> import fracsim
    >>> brick = fracsim.Material("brick", 1900.0, 2.5e6, 30e6, 3000.0, 50.0)
    >>> round(brick.critical_velocity, 3)
    0.439
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
            if field.name == "name":
                continue
            value = getattr(self, field.name)
            if field.name == "restitution":
                valid, allowed = is_number(value) and 0.0 <= value <= 1.0, "between 0 and 1"
            elif field.name == "friction":
                valid, allowed = is_number(value) and value >= 0.0, "finite and at least 0"
            else:
                valid, allowed = is_number(value) and value > 0.0, "finite and above 0"
            if not valid:
                raise MaterialError(f"material {self.name!r}: {field.name} must be {allowed}, got {value!r}")
            object.__setattr__(self, field.name, float(value))

    @property
    def critical_velocity(self) -> float:
        """m/s, the jump of velocity at which an elastic wave carries the tensile strength: σ = ρ c Δv."""
        return self.tensile_strength / (self.density * self.sound_speed)

    @property
    def breaking_velocity(self) -> float:
        """m/s, the jump of the diffused velocity field that breaks an interface."""
        return GAUGE * self.critical_velocity

    def to_dict(self) -> dict[str, float | str]:
        """Return the properties by name, as ``Material(**...)`` takes them.

        Returns
        -------
        dict
            Of str and float.
        """
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
    """Look up a preset by its name; a material is returned as it is.

    Parameters
    ----------
    material : str or Material
        "ceramic", "glass", "ice", "plaster", "stone", or a material of your own.

    Returns
    -------
    Material
        The material.

    Raises
    ------
    MaterialError
        If there is no preset of that name; the message lists them.
    """
    if isinstance(material, Material):
        return material
    preset = PRESETS.get(material) if isinstance(material, str) else None
    if preset is None:
        raise MaterialError(f"unknown material {material!r}; use {', '.join(sorted(PRESETS))}, or a fracsim.Material")
    return preset
