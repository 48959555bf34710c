"""Which interfaces break, learned with no presumption of how an impact spreads, and no field on the way to the pieces.

The thesis's own proposals (section 6.5): labels learned directly, and the distance field as nothing but a read-out,
the least of the known distances to the interfaces that part two pieces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..common.arrays import Float32Array
from ..simulators.base import Impacts
from .field import FieldModel, FieldOptions


@dataclass(frozen=True)
class InterfaceOptions(FieldOptions):
    """As the field model's, with a response of its own for every interface and no heat."""

    prior: bool = False
    response: bool = True
    filter_rate: float = 10.0


class InterfaceModel(FieldModel):
    """Break scores; labels where they exceed the level; the field of these labels."""

    kind: ClassVar[str] = "interfaces"
    options_type: ClassVar[type] = InterfaceOptions

    def predict(self, impacts: Impacts) -> Float32Array:
        return self.body.fields(self.predict_labels(impacts))

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        return self.body.fields(self.predict_labels(impacts), nodes=True)
