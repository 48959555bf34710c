"""Which interfaces break, learned with no presumption of how an impact spreads, and no field on the way to the pieces.

These are the thesis's own proposals (section 6.5): labels are learned directly, and the distance field is only a
read-out, the least of the known distances to the interfaces between two pieces. Reached by its name in MODELS.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..common.arrays import Float32Array
from ..simulators.base import Impacts
from .field import FieldModel, FieldOptions


@dataclass(frozen=True)
class InterfaceOptions(FieldOptions):
    """Options as of the field model, with a response of its own for every interface, and no heat."""

    prior: bool = False
    response: bool = True
    filter_rate: float = 10.0


class InterfaceModel(FieldModel):
    """Break scores, labels where they exceed the level, and the field of these labels.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    net : FieldWeights
        The weights.
    """

    kind: ClassVar[str] = "interfaces"
    options_type: ClassVar[type] = InterfaceOptions

    def predict(self, impacts: Impacts) -> Float32Array:
        """Work out the fields of the predicted labels, (N, V)."""
        return self.body.fields(self.predict_labels(impacts))

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        """Work out the same at vertices and edge midpoints, (N, V + E)."""
        return self.body.fields(self.predict_labels(impacts), nodes=True)
