"""TODO fracture.file."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .arrays import AssetArrays
from .predictor import FieldWeights

FORMAT = 3
SUFFIX = ".frac"


def contradictions(arrays: AssetArrays, model: FieldWeights) -> Iterator[str]:
    """What cannot be, so that no later question trips over it: indices out of range, sizes that do not agree."""
    vertices, atoms, interfaces = *arrays.impact_field.shape, len(arrays.pairs)
    for name, limit in (
        ("faces", vertices),
        ("triangles", len(arrays.points)),
        ("sides", atoms),
        ("pairs", atoms),
        ("interface_vertices", vertices),
        ("hull_atoms", atoms),
    ):
        values = getattr(arrays, name)
        lowest = -1 if name in ("sides", "interface_vertices") else 0
        if values.size and not (lowest <= values.min() and values.max() < limit):
            yield f"{name} points outside its range"
    if vertices > len(arrays.points) or len(model.coordinates) != vertices:
        yield "the numbers of vertices do not agree"
    if (
        not interfaces
        == len(arrays.distances)
        == len(arrays.interface_vertices)
        == len(arrays.normals)
        == len(model.slope)
    ):
        yield "the numbers of interfaces do not agree"
    if arrays.distances.shape != (interfaces, vertices):
        yield "the distances do not fit the vertices"
    for kind in ("hull", "body"):
        points, faces, sizes = (getattr(arrays, f"{kind}_{what}") for what in ("points", "faces", "sizes"))
        if not np.array_equal(sizes.sum(axis=0), (len(points), len(faces))):
            yield "the convex parts are not of the sizes stated"
