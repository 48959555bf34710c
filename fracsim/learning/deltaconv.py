"""The thesis's graph convolutions (sections 3.1 and 4.4.2): DeltaConv (Wiersma et al. 2022) made to regress a field.

Scalars and tangent vectors at the vertices are mixed by small perceptrons that see how each changes along the surface
(``calculus``). Features are (V, B, C) and (V, 2, B, C): the B impulses of a batch are columns of one product. Offline
only; reached by its name in MODELS.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, FloatArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import Samples
from ..metrics import amae
from ..simulators.base import Impacts
from ..solids.geodesics import CAP
from .body import BodyGeometry
from .calculus import Operators, calculus, rotated, tangent_frames
from .model import Model, read_numbers
from .options import TrainingOptions, with_training
from .search import Range
from .targets import Targets, amae_loss
from .trainer import Run, train
from .whole_field import ImpulseInputs, check_sizes, load_weights, start_network

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


IMPULSE_CHUNK = 4  # impulses that are asked about together
VALIDATION_IMPULSES = 60  # a whole mesh each, so few of them
TINY = 1e-12  # added to a squared length, so that its root has a derivative at 0
HEAD = (256, 256, 128)  # widths, of the segmentation head that the thesis keeps


@dataclass(frozen=True)
class DeltaConvOptions:
    """Hyperparameters of the network; the defaults are the thesis's (Table 5.6).

    Attributes
    ----------
    layers, width : int
        Of the convolutions.
    depth : int
        Of the perceptrons within them.
    embedding : int
        Numbers that sum up a whole field.
    neighbours : int
        Of a vertex, itself not counted.
    kernel : float
        Width of the gradient's Gaussian, in mean distances between neighbours.
    dropout : float
        In the head, at least 0 and below 1.
    severity : bool
        Whether the impulse's strength is an input; the thesis's own model has none.
    filled : float
        See ``targets.amae_loss``.
    training : TrainingOptions
        Its batch is a number of impulses. A single one is the same at every vertex, which batch normalisation takes
        away.

    Raises
    ------
    ModelError
        Where a value is out of range.
    """

    layers: int = 2
    width: int = 292
    depth: int = 1
    embedding: int = 343
    neighbours: int = 5
    kernel: float = 2.0
    dropout: float = 0.5
    severity: bool = True
    filled: float = 0.0
    training: TrainingOptions = field(default_factory=lambda: TrainingOptions(epochs=100, batch=5))

    def __post_init__(self) -> None:
        check_sizes(self, ("layers", "width", "depth", "embedding", "neighbours"))
        if not (math.isfinite(self.kernel) and self.kernel > 0):
            raise ModelError(f"kernel must be finite and above 0, got {self.kernel}")
        if not 0 <= self.dropout < 1:
            raise ModelError(f"dropout must be at least 0 and below 1, got {self.dropout}")


class ScalarLayers(torch.nn.Module):
    """Linear layers with batch normalisation and ReLU, on scalars (..., C).

    Parameters
    ----------
    *widths : int
        Numbers of features, from input to output.
    """

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.linear = torch.nn.ModuleList(torch.nn.Linear(a, b, bias=False) for a, b in itertools.pairwise(widths))
        self.norm = torch.nn.ModuleList(torch.nn.BatchNorm1d(width) for width in widths[1:])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Take features (..., first width) to (..., last width)."""
        for linear, norm in zip(self.linear, self.norm, strict=True):
            x = linear(x)
            x = torch.relu(norm(x.reshape(-1, x.shape[-1])).reshape(x.shape))
        return x


class VectorLayers(torch.nn.Module):
    """Layers on tangent vectors (V, 2, B, C) that do not depend on the choice of frames.

    Each layer mixes vectors with vectors rotated by 90 degrees, and acts on their lengths alone.

    Parameters
    ----------
    *widths : int
        Numbers of features, from input to output.
    """

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.linear = torch.nn.ModuleList(
            torch.nn.Linear(a, 2 * b if k == 0 else b, bias=False)
            for k, (a, b) in enumerate(itertools.pairwise(widths))
        )
        self.norm = torch.nn.ModuleList(torch.nn.BatchNorm1d(width) for width in widths[1:])

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """Take features (V, 2, B, first width) to (V, 2, B, last width)."""
        for k, (linear, norm) in enumerate(zip(self.linear, self.norm, strict=True)):
            u = linear(u)
            if k == 0:  # turning commutes with mixing, so it may come after, where there are fewer channels
                straight, across = u.chunk(2, dim=-1)
                u = straight + rotated(across)
            length = ((u**2).sum(dim=1, keepdim=True) + TINY).sqrt()
            u = u * (torch.relu(norm(length.reshape(-1, length.shape[-1])).reshape(length.shape)) / length)
        return u


