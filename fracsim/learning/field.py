"""Training of the field model, in torch. Offline only; ``field.py`` is what runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, FloatArray, IntArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import Samples
from ..fracture.predictor import FLOOR, FieldWeights, field_from_scores, minimax_scores
from ..fracture.rule import components
from ..metrics import ari
from ..simulators.base import Impacts, merge_small_pieces_each
from ..solids.geodesics import CAP
from ..solids.spectrum import Spectrum
from .body import BodyGeometry
from .model import Model
from .options import TrainingOptions
from .search import Range
from .trainer import Run, device_for, train

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


VALIDATION_CHUNK = 2048  # samples whose loss is taken at once, for memory
LEVELS = (0.3, 0.4, 0.5, 0.6, 0.7)  # break scores among which validation chooses what counts as a crack
JUDGED = 1000  # validation samples, at most, that the choice looks at


@dataclass(frozen=True)
class FieldOptions:
    """width: of the hidden layers. eigenfunctions, radii: ``spectrum``. prior: whether impacts are presumed to spread
    like heat. response: whether interfaces have 3 x 3 responses of their own beside the atoms' potentials, as a truth
    in which pushes pull elsewhere needs. filter_rate: how many times faster the few numbers of the prior and of the
    rule learn than the free weights, which else would learn around them. Steps, not seconds, so that a seed fixes
    the model.
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


class FieldNetwork(torch.nn.Module):
    """The network of FieldModel, with a prior: an impact presses on a patch and spreads from it like heat.

    The skip connection holds, beside free weights, a heat kernel between the contact and the atoms,
    Σ_rk s_r(λ_k) φ_rk(x) φ̄_k(a), of which the filter s is learned. Without it the same training ends at a far
    larger error: benchmarks/prior.py. It has the form of the modal truth, whose numbers it has to find.
    """

    heat: torch.Tensor
    normals: torch.Tensor
    incidence: torch.Tensor

    def __init__(self, geometry: Spectrum, pairs: IntArray, normals: FloatArray, options: FieldOptions) -> None:
        super().__init__()
        modes, atoms = geometry.means.shape
        radii, count = geometry.functions.shape[1], len(pairs)
        inputs = 3 + radii * modes
        self.outputs, self.atoms = atoms + (9 * count if options.response else 0), atoms
        self.first = torch.nn.Linear(inputs, options.width)
        self.second = torch.nn.Linear(options.width, options.width)
        self.last = torch.nn.Linear(options.width, self.outputs)
        torch.nn.init.zeros_(self.last.bias)
        self.free = torch.nn.Parameter(torch.zeros(inputs, self.outputs))
        self.prior = options.prior
        if self.prior:
            torch.nn.init.zeros_(self.last.weight)
        else:
            torch.nn.init.normal_(self.free, std=0.3 * inputs**-0.5)  # at 0 an opening has no gradient
        decline = -np.log1p(geometry.values / 30) - np.log(radii)
        self.log_filter = torch.nn.Parameter(torch.tensor(np.tile(decline, (radii, 1)), dtype=torch.float32))
        self.log_gain = torch.nn.Parameter(torch.zeros(count))
        self.slope = torch.nn.Parameter(torch.tensor(3.0))
        self.offset = torch.nn.Parameter(torch.tensor(0.0))
        self.log_push = torch.nn.Parameter(torch.tensor(-2.0))
        self.log_shear = torch.nn.Parameter(torch.tensor(0.0))
        incidence = np.zeros((atoms, count), dtype=np.float32)
        incidence[pairs[:, 0], np.arange(count)] = -1.0
        incidence[pairs[:, 1], np.arange(count)] = 1.0
        self.register_buffer("heat", torch.tensor(geometry.means, dtype=torch.float32))
        self.register_buffer("normals", torch.tensor(normals.T, dtype=torch.float32))
        self.register_buffer("incidence", torch.tensor(incidence))

    def skip(self) -> torch.Tensor:
        """(D, C) free weights and prior together; positions take no part in the prior."""
        if not self.prior:
            return self.free
        heat = (self.log_filter.exp()[:, :, None] * self.heat).reshape(-1, self.atoms)
        return self.free + torch.nn.functional.pad(heat, (0, self.outputs - self.atoms, 3, 0))

    def forward(
        self, x: torch.Tensor, directions: torch.Tensor, severities: torch.Tensor, row: torch.Tensor, batch: int
    ) -> torch.Tensor:
        """(B, I) logits; x, directions, severities: of the M contacts of a whole batch, row: (M,) whose they are."""
        hidden = x
        for layer in (self.first, self.second):
            hidden = torch.nn.functional.silu(layer(hidden))
        response = (x @ self.skip() + self.last(hidden)) * severities[:, None]
        moved = directions[:, :, None] * response[:, None, : self.atoms]
        opening = x.new_zeros(batch, 3, self.atoms).index_add(0, row, moved) @ self.incidence  # (B, 3, I)
        if self.outputs > self.atoms:
            matrices = response[:, self.atoms :].reshape(len(x), 3, 3, -1)
            turned = (matrices * directions[:, None, :, None]).sum(dim=2)
            opening = opening.index_add(0, row, turned)
        normal = (opening * self.normals).sum(dim=1)
        tangent = torch.relu((opening**2).sum(dim=1) - normal**2)
        squared = (
            torch.relu(normal) ** 2 + self.log_push.exp() * torch.relu(-normal) ** 2 + self.log_shear.exp() * tangent
        )
        return self.slope * (torch.log(squared + FLOOR) + 2.0 * self.log_gain) + self.offset

    def split_parameters(self) -> tuple[list[torch.nn.Parameter], list[torch.nn.Parameter]]:
        """The few numbers of the prior and the rule, and the free weights."""
        shared = [self.log_filter, self.log_gain, self.slope, self.offset, self.log_push, self.log_shear]
        return shared, [p for p in self.parameters() if all(p is not q for q in shared)]


