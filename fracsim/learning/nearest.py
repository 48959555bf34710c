"""The row without learning: an impact does what the most similar training impulse did. No network.

Impulses are compared by where they act and which way, both in the mean over contacts, and by how severe they are.
Reached by its name in MODELS; ``asset_figures`` measures assets against it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..common.arrays import Float32Array, IntArray
from ..common.errors import ModelError
from ..data.samples import TRAINING_SPLIT, VALIDATION_SPLIT, Samples
from ..metrics import ari
from ..simulators.base import Impacts
from .body import BodyGeometry
from .model import Model
from .search import Range
from .whole_field import resultant

if TYPE_CHECKING:
    from .trainer import Run


POSITIONS, SEVERITIES = (2.0, 4.0, 8.0), (0.3, 0.7, 1.5)  # weights to choose from
JUDGES = 300  # validation impulses that choose


@dataclass(frozen=True)
class NearestOptions:
    """Weights of a difference in position and in severity, against one of 1 in direction.

    Attributes
    ----------
    position : float or None
        For each unit of the largest extent; None for the best of POSITIONS on validation impulses.
    severity : float or None
        For each unit of the logarithm of severity; None for the best of SEVERITIES likewise.

    Raises
    ------
    ModelError
        Where a value is negative or not finite.
    """

    position: float | None = None
    severity: float | None = None

    def __post_init__(self) -> None:
        for name in ("position", "severity"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise ModelError(f"{name} must be finite and at least 0, got {value}")


class Nearest(Model):
    """The training impulses and what each did.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    keys : ndarray of float32, shape (M, 7)
        ``whole_field.resultant`` of the training impulses.
    fractures : ndarray of int64, shape (U, A)
        The different labels of atoms that they left.
    fracture : ndarray of int64, shape (M,)
        Which of these each left.
    options : NearestOptions
        With both weights.

    Raises
    ------
    ModelError
        Where a weight is None.
    """

    kind: ClassVar[str] = "nearest"
    options_type: ClassVar[type[NearestOptions]] = NearestOptions
    search_space: ClassVar[Mapping[str, Range]] = {
        "position": Range(0.5, 30.0, log=True),
        "severity": Range(0.05, 5.0, log=True),
    }

    def __init__(
        self, body: BodyGeometry, keys: Float32Array, fractures: IntArray, fracture: IntArray, options: NearestOptions
    ) -> None:
        if options.position is None or options.severity is None:
            raise ModelError("the weights of position and severity must be given")
        self.body, self.keys, self.fractures, self.fracture, self.options = body, keys, fractures, fracture, options
        self.weights = np.array([options.position] * 3 + [1.0] * 3 + [options.severity])
        self.tree = cKDTree(keys * self.weights)

    @classmethod
    def fit(
        cls, body: BodyGeometry, samples: Samples, options: NearestOptions, seed: int, run: Run | None = None
    ) -> tuple[Self, dict[str, float]]:
        """Remember the training samples, and choose weights on the validation samples; the seed makes no difference.

        Parameters
        ----------
        body : BodyGeometry
            The body.
        samples : Samples
            What is remembered.
        options : NearestOptions
            Weights.
        seed : int
            Unused.
        run : Run, optional
            Progress.

        Returns
        -------
        tuple
            The model, and figures: rows, fractures and the weights.

        Raises
        ------
        ModelError
            Where there are no training samples, or none to choose weights by.
        """
        train, validation = samples.of_split(TRAINING_SPLIT), samples.of_split(VALIDATION_SPLIT)
        if not len(train):
            raise ModelError("there is nothing to remember; make more samples with: fracsim dataset make")
        keys = resultant(train.impacts, body.surface).astype(np.float32)
        fractures, fracture = np.unique(train.labels, axis=0, return_inverse=True)
        judges = validation.take(np.flatnonzero(validation.labels.any(axis=1))[:JUDGES])
        truth = judges.labels[:, body.vertex_atom]
        grid = list(
            itertools.product(
                POSITIONS if options.position is None else (options.position,),
                SEVERITIES if options.severity is None else (options.severity,),
            )
        )
        if len(grid) > 1 and not len(judges):
            raise ModelError("no validation impulse breaks the body; make more samples, or give position and severity")
        best: tuple[float, Self] | None = None
        for done, weights in enumerate(grid):
            model = cls(body, keys, fractures, fracture.reshape(-1), NearestOptions(*weights))
            score = 0.0
            if len(grid) > 1:
                guess = model.predict_labels(judges.impacts)[:, body.vertex_atom]
                score = float(np.mean([ari(a, b) for a, b in zip(truth, guess, strict=True)]))
            if best is None or score > best[0]:
                best = score, model
            if run is not None:
                run.progress((done + 1) / len(grid))
        assert best is not None
        figures = {"rows": float(len(train)), "fractures": float(len(fractures))}
        return best[1], {**figures, "position": float(best[1].weights[0]), "severity": float(best[1].weights[-1])}

    def predict_labels(self, impacts: Impacts) -> IntArray:
        """Look up the piece of each atom, (N, A)."""
        _, row = self.tree.query(resultant(impacts, self.body.surface).astype(np.float32) * self.weights)
        return self.fractures[self.fracture[row]]

    def predict(self, impacts: Impacts) -> Float32Array:
        """Work out the fields of these labels at the vertices, (N, V)."""
        return self.body.fields(self.predict_labels(impacts))

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        """Work out the same at vertices and edge midpoints, (N, V + E)."""
        return self.body.fields(self.predict_labels(impacts), nodes=True)

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Lay down the keys and fractures, in small integers."""
        small = np.min_scalar_type(int(self.fractures.max(initial=0)))
        arrays = {
            "keys": self.keys,
            "fractures": self.fractures.astype(small),
            "fracture": self.fracture.astype(np.int32),
        }
        return arrays, {"position": self.options.position, "severity": self.options.severity}

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Make the model again, where its fractures are of this body's atoms."""
        fractures, fracture = (arrays[name].astype(np.int64) for name in ("fractures", "fracture"))
        if fractures.shape[1:] != (len(body.volumes),):
            raise ModelError(f"its fractures are of {fractures.shape[1:]} atoms, the body has {len(body.volumes)}")
        return cls(body, arrays["keys"], fractures, fracture, NearestOptions(numbers["position"], numbers["severity"]))
