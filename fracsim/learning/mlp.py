"""The thesis's best model (section 4.4.1): one perceptron that is asked at every vertex by itself. Offline only.

Reached by its name in MODELS.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, FloatArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import Samples
from ..geometry.sampling import SurfacePoints
from ..metrics import amae
from ..simulators.base import Impacts
from ..solids.geodesics import CAP
from .body import BodyGeometry
from .model import Model, read_numbers
from .options import TrainingOptions
from .search import Range
from .targets import Targets, amae_loss
from .trainer import Run, train
from .whole_field import POINT_CHUNK, VALIDATION_IMPULSES, ImpulseInputs, check_sizes, load_weights, start_network

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


POINTS = ("vertices", "surface")
VALIDATION_VERTICES = 64  # of each validation impulse: enough for a mean over 200 impulses


@dataclass(frozen=True)
class MLPOptions:
    """Hyperparameters of the perceptron; the defaults are the thesis's (Table 5.1).

    Attributes
    ----------
    width, layers : int
        Of the hidden layers.
    severity : bool
        Whether the impulse's strength is an input; the thesis's own model has none.
    points : str
        Where training points are: at "vertices", or uniform over the "surface".
    filled : float
        See ``targets.amae_loss``.
    training : TrainingOptions
        Its batch is a number of points (thesis, section 4.8).

    Raises
    ------
    ModelError
        Where a value is out of range.
    """

    width: int = 704
    layers: int = 7
    severity: bool = True
    points: str = "vertices"
    filled: float = 0.0
    training: TrainingOptions = field(default_factory=lambda: TrainingOptions(epochs=200, batch=4096))

    def __post_init__(self) -> None:
        check_sizes(self, ("width", "layers"))
        if self.points not in POINTS:
            raise ModelError(f"unknown points {self.points!r}; use one of {', '.join(POINTS)}")


class Perceptron(torch.nn.Module):
    """Linear layers of one width, each with layer normalisation and ReLU, and a single output.

    Parameters
    ----------
    inputs : int
        Numbers that go in.
    width, layers : int
        Of the hidden layers.
    """

    def __init__(self, inputs: int, width: int, layers: int) -> None:
        super().__init__()
        hidden: list[torch.nn.Module] = []
        for k in range(layers):
            hidden += [torch.nn.Linear(width if k else inputs, width), torch.nn.LayerNorm(width), torch.nn.ReLU()]
        self.hidden = torch.nn.Sequential(*hidden)
        self.last = torch.nn.Linear(width, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Answer inputs (B, inputs) with distances (B,)."""
        x = self.hidden(x)
        with torch.autocast(x.device.type, enabled=False):  # a distance of 0.3 to 8 bits would be 0.001 off
            return self.last(x.float())[:, 0]


class MLP(Model):
    """A vertex's coordinates and the impulse go in, the vertex's distance comes out.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    net : Perceptron
        The network.
    inputs : ImpulseInputs
        How impulses are put to it.
    options : MLPOptions
        Hyperparameters.
    """

    kind: ClassVar[str] = "mlp"
    options_type: ClassVar[type[MLPOptions]] = MLPOptions
    # Thesis, section 5.2.1.
    search_space: ClassVar[Mapping[str, Range]] = {"width": Range(32, 1024), "layers": Range(1, 20)}
    slow: ClassVar[bool] = True

    def __init__(self, body: BodyGeometry, net: Perceptron, inputs: ImpulseInputs, options: MLPOptions) -> None:
        self.body, self.net, self.inputs, self.options = body, net, inputs, options

    @classmethod
    def fit(
        cls, body: BodyGeometry, samples: Samples, options: MLPOptions, seed: int, run: Run | None = None
    ) -> tuple[Self, dict[str, float]]:
        """Learn from the training split and watch the validation split, see ``Model.fit``."""
        device, splits, inputs = start_network(body, samples, options, seed)
        net = Perceptron(3 + inputs.count, options.width, options.layers).to(device)
        model = cls(body, net, inputs, options)
        return model, train(PointLearner(model, *splits, device), options.training, seed, run)

    def on(self, body: BodyGeometry) -> Self:
        """Ask the same network about another mesh of the same shape.

        Parameters
        ----------
        body : BodyGeometry
            With other vertices.

        Returns
        -------
        MLP
            The model.
        """
        return type(self)(body, self.net, self.inputs, self.options)

    def predict(self, impacts: Impacts) -> Float32Array:
        """Work out the fields at the vertices, (N, V)."""
        return self._at(self.body.vertices, impacts)

    def predict_nodes(self, impacts: Impacts) -> Float32Array:
        """Work out the same at vertices and edge midpoints, (N, V + E)."""
        return self._at(self.body.nodes, impacts)

    def _at(self, points: FloatArray, impacts: Impacts) -> Float32Array:
        device = next(self.net.parameters()).device
        where = torch.as_tensor(points, dtype=torch.float32, device=device)
        impulses = torch.as_tensor(self.inputs(self.body, impacts), device=device)
        result = np.empty(len(impacts) * len(points), dtype=np.float32)
        with torch.inference_mode():
            for start in range(0, len(result), POINT_CHUNK):
                pair = torch.arange(start, min(start + POINT_CHUNK, len(result)), device=device)
                row = torch.div(pair, len(points), rounding_mode="floor")
                x = torch.cat([where[pair - row * len(points)], impulses[row]], dim=1)
                result[start : start + len(pair)] = self.net(x).clamp(0.0, CAP).cpu().numpy()
        return result.reshape(len(impacts), len(points))

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Lay down the weights and what the network was made with."""
        arrays = {name: value.cpu().numpy() for name, value in self.net.state_dict().items()}
        return arrays, {"inputs": asdict(self.inputs), "width": self.options.width, "layers": self.options.layers}

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Make the model again from its weights."""
        inputs = read_numbers(ImpulseInputs, numbers["inputs"])
        options = replace(MLPOptions(), width=numbers["width"], layers=numbers["layers"], severity=inputs.severity)
        net = Perceptron(3 + inputs.count, options.width, options.layers)
        load_weights(net, arrays)
        return cls(body, net, inputs, options)


