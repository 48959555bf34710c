"""Materials: what objects that break are made of, and what they touch; every room may read them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, asdict, dataclass, fields

from .checks import is_number
from .errors import MaterialError

DERIVED = math.nan  # of Young's modulus where it was left out: it follows from the speed of sound
ANY_POSITIVE: tuple[str, Callable[[float], bool]] = ("finite and above 0", lambda value: value > 0.0)
OTHERWISE: dict[str, tuple[str, Callable[[float], bool]]] = {  # properties with another range
    "restitution": ("between 0 and 1", lambda value: 0.0 <= value <= 1.0),
    "friction": ("finite and at least 0", lambda value: value >= 0.0),
    "poisson_ratio": ("at least 0 and below 0.5", lambda value: 0.0 <= value < 0.5),
}


@dataclass(frozen=True)
class Material:
    """An isotropic brittle material.

    Fracture energy and fracture toughness say the same: the energy is given, and the toughness follows from it.

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
        G, J/m², that a unit of crack area takes to open; above 0.
    restitution : float
        Of a contact with it, from 0 to 1.
    friction : float
        Coulomb's coefficient of a contact with it, at least 0.
    youngs_modulus : float
        E, Pa, above 0. Left out: ρ c² (1 + ν) (1 - 2ν) / (1 - ν), of the sound speed c.
    poisson_ratio : float
        ν, at least 0 and below 0.5.
    weibull_modulus : float
        m, how little the strength of equal samples scatters; above 0.

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
    >>> round(brick.youngs_modulus / 1e9, 1), round(brick.fracture_toughness / 1e6, 2)
    (15.4, 0.9)
    """

    name: str
    density: float
    tensile_strength: float
    compressive_strength: float
    sound_speed: float
    fracture_energy: float
    restitution: float = 0.1
    friction: float = 0.5
    _: KW_ONLY
    youngs_modulus: float = DERIVED
    poisson_ratio: float = 0.2
    weibull_modulus: float = 10.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "name" or (field.name == "youngs_modulus" and value is DERIVED):
                continue
            allowed, is_allowed = OTHERWISE.get(field.name, ANY_POSITIVE)
            if not is_number(value) or not is_allowed(value):
                raise MaterialError(f"material {self.name!r}: {field.name} must be {allowed}, got {value!r}")
            object.__setattr__(self, field.name, float(value))
        if math.isnan(self.youngs_modulus):
            nu = self.poisson_ratio
            modulus = self.density * self.sound_speed**2 * (1.0 + nu) * (1.0 - 2.0 * nu) / (1.0 - nu)
            object.__setattr__(self, "youngs_modulus", modulus)

    @property
    def critical_velocity(self) -> float:
        """m/s, the jump of velocity at which an elastic wave carries the tensile strength: σ = ρ c Δv."""
        return self.tensile_strength / (self.density * self.sound_speed)

    @property
    def fracture_toughness(self) -> float:
        """K_Ic, Pa·√m, of a crack between two blocks: √(E G / (1 - ν²)), so that G = K² (1 - ν²) / E."""
        return math.sqrt(self.youngs_modulus * self.fracture_energy / (1.0 - self.poisson_ratio**2))

    def to_dict(self) -> dict[str, float | str]:
        """Return the properties by name, as ``Material(**...)`` takes them.

        Returns
        -------
        dict
            Of str and float.
        """
        return asdict(self)


@dataclass(frozen=True)
class ContactMaterial:
    """What breakable things touch, as far as the contact is concerned.

    Attributes
    ----------
    name : str
        What messages call it.
    youngs_modulus : float
        E, Pa, above 0; of a layer, that of a secant over most of its compression.
    poisson_ratio : float
        ν, at least 0 and below 0.5.
    travel : float or None
        m, by which it can be indented before it is pressed together against a hard base. With it, it is a layer, into
        which a body sinks with a radius of half its size; None: a body that is touched at a point, however deep.

    Raises
    ------
    MaterialError
        If a property lies outside its range.
    """

    name: str
    youngs_modulus: float
    poisson_ratio: float = 0.3
    travel: float | None = None

    def __post_init__(self) -> None:
        travel = 1.0 if self.travel is None else self.travel
        for name, value in (("youngs_modulus", self.youngs_modulus), ("travel", travel)):
            if not is_number(value) or value <= 0.0:
                raise MaterialError(f"material {self.name!r}: {name} must be finite and above 0, got {value!r}")
        if not is_number(self.poisson_ratio) or not 0.0 <= self.poisson_ratio < 0.5:
            raise MaterialError(
                f"material {self.name!r}: poisson_ratio must be at least 0 and below 0.5, got {self.poisson_ratio!r}"
            )


# Small objects as one meets them, not the best or worst of their kind; docs/simulators.md gives the source of every
# number. Sound speeds follow from E and ν, c² = E (1 - ν) / (ρ (1 + ν) (1 - 2ν)), but for stone, whose is measured;
# fracture energies from the fracture toughness where no measured one is cited. name, ρ, σ_t, σ_c, c, G; then E, ν and
# Weibull's modulus.
_SOLIDS = (
    (("glass", 2480.0, 50e6, 1000e6, 5900.0, 7.8), 74e9, 0.23, 7.0),
    (("ceramic", 2400.0, 45e6, 350e6, 5700.0, 14.0), 70e9, 0.2, 10.0),
    (("plaster", 1100.0, 2.3e6, 12e6, 2130.0, 4.2), 4.5e9, 0.2, 5.0),
    (("stone", 2650.0, 11.7e6, 141e6, 5500.0, 80.0), 58e9, 0.22, 10.0),
    (("ice", 917.0, 1.7e6, 10e6, 3830.0, 1.4), 9.1e9, 0.33, 5.0),
)
PRESETS = {
    numbers[0]: Material(*numbers, youngs_modulus=modulus, poisson_ratio=ratio, weibull_modulus=weibull)
    for numbers, modulus, ratio, weibull in _SOLIDS
}

# What things fall on and are gripped with; sources as above.
CONTACT_PRESETS = {
    material.name: material
    for material in (
        ContactMaterial("steel", 210e9, 0.3),
        ContactMaterial("stone", 58e9, 0.22),
        ContactMaterial("wood", 1.1e9, 0.35),  # a floor board, across the grain
        ContactMaterial("rubber", 3.6e6, 0.49, 0.016),  # a mat of 20 mm, 60 Shore A
        ContactMaterial("foam", 0.3e6, 0.3, 0.047),  # 50 mm of polyethylene foam, 35 kg/m³
        ContactMaterial("skin", 0.9e6, 0.49, 0.0024),  # a robot's finger pad: 3 mm of silicone, 25 Shore A
        ContactMaterial("carpet", 0.5e6, 0.0, 0.016),  # 20 mm of carpet and underlay, on concrete
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


def as_contact_material(material: str | Material | ContactMaterial) -> ContactMaterial:
    """Look up what something that is touched is made of.

    Parameters
    ----------
    material : str, Material or ContactMaterial
        "carpet", "foam", "rubber", "skin", "steel", "stone", "wood", the name of a preset of `as_material`, or a
        material of your own.

    Returns
    -------
    ContactMaterial
        The material; of a `Material`, its elastic constants.

    Raises
    ------
    MaterialError
        If there is no preset of that name; the message lists them.
    """
    if isinstance(material, ContactMaterial):
        return material
    if isinstance(material, str):
        preset = CONTACT_PRESETS.get(material)
        if preset is not None:
            return preset
        material = PRESETS.get(material, material)
    if not isinstance(material, Material):
        names = ", ".join(sorted({*CONTACT_PRESETS, *PRESETS}))
        raise MaterialError(f"unknown material {material!r}; use {names}, or a fracsim.Material")
    return ContactMaterial(material.name, material.youngs_modulus, material.poisson_ratio)
