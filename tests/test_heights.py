"""The script that finds from what heights things break: its arithmetic, and a coarse mug."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from fracsim.common.material import PRESETS
from fracsim.solids.surface import read_surface

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def heights():
    spec = importlib.util.spec_from_file_location("heights", ROOT / "benchmarks" / "heights.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["heights"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["heights"]


@pytest.mark.parametrize("name", ["sequential", "structural"])
def test_a_mug_cracks_before_it_chips_before_it_breaks_and_later_on_rubber(heights, name):
    found = heights.case(name, "mug", "glass", 2, 80)
    for floor in heights.FLOORS:
        events = np.array([found["heights"][floor][event] for event in ("crack", "chip", "broken")])
        assert (events > 0.0).all()
        assert (np.diff(events, axis=0) >= -1e-9 * events[:-1]).all()
    stone, rubber = (np.array(found["heights"][floor]["crack"]) for floor in ("stone", "rubber"))
    assert (rubber > 2.0 * stone).all()
    assert "mug" in heights.table([found], [])


def test_heights_and_severities_are_each_other_s_inverse(heights):
    simulator = heights.make("sequential", read_surface(ROOT / "meshes" / "rod.obj"), PRESETS["ceramic"], 0.3, 50)
    drops = heights.falls(simulator, heights.directions(5, 0))
    assert (drops.masses > 0.0).all()
    assert (drops.masses <= simulator.cells.volumes.sum() * (1.0 + 1e-9)).all()
    for floor in heights.FLOORS:
        meets = heights.Floor(PRESETS["ceramic"], 0.3, floor)
        severities = meets.severities(0.4, drops)
        assert meets.heights(severities, drops) == pytest.approx(0.4, rel=1e-6)
        assert meets.heights(np.full(5, np.inf), drops) == pytest.approx(np.inf)
