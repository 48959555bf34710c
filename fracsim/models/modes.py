"""The generator itself, precomputed: the row that no model of its own truth can beat, and that learned none of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ..breaking import components, drives
from ..errors import ModelError
from ..generator import Blows, Generator, ModalGenerator, absorb_all
from .base import Body, Float32Array

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Modes:
    """Breaking Good's own run time (Sellán et al. 2022): look the blow's row up, and break what it drives apart."""

    kind: ClassVar[str] = "modes"
    body: Body
    rows: npt.NDArray[np.float64]

    @classmethod
    def of(cls, body: Body, generator: Generator) -> Modes:
        if not isinstance(generator, ModalGenerator):
            raise ModelError(f"{body.surface.name}: its truth is not one of modes that could be looked up")
        return cls(body, generator.rows)

    def predict_labels(self, blows: Blows) -> IntArray:
        """(N, A)"""
        body = self.body
        corners = body.faces[blows.faces]
        field = np.einsum("nkc,nkca->nka", blows.barycentric, self.rows[corners])
        joined = drives(field, blows.directions, blows.severities, body.interfaces) < 1.0
        labels = components(joined, body.interfaces.pairs, len(body.volumes))
        return absorb_all(labels, body.volumes, body.interfaces, body.atoms.crumb_floor)

    def predict(self, blows: Blows) -> Float32Array:
        return self.body.fields(self.predict_labels(blows))

    def predict_nodes(self, blows: Blows) -> Float32Array:
        return self.body.fields(self.predict_labels(blows), nodes=True)
