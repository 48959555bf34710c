"""The default model: which interfaces break, learned in torch and run in numpy (``fracture.predictor``). Offline only.

Baking trains it for every asset; the models ``interfaces`` and ``shared`` are made of its parts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, FloatArray, IntArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import TRAINING_SPLIT, VALIDATION_SPLIT, Samples
from ..fracture.predictor import FieldWeights, field_from_scores, minimax_scores
from ..fracture.rule import components
from ..metrics import ari
from ..simulators.base import Impacts, merge_small_pieces_each
from ..solids.geodesics import CAP
from ..solids.spectrum import Spectrum
from .body import BodyGeometry
from .devices import device_for
from .field_network import ContactPatches, FieldNetwork, frozen
from .model import Model
from .options import TrainingOptions
from .search import Range
from .trainer import Run, train

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


VALIDATION_CHUNK = 2048  # samples whose loss is taken at once, for memory
LEVELS = (0.3, 0.4, 0.5, 0.6, 0.7)  # break scores among which validation chooses what counts as a crack
JUDGED = 1000  # validation samples, at most, that the choice looks at


@dataclass(frozen=True)
class FieldOptions:
    """Hyperparameters of the field model. The budget is in steps, not seconds, so that a seed fixes the model.

    Attributes
    ----------
    width : int
        Of the hidden layers.
    eigenfunctions : int
        Of the solid's Laplacian, see ``solids.spectrum``.
    radii : tuple of float
        Of the patches that these are averaged over, in units of the largest extent.
    prior : bool
        Whether impacts are presumed to spread like heat.
    response : bool
        Whether interfaces have responses of their own, 3 x 3, beside the atoms' potentials. A simulator in which a push
        can pull elsewhere needs them.
    filter_rate : float
        How many times faster the few numbers of the prior and of the rule learn than the free weights, which would
        else learn around them.
    training : TrainingOptions
        Its batch is a number of samples.
    """

    width: int = 64
    eigenfunctions: int = 96
    radii: tuple[float, ...] = (0.05, 0.15)
    prior: bool = True
    response: bool = False
    filter_rate: float = 50.0
    training: TrainingOptions = field(
        default_factory=lambda: TrainingOptions(
            optimiser="adamw", steps=8000, batch=512, rate=1e-3, decay=1e-3, schedule="cosine"
        )
    )


class FieldLearner:
    """What the trainer fits: which interfaces broke, by binary cross-entropy. See ``trainer.Learner``.

    Attributes
    ----------
    module : FieldNetwork
        The network.
    count : int
        Training samples.
    """

    def __init__(self, body: BodyGeometry, samples: Samples, geometry: Spectrum, options: FieldOptions) -> None:
        interfaces = body.interfaces
        self.module = FieldNetwork(
            geometry, interfaces.pairs, interfaces.normals, options.width, options.prior, options.response
        ).to(device_for(options.training))
        self.options = options
        self.training, self.validation = (
            ContactPatches(samples.of_split(split), geometry.coordinates, body.faces)
            for split in (TRAINING_SPLIT, VALIDATION_SPLIT)
        )
        self.count = len(self.training.count)

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """Give the few numbers of the prior a faster rate and no decay."""
        shared, free = self.module.split_parameters()
        return [
            {"params": free, "lr": rate, "weight_decay": self.options.training.decay},
            {"params": shared, "lr": rate * self.options.filter_rate, "weight_decay": 0.0},
        ]

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Work out the loss of training samples."""
        return self.training.loss(self.module, rows)

    def validate(self) -> float:
        """Work out the loss of the validation samples."""
        with torch.no_grad():
            rows = torch.split(torch.arange(len(self.validation.count)), VALIDATION_CHUNK)
            total = sum(float(self.validation.loss(self.module, chunk)) * len(chunk) for chunk in rows)
        return total / len(self.validation.count)


