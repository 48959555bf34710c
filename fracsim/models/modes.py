"""The generator itself, precomputed: the row that no model of its own truth can beat, and that learned none of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ..errors import ModelError
from ..generator import Blows, Generator, ModalGenerator
from .base import Body, Float32Array

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Modes:
    """Breaking Good's own run time (Sellán et al. 2022): look the blow's row up, and break what it drives apart."""

    kind: ClassVar[str] = "modes"
    body: Body
    generator: ModalGenerator

    @classmethod
    def of(cls, body: Body, generator: Generator) -> Modes:
        if not isinstance(generator, ModalGenerator):
            raise ModelError(f"{body.surface.name}: its truth is not one of modes that could be looked up")
        return cls(body, generator)

    def predict_labels(self, blows: Blows) -> IntArray:
        """(N, A)"""
        return self.generator.fracture(blows).labels

    def predict(self, blows: Blows) -> Float32Array:
        return self.body.fields(self.predict_labels(blows))

    def predict_nodes(self, blows: Blows) -> Float32Array:
        return self.body.fields(self.predict_labels(blows), nodes=True)
