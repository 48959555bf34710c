"""The door behind which the truth stands: impacts go in, and which parts of a body stay together comes out.

``Generator`` is the interface that datasets, training and baking rely on; ``ModalGenerator`` stands behind it by
default. ``elastic.ElasticGenerator`` drives the same atoms by another physics, ``radial.RadialGenerator`` has none of
them. Offline only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..fracture.rule import Interfaces, components, merge_small_pieces, weakest_cut
from ..solids.solid import Solid, shared_faces
from ..solids.surface import Surface


@dataclass(frozen=True, eq=False)
class Impacts:
    """N impacts on a surface, each of up to K contacts acting together.

    faces: (N, K) and barycentric: (N, K, 3), where on the surface; directions: (N, K, 3), unit.
    severities: (N, K), impulse / (mass * breaking velocity), 0 where there is no contact.
    """

    faces: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray

    def __len__(self) -> int:
        return len(self.faces)

    def times(self, factor: FloatArray) -> Impacts:
        """The same impacts, each ``factor`` (N,) as severe."""
        return Impacts(self.faces, self.barycentric, self.directions, self.severities * factor[:, None])


@dataclass(frozen=True, eq=False)
class Response:
    """What N impacts do.

    labels: (N, P), the piece of each part of the simulator's body, from 0; all 0 where nothing parts.
    broken: (N, I), the interfaces between neighbouring parts that gave way, where the simulator knows them; one
    that broke within a piece, its sides being joined another way, parts nothing.
    """

    labels: IntArray
    broken: BoolArray | None = None


class FractureSimulator(Protocol):
    """A truth about how one body breaks. Deterministic: an impact has one answer.

    surface: of largest extent 1, with V vertices. parts: P parts whose outside is that surface exactly; labels
    speak of them, and cracks run where they meet. fixed_cracks: whether the parts are so few that distances to
    each of their interfaces are worth keeping (pieces are unions of few parts, not free shapes among many).
    A simulator of fixed cracks may also have ``cells``, a finer Solid, and ``atom``, the part of each of its cells;
    baking then sees the body through them.
    """

    @property
    def surface(self) -> Surface: ...

    @property
    def cells(self) -> Solid: ...

    @property
    def fixed_cracks(self) -> bool: ...

    def thresholds(self, impacts: Impacts) -> FloatArray:
        """(N,) the factor by which each impact's severities have to be multiplied for it just to part the body."""
        ...

    def fracture(self, impacts: Impacts) -> Response: ...


def interfaces_between(parts: Solid) -> Interfaces:
    """Where neighbouring parts of a solid meet."""
    pairs, areas, vectors = shared_faces(parts.triangles, parts.sides, parts.points)
    projected = np.linalg.norm(vectors, axis=1)
    # A crack that folds back on itself may have no mean direction; any will do, its projected area being 0.
    normals = vectors / np.maximum(projected, 1e-300)[:, None]
    return Interfaces(pairs, areas, normals, projected)


def critical_load_factor(drives: FloatArray, parts: Solid, interfaces: Interfaces) -> FloatArray:
    """(N,) the factors on drives (N, I) at which the parts first fall apart."""
    return 1.0 / weakest_cut(drives, interfaces.pairs, len(parts.volumes))


def pieces_from_broken(
    broken: BoolArray, parts: Solid, interfaces: Interfaces, min_piece_volume_fraction: float
) -> Response:
    """What is left when interfaces give way: broken (N, I)."""
    labels = components(~broken, interfaces.pairs, len(parts.volumes))
    return Response(merge_small_pieces_each(labels, parts.volumes, interfaces, min_piece_volume_fraction), broken)


def merge_small_pieces_each(labels: IntArray, volumes: FloatArray, interfaces: Interfaces, floor: float) -> IntArray:
    """``breaking.absorb_crumbs`` over the rows of labels (N, P)."""
    share = volumes / volumes.sum()
    if share.min() >= floor:  # then no piece can be a crumb
        return labels
    return np.array([merge_small_pieces(row, share, interfaces, floor) for row in labels]).reshape(labels.shape)