class _Convolution(torch.nn.Module):
    """One DeltaConv layer (thesis, section 3.1.2): vectors first, then scalars from the new vectors."""

    def __init__(self, inputs: int, vectors: int, width: int, depth: int) -> None:
        super().__init__()
        self.vectors = VectorLayers(2 * vectors + inputs, *[width] * depth)
        self.scalars = ScalarLayers(inputs + 3 * width, *[width] * depth)
        self.around = ScalarLayers(inputs, *[width] * depth)

    def forward(self, x: torch.Tensor, u: torch.Tensor, on: Operators) -> tuple[torch.Tensor, torch.Tensor]:
        swirl = on.hodge_laplacian(on.divergence(u), on.curl(u))
        u = self.vectors(torch.cat([u, on.gradient(x), swirl], dim=-1))
        length = ((u**2).sum(dim=1) + TINY).sqrt()
        here = self.scalars(torch.cat([x, on.divergence(u), on.curl(u), length], dim=-1))
        return here + on.largest(self.around(x)), u


class DeltaNet(torch.nn.Module):
    """Convolutions, an embedding of their outputs whose maximum over the mesh is kept, and a head that sees both.

    Parameters
    ----------
    inputs : int
        Features of a vertex.
    options : DeltaConvOptions
        Hyperparameters.

    References
    ----------
    Thesis, Figure 4.4.
    """

    def __init__(self, inputs: int, options: DeltaConvOptions) -> None:
        super().__init__()
        width, total = options.width, options.layers * options.width
        self.convolutions = torch.nn.ModuleList(
            _Convolution(width if k else inputs, width if k else inputs, width, options.depth)
            for k in range(options.layers)
        )
        self.embed = ScalarLayers(total, options.embedding)
        self.from_all = torch.nn.Linear(options.embedding, HEAD[0], bias=False)
        self.from_each = torch.nn.Linear(total, HEAD[0], bias=False)
        self.norm = torch.nn.BatchNorm1d(HEAD[0])
        self.second = ScalarLayers(*HEAD[:2])
        self.third = torch.nn.Linear(*HEAD[1:])
        self.last = torch.nn.Linear(HEAD[2], 1)
        self.dropout = torch.nn.Dropout(options.dropout)

    def forward(self, x: torch.Tensor, on: Operators) -> torch.Tensor:
        """Take features (V, B, inputs) to distances (V, B)."""
        u, outputs = on.gradient(x), []
        for convolution in self.convolutions:
            x, u = convolution(x, u, on)
            outputs.append(x)
        x = torch.cat(outputs, dim=-1)  # (V, B, TF)
        whole = self.embed(x).amax(dim=0)  # (B, ES)
        # One linear layer of both, taken apart: what the whole mesh has in common is multiplied once.
        x = self.from_each(x) + self.from_all(whole)
        x = self.dropout(torch.relu(self.norm(x.reshape(-1, x.shape[-1])).reshape(x.shape)))
        x = torch.relu(self.third(self.dropout(self.second(x))))
        with torch.autocast(x.device.type, enabled=False):
            return self.last(x.float())[..., 0]