class ContactPatches:
    """Samples as flat lists of the contacts that are there, most samples having one of the most possible."""

    def __init__(self, samples: Samples, coordinates: FloatArray, faces: IntArray) -> None:
        active = samples.severities > 0
        row, slot = np.nonzero(active)
        self.corners = torch.as_tensor(faces[samples.faces[row, slot]])
        self.barycentric = torch.as_tensor(samples.barycentric[row, slot], dtype=torch.float32)
        self.coordinates = torch.as_tensor(coordinates, dtype=torch.float32)
        self.directions = torch.as_tensor(samples.directions[row, slot], dtype=torch.float32)
        self.severities = torch.as_tensor(samples.severities[row, slot], dtype=torch.float32)
        self.count = torch.as_tensor(active.sum(axis=1))
        self.start = torch.cumsum(self.count, 0) - self.count
        self.broken = torch.as_tensor(samples.broken)

    def logits(self, net: torch.nn.Module, chosen: torch.Tensor) -> torch.Tensor:
        count = self.count[chosen]
        row = torch.repeat_interleave(torch.arange(len(chosen)), count)
        first = torch.cumsum(count, 0) - count
        contact = self.start[chosen][row] + torch.arange(len(row)) - first[row]
        corners, barycentric = self.corners[contact], self.barycentric[contact]
        x = torch.stack([barycentric[:, k, None] * self.coordinates[corners[:, k]] for k in range(3)]).sum(dim=0)
        where = x, self.directions[contact], self.severities[contact], row
        device = next(net.parameters()).device
        return net(*(values.to(device) for values in where), len(chosen))

    def loss(self, net: torch.nn.Module, chosen: torch.Tensor) -> torch.Tensor:
        logits = self.logits(net, chosen)
        truth = self.broken[chosen].to(logits.device, torch.float32)
        return torch.nn.functional.binary_cross_entropy_with_logits(logits, truth)


