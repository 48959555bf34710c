"""The modal simulator's own answers, looked up: the row of an evaluation that no model learned from it can beat.

Evaluation and tests use it; it learns nothing and is kept in no file.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..common.arrays import Float32Array, IntArray
from ..common.errors import ModelError
from ..simulators.base import FractureSimulator, Impacts
from ..simulators.modal import ModalSimulator
from .body import BodyGeometry
from .model import Predictor


@dataclass(frozen=True, eq=False)
class PrecomputedModel(Predictor):
    """The run time of Breaking Good: look the impact's row up, and break the interfaces that it loads enough.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    simulator : ModalSimulator
        Its simulator.

    References
    ----------
    Sellán et al., Breaking Good: Fracture Modes for Realtime Destruction, 2022.
    """

    body: BodyGeometry
    simulator: ModalSimulator

    @classmethod
    def of(cls, body: BodyGeometry, simulator: FractureSimulator) -> PrecomputedModel:
        """Make the model of a body's simulator.

        Parameters
        ----------
        body : BodyGeometry
            The body.
        simulator : FractureSimulator
            Its simulator.

        Returns
        -------
        PrecomputedModel
            The model.

        Raises
        ------
        ModelError
            Where the simulator is not the modal one, whose answers alone can be looked up.
        """
        if not isinstance(simulator, ModalSimulator):
            raise ModelError(f"{body.surface.name}: only the modal simulator's answers can be looked up")
        return cls(body, simulator)

    def predict_labels(self, impacts: Impacts) -> IntArray:
        """Look up the piece of each atom, (N, A)."""
        return self.simulator.fracture(impacts).labels

    def predict(self, impacts: Impacts) -> Float32Array:
        """Work out the fields of the pieces at the vertices, (N, V)."""
        return self.body.fields(self.predict_labels(impacts))

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        """Work out the same at vertices and edge midpoints, (N, V + E)."""
        return self.body.fields(self.predict_labels(impacts), nodes=True)
