"""The generator itself, precomputed: the row that no model of its own truth can beat, and that learned none of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..common.arrays import Float32Array, IntArray
from ..common.errors import ModelError
from ..simulators.base import FractureSimulator, Impacts
from ..simulators.modal import ModalSimulator
from .body import BodyGeometry


@dataclass(frozen=True, eq=False)
class PrecomputedModel:
    """Breaking Good's own run time (Sellán et al. 2022): look the blow's row up, and break what it drives apart."""

    kind: ClassVar[str] = "modes"
    body: BodyGeometry
    generator: ModalSimulator

    @classmethod
    def of(cls, body: BodyGeometry, generator: FractureSimulator) -> PrecomputedModel:
        if not isinstance(generator, ModalSimulator):
            raise ModelError(f"{body.surface.name}: its truth is not one of modes that could be looked up")
        return cls(body, generator)

    def predict_labels(self, blows: Impacts) -> IntArray:
        """(N, A)"""
        return self.generator.fracture(blows).labels

    def predict(self, blows: Impacts) -> Float32Array:
        return self.body.fields(self.predict_labels(blows))

    def predict_nodes(self, blows: Impacts) -> Float32Array:
        return self.body.fields(self.predict_labels(blows), nodes=True)
