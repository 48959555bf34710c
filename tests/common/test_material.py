"""Materials: every property has a range of its own, and a message that states it."""

from __future__ import annotations

import numpy as np
import pytest

import fracsim
from fracsim.common.material import CONTACT_PRESETS, PRESETS, ContactMaterial, as_contact_material, as_material

NUMBERS = {
    "density": 1900.0,
    "tensile_strength": 2.5e6,
    "compressive_strength": 30e6,
    "sound_speed": 3000.0,
    "fracture_energy": 50.0,
}


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("restitution", 5.0, "between 0 and 1"),
        ("restitution", -0.1, "between 0 and 1"),
        ("restitution", np.nan, "between 0 and 1"),
        ("friction", -1.0, "finite and at least 0"),
        ("friction", np.inf, "finite and at least 0"),
        ("poisson_ratio", 0.5, "at least 0 and below 0.5"),
        ("poisson_ratio", -0.1, "at least 0 and below 0.5"),
        ("youngs_modulus", -1.0, "finite and above 0"),
        ("weibull_modulus", 0.0, "finite and above 0"),
        *((name, 0.0, "finite and above 0") for name in NUMBERS),
        *((name, value, "finite and above 0") for name in NUMBERS for value in (-1.0, np.inf, "heavy", None)),
    ],
)
def test_a_property_outside_its_range_is_refused_by_name(name, value, allowed):
    with pytest.raises(fracsim.MaterialError, match=f"'brick': {name} must be {allowed}, got"):
        fracsim.Material("brick", **{**NUMBERS, name: value})


@pytest.mark.parametrize(("name", "value"), [("restitution", 0), ("restitution", 1), ("friction", 0), ("friction", 3)])
def test_the_ends_of_a_range_are_allowed(name, value):
    material = fracsim.Material("brick", **NUMBERS, **{name: value})
    assert getattr(material, name) == float(value)
    assert isinstance(getattr(material, name), float)


@pytest.mark.parametrize("wrong", ["cheese", None, 3, ["glass"]])
def test_an_unknown_material_is_refused_with_the_names_of_the_presets(wrong):
    with pytest.raises(fracsim.MaterialError, match="use ceramic, glass, ice, plaster, stone"):
        as_material(wrong)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_as_dictionaries(name):
    assert fracsim.Material(**as_material(name).to_dict()) == as_material(name)


def test_youngs_modulus_follows_from_the_speed_of_sound_where_it_is_left_out():
    brick = fracsim.Material("brick", 1900.0, 2.5e6, 30e6, 3000.0, 50.0)
    assert brick.poisson_ratio == 0.2
    assert brick.youngs_modulus == pytest.approx(1900.0 * 3000.0**2 * 1.2 * 0.6 / 0.8)
    assert fracsim.Material("brick", **NUMBERS, youngs_modulus=20e9).youngs_modulus == 20e9


@pytest.mark.parametrize("name", PRESETS)
def test_speeds_of_sound_agree_with_the_elastic_constants(name):
    material = PRESETS[name]
    nu = material.poisson_ratio
    wave = material.youngs_modulus * (1 - nu) / (material.density * (1 + nu) * (1 - 2 * nu))
    # Granite's is that of its minerals, which have no cracks between them.
    assert wave**0.5 == pytest.approx(material.sound_speed, rel=0.12 if name == "stone" else 0.01)


@pytest.mark.parametrize(
    ("name", "toughness"), [("glass", 0.75), ("ceramic", 1.0), ("plaster", 0.14), ("stone", 2.2), ("ice", 0.12)]
)
def test_toughness_follows_from_the_fracture_energy(name, toughness):
    material = PRESETS[name]
    assert material.fracture_toughness == pytest.approx(toughness * 1e6, rel=0.05)
    plane = material.youngs_modulus / (1 - material.poisson_ratio**2)
    assert material.fracture_toughness**2 / plane == pytest.approx(material.fracture_energy)


def test_what_is_touched_is_a_preset_or_any_material():
    assert as_contact_material("rubber") is CONTACT_PRESETS["rubber"]
    assert as_contact_material("ceramic").youngs_modulus == PRESETS["ceramic"].youngs_modulus
    assert as_contact_material(PRESETS["ice"]) == ContactMaterial("ice", 9.1e9, 0.33)
    own = ContactMaterial("gel", 1e5, 0.49, 0.01)
    assert as_contact_material(own) is own


def test_softer_presets_come_in_the_order_one_expects():
    names = ["steel", "stone", "wood", "rubber", "skin", "carpet", "foam"]
    moduli = [CONTACT_PRESETS[name].youngs_modulus for name in names]
    assert moduli == sorted(moduli, reverse=True)


def test_wrong_contact_materials_are_refused():
    for wrong in ("cheese", None, 3):
        with pytest.raises(fracsim.MaterialError, match="use carpet, ceramic, foam, glass"):
            as_contact_material(wrong)
    for numbers in ((0.0,), (np.inf,), (1e6, 0.5), (1e6, 0.3, 0.0), (1e6, 0.3, np.nan)):
        with pytest.raises(fracsim.MaterialError, match="'gel'"):
            ContactMaterial("gel", *numbers)
