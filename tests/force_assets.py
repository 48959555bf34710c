"""A shipped asset as if a simulator had made it that counts forces, for tests of such severities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import fracsim
from fracsim.fracture.arrays import SimulatorRecord

COMPLIANCE = 2000.0  # of the shape at its first vertex, in units of 1 / (E L); a thin vessel's


def counting_forces(name: str, size: float, force: float) -> fracsim.BreakableAsset:
    """The asset at a size in m, as strong as it takes to break somewhere at about a peak force in N."""
    asset = fracsim.load(name)
    asset = asset.scaled(size / asset.size)
    typical = asset.baked_from.typical_severity
    weaker = replace(asset.material, tensile_strength=force / (typical * size**2))
    shape = COMPLIANCE * np.linspace(1.0, 2.0, asset.vertex_count)
    return replace(
        asset.with_material(weaker),
        arrays=replace(asset.arrays, compliance=shape),
        baked_from=SimulatorRecord("lattice", 0.05 * typical, typical, False, "force"),
    )