class PointLearner:
    """What the trainer fits: rows are pairs of a sample and a vertex, or as many points anywhere on the surface.

    A field bends at a crack, so between vertices it is read from the quarter triangle around the point: linear between
    the corners and edge midpoints there, which is exact except where a crack crosses that quarter.

    Attributes
    ----------
    module : Perceptron
        The network.
    count : int
        Training samples times vertices.
    """

    def __init__(self, model: MLP, samples: Samples, validation: Samples, device: torch.device) -> None:
        body = model.body
        self.model, self.module, self.device = model, model.net, device
        self.vertices = len(body.vertices)
        self.count = len(samples) * self.vertices
        self.impulses = torch.as_tensor(model.inputs(body, samples.impacts), device=device)
        nodes, fine, _, _ = body.split
        self.nodes = torch.as_tensor(nodes, dtype=torch.float32, device=device)
        self.anywhere = model.options.points == "surface"
        self.targets = Targets(body, samples.labels, device, nodes=self.anywhere)
        share = SurfacePoints(body.vertices, body.faces).share
        self.below = torch.as_tensor(np.cumsum(share))
        self.quarters = torch.as_tensor(fine.reshape(-1, 4, 3))  # (F, 4, 3): at the corners, and the middle one
        held_out = validation.take(slice(VALIDATION_IMPULSES))
        rng = np.random.default_rng(0)
        self.asked = rng.integers(0, self.vertices, (len(held_out), min(VALIDATION_VERTICES, self.vertices)))
        self.held_out = torch.as_tensor(model.inputs(body, held_out.impacts), device=device)
        self.truth = np.take_along_axis(body.fields(held_out.labels), self.asked, axis=1)

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """Put all weights in one group."""
        return [{"params": list(self.module.parameters())}]

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Work out the loss of points, see ``targets.amae_loss``."""
        sample = torch.div(rows, self.vertices, rounding_mode="floor")
        if self.anywhere:
            node, weight = self.draw(len(rows), generator)
        else:
            node, weight = (rows - sample * self.vertices)[:, None], torch.ones(len(rows), 1)
        sample, node, weight = sample.to(self.device), node.to(self.device), weight.to(self.device)
        truth = (self.targets(sample, node) * weight).sum(dim=1)
        where = (self.nodes[node] * weight[:, :, None]).sum(dim=1)
        predicted = self.module(torch.cat([where, self.impulses[sample]], dim=1))
        return amae_loss(predicted, truth, self.model.options.filled)

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw points uniform over the area.

        Parameters
        ----------
        count : int
            Points, B.
        generator : Generator
            The source of chance.

        Returns
        -------
        nodes : Tensor of int64, shape (B, 3)
            The nodes around each point.
        weights : Tensor, shape (B, 3)
            Its barycentric coordinates between them.
        """
        u = torch.rand(count, 3, generator=generator)
        face = torch.searchsorted(self.below, u[:, 0].double()).clamp(max=len(self.below) - 1)
        root = u[:, 1].sqrt()
        bary = torch.stack([1 - root, root * (1 - u[:, 2]), root * u[:, 2]], dim=1)
        largest, corner = bary.max(dim=1)
        outer = largest > 0.5
        # A quarter is half as wide: beside a corner coordinates double; the middle one is upside down, its nodes
        # x, y and z lying across from c, a and b.
        inner = 1 - 2 * bary[:, [2, 0, 1]]
        doubled = 2 * bary
        doubled[torch.arange(count), corner] -= 1
        return (
            self.quarters[face, torch.where(outer, corner, 3)],
            torch.where(outer[:, None], doubled, inner),
        )

    def validate(self) -> float:
        """Work out the AMAE at some vertices of the validation samples."""
        where = self.nodes[torch.as_tensor(self.asked, device=self.device)]  # (N, P, 3)
        predicted = [
            self.module(torch.cat([points, impulse.expand(len(points), -1)], dim=1)).clamp(0.0, CAP).cpu().numpy()
            for points, impulse in zip(where, self.held_out, strict=True)
        ]
        return amae(self.truth, np.array(predicted))
