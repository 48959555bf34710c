"""The simulator itself, precomputed: the row that no model of its own truth can beat, and that learned none of it."""

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
    """Breaking Good's own run time (Sellán et al. 2022): look the impact's row up, and break what it drives apart."""

    kind: ClassVar[str] = "modes"
    body: BodyGeometry
    simulator: ModalSimulator

    @classmethod
    def of(cls, body: BodyGeometry, simulator: FractureSimulator) -> PrecomputedModel:
        if not isinstance(simulator, ModalSimulator):
            raise ModelError(f"{body.surface.name}: its truth is not one of modes that could be looked up")
        return cls(body, simulator)

    def predict_labels(self, impacts: Impacts) -> IntArray:
        """(N, A)"""
        return self.simulator.fracture(impacts).labels

    def predict(self, impacts: Impacts) -> Float32Array:
        return self.body.fields(self.predict_labels(impacts))

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        return self.body.fields(self.predict_labels(impacts), nodes=True)
