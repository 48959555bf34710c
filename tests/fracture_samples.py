"""What tests of datasets share: a small body, quick options, and a comparison of samples bit by bit."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import trimesh

from fracsim.data.samples import Samples
from fracsim.simulators.registry import SimulatorOptions

SMALL = SimulatorOptions(cells=500, modes=4)


def bar_bell():
    """Two cubes joined by a bar, with edges short enough for a field."""
    parts = [trimesh.creation.box((1, 1, 1)) for _ in range(2)] + [trimesh.creation.box((1.0, 0.3, 0.3))]
    parts[0].apply_translation((-0.8, 0, 0))
    parts[1].apply_translation((0.8, 0, 0))
    mesh = trimesh.boolean.union(parts, engine="manifold")
    return trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.3))


def same(one: Samples, other: Samples) -> None:
    for field in fields(Samples):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), field.name)