@dataclass(frozen=True, eq=False)
class FieldModel(Model):
    """The default model of a body: break scores, the single linkage over them, and the field that follows.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    net : FieldWeights
        The weights, as an asset carries them.
    """

    kind: ClassVar[str] = "field"
    options_type: ClassVar[type] = FieldOptions
    search_space: ClassVar[Mapping[str, Range]] = {
        "width": Range(32, 512, log=True),
        "eigenfunctions": Range(24, 192, log=True),
        "rate": Range(3e-4, 1e-2, log=True),
    }
    body: BodyGeometry
    net: FieldWeights

    @classmethod
    def fit(
        cls,
        body: BodyGeometry,
        samples: Samples,
        options: FieldOptions | None = None,
        seed: int = 0,
        run: Run | None = None,
    ) -> tuple[Self, dict[str, float]]:
        """Learn from the training split which interfaces break, and from the validation split from which score on.

        Parameters
        ----------
        body : BodyGeometry
            The body.
        samples : Samples
            They say which interfaces broke.
        options : FieldOptions, optional
            Hyperparameters.
        seed : int
            Fixes the weights to the bit on a CPU.
        run : Run, optional
            Progress, checkpoint and log.

        Returns
        -------
        tuple
            The model, and figures of the training, with the level and its validation ARI among them.

        Raises
        ------
        ModelError
            Where the samples do not say which interfaces broke, or the training diverges.
        """
        options = options or FieldOptions()
        if not samples.broken.shape[1]:
            raise ModelError(f"{body.surface.name}: its samples do not say which interfaces broke")
        geometry = body.spectrum(options.eigenfunctions, options.radii)
        torch.manual_seed(seed)
        learner = FieldLearner(body, samples, geometry, options)
        figures = train(learner, options.training, seed, run)
        net = frozen(
            learner.module, body, geometry, float(samples.of_split(TRAINING_SPLIT).severities.sum(axis=1).max())
        )
        model = cls(body, net)
        level, score = model.best_level(samples.of_split(VALIDATION_SPLIT))
        figures |= {"level": level, "validation_ari": score}
        return replace(model, net=replace(net, level=np.array([level], dtype=np.float32))), figures

    def best_level(self, validation: Samples) -> tuple[float, float]:
        """Choose the score from which on an interface counts as broken, by the mean ARI on samples that break the body.

        Parameters
        ----------
        validation : Samples
            Held-out samples, of which the first JUDGED are looked at.

        Returns
        -------
        tuple of (float, float)
            The level among LEVELS, and its mean ARI; nan where no sample breaks the body.
        """
        rows = np.flatnonzero(validation.labels.any(axis=1))[:JUDGED]
        if not len(rows):
            return 0.5, float("nan")
        held_out = validation.take(rows)
        scores = self.break_scores(held_out.impacts)
        truth = held_out.labels[:, self.body.vertex_atom]
        best, best_score = 0.5, -np.inf
        for level in LEVELS:
            labels = self._labels(scores, level)[:, self.body.vertex_atom]
            score = float(np.mean([ari(a, b) for a, b in zip(truth, labels, strict=True)]))
            if score > best_score:
                best, best_score = level, score
        return best, best_score

    def break_scores(self, impacts: Impacts) -> FloatArray:
        """Work out how surely each interface breaks.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N, I)
            Between 0 and 1.
        """
        return np.array(
            [self.net.scores(*impact, self.body.interfaces.pairs) for impact in located(self.body, impacts)]
        )

    def predict_labels(self, impacts: Impacts) -> IntArray:
        """Work out the piece of each atom, (N, A), with no field between."""
        return self._labels(self.break_scores(impacts), float(self.net.level[0]))

    def predict(self, impacts: Impacts) -> Float32Array:
        """Work out the fields at the vertices, (N, V), by single linkage over the break scores."""
        return self._fields(impacts, self.body.distances[:, : len(self.body.vertices)])

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        """Work out the same at vertices and edge midpoints, (N, V + E)."""
        return self._fields(impacts, self.body.distances)

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Lay down the weights."""
        return dict(vars(self.net)), {}

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Make the model again from its weights, where they are of this body."""
        net = FieldWeights(**{field.name: arrays[field.name] for field in fields(FieldWeights)})
        if len(net.coordinates) != len(body.vertices) or len(net.normals) != len(body.interfaces):
            raise ModelError("it is of another body")
        return cls(body, net)

    def _labels(self, scores: FloatArray, level: float) -> IntArray:
        body = self.body
        labels = components(scores < level, body.interfaces.pairs, len(body.volumes))
        return merge_small_pieces_each(labels, body.volumes, body.interfaces, body.atoms.min_piece_volume_fraction)

    def _fields(self, impacts: Impacts, distances: Float32Array) -> Float32Array:
        pairs, count = self.body.interfaces.pairs, len(self.body.volumes)
        parting = (minimax_scores(scores, pairs, count) for scores in self.break_scores(impacts))
        return np.array([field_from_scores(scores, distances, CAP) for scores in parting], dtype=np.float32)


def located(body: BodyGeometry, impacts: Impacts) -> Iterator[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
    """Take impacts one by one, as ``FieldWeights.scores`` does.

    Parameters
    ----------
    body : BodyGeometry
        The body.
    impacts : Impacts
        N impacts.

    Yields
    ------
    tuple
        Corners (K, 3), barycentric coordinates (K, 3), directions (K, 3) and severities (K,) of the contacts that act.
    """
    for k in range(len(impacts)):
        active = np.flatnonzero(impacts.severities[k])
        yield (
            body.faces[impacts.faces[k, active]],
            impacts.barycentric[k, active],
            impacts.directions[k, active],
            impacts.severities[k, active],
        )