class FieldLearner:
    """What the trainer needs: which interfaces broke, by binary cross-entropy."""

    def __init__(self, body: BodyGeometry, samples: Samples, geometry: Spectrum, options: FieldOptions) -> None:
        interfaces = body.interfaces
        self.module = FieldNetwork(geometry, interfaces.pairs, interfaces.normals, options).to(
            device_for(options.training)
        )
        self.options = options
        self.training, self.validation = (
            ContactPatches(samples.of_split(k), geometry.coordinates, body.faces) for k in range(2)
        )
        self.count = len(self.training.count)

    def groups(self, rate: float) -> list[dict[str, Any]]:
        shared, free = self.module.split_parameters()
        return [
            {"params": free, "lr": rate, "weight_decay": self.options.training.decay},
            {"params": shared, "lr": rate * self.options.filter_rate, "weight_decay": 0.0},
        ]

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return self.training.loss(self.module, rows)

    def validate(self) -> float:
        with torch.no_grad():
            rows = torch.split(torch.arange(len(self.validation.count)), VALIDATION_CHUNK)
            total = sum(float(self.validation.loss(self.module, chunk)) * len(chunk) for chunk in rows)
        return total / len(self.validation.count)


@dataclass(frozen=True, eq=False)
class FieldModel(Model):
    """The default model of a body: its break scores, the single linkage over them, and the field that follows."""

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
        """Learn from samples.part(0) which interfaces break, and from samples.part(1) from which score on."""
        options = options or FieldOptions()
        if not samples.broken.shape[1]:
            raise ModelError(f"{body.surface.name}: its samples do not say which interfaces broke")
        geometry = body.spectrum(options.eigenfunctions, options.radii)
        torch.manual_seed(seed)
        learner = FieldLearner(body, samples, geometry, options)
        figures = train(learner, options.training, seed, run)
        net = frozen(learner.module, body, geometry, float(samples.of_split(0).severities.sum(axis=1).max()))
        model = cls(body, net)
        level, score = model.best_level(samples.of_split(1))
        figures |= {"level": level, "validation_ari": score}
        return replace(model, net=replace(net, level=np.array([level], dtype=np.float32))), figures

    def best_level(self, validation: Samples) -> tuple[float, float]:
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
        """(N, I)"""
        return np.array(
            [self.net.scores(*impact, self.body.interfaces.pairs) for impact in located(self.body, impacts)]
        )

    def predict_labels(self, impacts: Impacts) -> IntArray:
        """(N, A) the pieces, with no field between."""
        return self._labels(self.break_scores(impacts), float(self.net.level[0]))

    def predict(self, impacts: Impacts) -> Float32Array:
        return self._fields(impacts, self.body.distances[:, : len(self.body.vertices)])

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        """(N, V + E): at the edge midpoints as well."""
        return self._fields(impacts, self.body.distances)

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        return dict(vars(self.net)), {}

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
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
    """The arguments of FieldModel.scores, impact by impact."""
    for k in range(len(impacts)):
        active = np.flatnonzero(impacts.severities[k])
        yield (
            body.faces[impacts.faces[k, active]],
            impacts.barycentric[k, active],
            impacts.directions[k, active],
            impacts.severities[k, active],
        )


def frozen(net: FieldNetwork, body: BodyGeometry, geometry: Spectrum, severity: float) -> FieldWeights:
    """The weights as numpy runs them."""

    def array(tensor: torch.Tensor) -> npt.NDArray[np.float32]:
        return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)

    weights = {}
    for k, layer in enumerate((net.first, net.second, net.last)):
        weights[f"weights_{k}"] = array(layer.weight.T)
        weights[f"biases_{k}"] = array(layer.bias)
    ones = torch.ones(len(body.interfaces), device=net.slope.device)
    return FieldWeights(
        coordinates=geometry.coordinates.astype(np.float32),
        skip=array(net.skip()),
        **weights,
        slope=array(net.slope * ones),
        offset=array(net.offset + 2.0 * net.slope * net.log_gain),
        push=array(net.log_push.exp() * ones),
        shear=array(net.log_shear.exp() * ones),
        normals=body.interfaces.normals.astype(np.float32),
        severity=np.array([severity], dtype=np.float32),
        level=np.array([0.5], dtype=np.float32),
    )
