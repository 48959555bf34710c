"""Materials: every property has a range of its own, and a message that states it."""

from __future__ import annotations

import numpy as np
import pytest

import fracsim
from fracsim.common.material import PRESETS, as_material

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