class DeltaConv(Model):
    """Coordinates and the impulse at every vertex go in, the field comes out. Its answers hold for one mesh.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    net : DeltaNet
        The network.
    inputs : ImpulseInputs
        How impulses are put to it.
    options : DeltaConvOptions
        Hyperparameters.
    operators : Operators
        Of the body's surface.

    Parameters
    ----------
    frames : ndarray of float64, shape (V, 2, 3), optional
        Other tangent frames than ``calculus.tangent_frames``; they make no difference to the answers.
    """

    kind: ClassVar[str] = "deltaconv"
    options_type: ClassVar[type[DeltaConvOptions]] = DeltaConvOptions
    # Thesis, Table 5.5.
    search_space: ClassVar[Mapping[str, Range]] = {
        "layers": Range(1, 6),
        "width": Range(64, 1024),
        "depth": Range(1, 3),
        "embedding": Range(64, 2048),
        "neighbours": Range(2, 30),
        "kernel": Range(1.0, 3.0),
    }
    slow: ClassVar[bool] = True

    def __init__(
        self,
        body: BodyGeometry,
        net: DeltaNet,
        inputs: ImpulseInputs,
        options: DeltaConvOptions,
        frames: FloatArray | None = None,
    ) -> None:
        """frames: (V, 2, 3) other tangent frames than ``tangent_frames``; they make no difference."""
        self.body, self.net, self.inputs, self.options = body, net, inputs, options
        device = next(net.parameters()).device
        frames = tangent_frames(body.surface) if frames is None else frames
        self.operators = Operators(calculus(body.vertices, frames, options.neighbours, options.kernel), device)
        self.where = torch.as_tensor(body.vertices, dtype=torch.float32, device=device)

    @classmethod
    def fit(
        cls, body: BodyGeometry, samples: Samples, options: DeltaConvOptions, seed: int, run: Run | None = None
    ) -> tuple[Self, dict[str, float]]:
        """Learn from the training split and watch the validation split, see ``Model.fit``."""
        device, splits, inputs = start_network(body, samples, options, seed)
        model = cls(body, DeltaNet(3 + inputs.count, options).to(device), inputs, options)
        return model, train(MeshLearner(model, *splits, device), options.training, seed, run)

    def field(self, impulses: torch.Tensor) -> torch.Tensor:
        """Ask the network.

        Parameters
        ----------
        impulses : Tensor, shape (B, 6 or 7)
            See ``ImpulseInputs``.

        Returns
        -------
        Tensor, shape (B, V)
            The fields, as the network says them.
        """
        count, batch = len(self.where), len(impulses)
        x = torch.cat(
            [self.where[:, None].expand(count, batch, 3), impulses.expand(count, batch, impulses.shape[1])], dim=2
        )
        return self.net(x, self.operators).T

    def predict(self, impacts: Impacts) -> Float32Array:
        """Work out the fields at the vertices, (N, V)."""
        impulses = torch.as_tensor(self.inputs(self.body, impacts), device=self.where.device)
        result = np.empty((len(impacts), len(self.where)), dtype=np.float32)
        training = self.net.training
        self.net.eval()
        with torch.inference_mode():
            for start in range(0, len(result), IMPULSE_CHUNK):
                stop = start + IMPULSE_CHUNK
                result[start:stop] = self.field(impulses[start:stop]).clamp(0.0, CAP).cpu().numpy()
        self.net.train(training)
        return result

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Lay down the weights and what the network was made with."""
        arrays = {name: value.cpu().numpy() for name, value in self.net.state_dict().items()}
        options = asdict(self.options)
        del options["training"]
        return arrays, {"inputs": asdict(self.inputs), "options": options, "vertices": len(self.where)}

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Make the model again, where it is of as many vertices as the body has."""
        if numbers["vertices"] != len(body.vertices):
            raise ModelError(f"it is of {numbers['vertices']} vertices, the body has {len(body.vertices)}")
        inputs = read_numbers(ImpulseInputs, numbers["inputs"])
        options = with_training(DeltaConvOptions(), numbers["options"])
        net = DeltaNet(3 + inputs.count, options)
        load_weights(net, arrays)
        return cls(body, net, inputs, options)


class MeshLearner:
    """What the trainer fits: rows are samples, the whole mesh under one impulse each.

    Attributes
    ----------
    module : DeltaNet
        The network.
    count : int
        Training samples.
    """

    def __init__(self, model: DeltaConv, samples: Samples, validation: Samples, device: torch.device) -> None:
        self.model, self.module, self.device = model, model.net, device
        self.count = len(samples)
        self.impulses = torch.as_tensor(model.inputs(model.body, samples.impacts), device=device)
        self.targets = Targets(model.body, samples.labels, device)
        self.held_out = validation.take(slice(VALIDATION_IMPULSES))
        self.truth = model.body.fields(self.held_out.labels)

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """Put all weights in one group."""
        return [{"params": list(self.module.parameters())}]

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Work out the loss of samples, see ``targets.amae_loss``."""
        rows = rows.to(self.device)
        return amae_loss(self.model.field(self.impulses[rows]), self.targets(rows), self.model.options.filled)

    def validate(self) -> float:
        """Work out the AMAE of the first validation samples."""
        return amae(self.truth, self.model.predict(self.held_out.impacts))
