"""The thesis's graph convolutions (sections 3.1 and 4.4.2): DeltaConv (Wiersma et al. 2022) made to regress a field.

Scalars and tangent vectors at the vertices, mixed by small perceptrons that see how each changes along the surface.
The mesh is fixed, so gradient and divergence are sparse matrices made once. Features are (V, B, C) and (V, 2, B, C):
the B impulses of a batch are columns of one and the same product. Offline only.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.spatial import cKDTree

from ..common.arrays import Float32Array, FloatArray, IntArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import Samples
from ..geometry.frames import tangent_basis
from ..metrics import amae
from ..simulators.base import Impacts
from ..solids.geodesics import CAP
from ..solids.surface import Surface
from .body import BodyGeometry
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
REGULARISER = 1e-3  # of the least squares, against the mean square of a neighbourhood's extent
HEAD = (256, 256, 128)  # widths, of the segmentation head that the thesis keeps


@dataclass(frozen=True)
class DeltaConvOptions:
    """layers, width: of the convolutions. depth: of the perceptrons within them. embedding: what a whole field is
    summed up in. neighbours: of a vertex, itself not counted. kernel: width of the gradient's Gaussian, in mean
    distances between neighbours (defaults: thesis, Table 5.6). dropout: in the head. severity: whether the impulse's
    strength is an input; the thesis's own has none. filled: see ``train.amae_loss``. training: its batch is a number
    of impulses; one alone is the same at every vertex, which batch normalisation takes away."""

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


@dataclass(frozen=True, eq=False)
class Calculus:
    """Derivatives at the vertices of a surface, of scalars f (V,) and of tangent vectors u (2V,), whose rows 2i and
    2i + 1 are along ``frames[i]`` (V, 2, 3).

    gradient: (2V, V) and divergence: (V, 2V) sparse. neighbours: (V, K).
    """

    frames: FloatArray
    gradient: sp.csr_matrix
    divergence: sp.csr_matrix
    neighbours: IntArray


def tangent_frames(surface: Surface) -> FloatArray:
    """(V, 2, 3) two unit vectors at each vertex, at right angles to its normal and to each other."""
    normals = np.asarray(surface.trimesh.vertex_normals)
    return -np.stack(tangent_basis(normals), axis=1)  # the sign that trained models know


def calculus(vertices: FloatArray, frames: FloatArray, neighbours: int, kernel: float) -> Calculus:
    """Gradient by least squares in each tangent plane, over the nearest neighbours in space weighted by a Gaussian
    whose width is ``kernel`` mean neighbour distances; divergence the same way, of vectors turned from each
    neighbour's tangent plane into the vertex's own."""
    count = len(vertices)
    if neighbours >= count:
        raise ModelError(f"neighbours must be below the number of vertices, {count}; got {neighbours}")
    far, near = cKDTree(vertices).query(vertices, neighbours + 1)
    far, near = far[:, 1:], near[:, 1:]
    weight = np.exp(-((far / (kernel * far.mean())) ** 2))
    arm = np.einsum("vka,vda->vkd", vertices[near] - vertices[:, None], frames)  # (V, K, 2)
    moment = np.einsum("vk,vkd,vke->vde", weight, arm, arm)
    trace = np.trace(moment, axis1=1, axis2=2)
    moment += REGULARISER * 0.5 * trace[:, None, None] * np.eye(2)
    stencil = np.linalg.solve(moment, np.einsum("vk,vkd->vdk", weight, arm))  # (V, 2, K): of f_j - f_i
    # The least rotation that takes one tangent plane to another is the orthogonal part of the projection between.
    onto = np.einsum("vda,vkea->vkde", frames, frames[near])
    cosine, sine = onto[..., 0, 0] + onto[..., 1, 1], onto[..., 1, 0] - onto[..., 0, 1]
    length = np.hypot(cosine, sine)
    turned = length > 1e-6  # else the planes face away from each other, and no rotation is the least
    cosine, sine = (np.divide(x, length, out=np.zeros_like(length), where=turned) for x in (cosine, sine))
    rotation = np.stack([np.stack([cosine, -sine], axis=-1), np.stack([sine, cosine], axis=-1)], axis=-2)
    spread = np.einsum("vdk,vkde->vke", stencil, rotation)

    own = np.arange(count)
    rows = 2 * own[:, None, None] + np.arange(2)[:, None]  # (V, 2, 1)
    gradient = sp.csr_matrix(
        (stencil.ravel(), (np.broadcast_to(rows, stencil.shape).ravel(), np.repeat(near, 2, axis=0).ravel())),
        shape=(2 * count, count),
    ) - sp.csr_matrix((stencil.sum(axis=2).ravel(), (np.arange(2 * count), np.repeat(own, 2))), (2 * count, count))
    columns = 2 * near[:, :, None] + np.arange(2)  # (V, K, 2)
    divergence = sp.csr_matrix(
        (spread.ravel(), (np.repeat(own, 2 * neighbours), columns.ravel())), shape=(count, 2 * count)
    ) - sp.csr_matrix((stencil.sum(axis=2).ravel(), (np.repeat(own, 2), np.arange(2 * count))), (count, 2 * count))
    return Calculus(frames, sp.csr_matrix(gradient), sp.csr_matrix(divergence), near)


def turned(u: torch.Tensor) -> torch.Tensor:
    """J: vectors (V, 2, ...) turned by 90 degrees about the normal."""
    return torch.stack([-u[:, 1], u[:, 0]], dim=1)


class _Product(torch.autograd.Function):
    """A constant sparse matrix times dense columns."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, matrix: torch.Tensor, transposed: torch.Tensor) -> torch.Tensor:
        ctx.transposed = transposed
        return matrix @ x

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return ctx.transposed @ gradients[0].contiguous(), None, None


class Operators:
    """``Calculus`` on tensors. Both operators are divided by the gradient's largest norm at a vertex, so that features
    keep their size whatever the mesh's resolution, as published."""

    def __init__(self, found: Calculus, device: torch.device) -> None:
        lengths = (found.gradient[::2].power(2) + found.gradient[1::2].power(2)).sqrt()  # the same in all frames
        scale = 1.0 / float(lengths.sum(axis=1).max())
        self.matrices = {
            name: (_csr(scale * matrix, device), _csr(scale * matrix.T, device))
            for name, matrix in (("gradient", found.gradient), ("divergence", found.divergence))
        }
        neighbours = np.hstack([np.arange(len(found.neighbours))[:, None], found.neighbours])
        self.neighbours = torch.as_tensor(neighbours, device=device)

    def _times(self, name: str, x: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
        matrix, transposed = self.matrices[name]
        with torch.autocast(x.device.type, enabled=False):
            return _Product.apply(x.float().reshape(matrix.shape[1], -1), matrix, transposed).reshape(shape)  # type: ignore[no-untyped-call]

    def gradient(self, x: torch.Tensor) -> torch.Tensor:
        """(V, B, C) to (V, 2, B, C)"""
        return self._times("gradient", x, (len(x), 2, *x.shape[1:]))

    def divergence(self, u: torch.Tensor) -> torch.Tensor:
        """(V, 2, B, C) to (V, B, C)"""
        return self._times("divergence", u, (len(u), *u.shape[2:]))

    def curl(self, u: torch.Tensor) -> torch.Tensor:
        return -self.divergence(turned(u))

    def hodge_laplacian(self, divergence: torch.Tensor, curl: torch.Tensor) -> torch.Tensor:
        """-(G D - J G D J) u, of a field's divergence and curl (V, B, C)."""
        count = divergence.shape[-1]
        both = self.gradient(torch.cat([divergence, curl], dim=-1))
        return -(both[..., :count] + turned(both[..., count:]))

    def largest(self, x: torch.Tensor) -> torch.Tensor:
        """(V, B, C) the greatest value among a vertex and its neighbours."""
        result = x
        for column in self.neighbours.T[1:]:
            result = torch.maximum(result, x[column])
        return result


def _csr(matrix: sp.spmatrix, device: torch.device) -> torch.Tensor:
    matrix = sp.csr_matrix(matrix)
    matrix.sort_indices()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta state")
        return torch.sparse_csr_tensor(
            torch.as_tensor(matrix.indptr, dtype=torch.int64),
            torch.as_tensor(matrix.indices, dtype=torch.int64),
            torch.as_tensor(matrix.data, dtype=torch.float32),
            matrix.shape,
            check_invariants=True,
        ).to(device)


class ScalarLayers(torch.nn.Module):
    """Linear layers with batch normalisation and ReLU, on (..., C)."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.linear = torch.nn.ModuleList(torch.nn.Linear(a, b, bias=False) for a, b in itertools.pairwise(widths))
        self.norm = torch.nn.ModuleList(torch.nn.BatchNorm1d(width) for width in widths[1:])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        for linear, norm in zip(self.linear, self.norm, strict=True):
            x = linear(x)
            x = torch.relu(norm(x.reshape(-1, x.shape[-1])).reshape(x.shape))
        return x


class VectorLayers(torch.nn.Module):
    """The same on tangent vectors (V, 2, B, C), blind to the choice of frames: each layer mixes vectors and vectors
    turned by 90 degrees, and acts on their lengths alone."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.linear = torch.nn.ModuleList(
            torch.nn.Linear(a, 2 * b if k == 0 else b, bias=False)
            for k, (a, b) in enumerate(itertools.pairwise(widths))
        )
        self.norm = torch.nn.ModuleList(torch.nn.BatchNorm1d(width) for width in widths[1:])

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        for k, (linear, norm) in enumerate(zip(self.linear, self.norm, strict=True)):
            u = linear(u)
            if k == 0:  # turning commutes with mixing, so it may come after, where there are fewer channels
                straight, across = u.chunk(2, dim=-1)
                u = straight + turned(across)
            length = ((u**2).sum(dim=1, keepdim=True) + 1e-12).sqrt()
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
        length = ((u**2).sum(dim=1) + 1e-12).sqrt()
        here = self.scalars(torch.cat([x, on.divergence(u), on.curl(u), length], dim=-1))
        return here + on.largest(self.around(x)), u


class DeltaNet(torch.nn.Module):
    """Convolutions, an embedding of their outputs of which the largest over the mesh is kept, and a head that sees
    both (thesis, Figure 4.4)."""

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
        """(V, B, inputs) to (V, B)"""
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
    """Coordinates and the impulse at every vertex in, the field out. Its answers hold for one mesh."""

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
        device, splits, inputs = start_network(body, samples, options, seed)
        model = cls(body, DeltaNet(3 + inputs.count, options).to(device), inputs, options)
        return model, train(MeshLearner(model, *splits, device), options.training, seed, run)

    def field(self, impulses: torch.Tensor) -> torch.Tensor:
        """(B, 6 or 7) inputs to (B, V), as the network says it."""
        count, batch = len(self.where), len(impulses)
        x = torch.cat(
            [self.where[:, None].expand(count, batch, 3), impulses.expand(count, batch, impulses.shape[1])], dim=2
        )
        return self.net(x, self.operators).T

    def predict(self, impacts: Impacts) -> Float32Array:
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
        arrays = {name: value.cpu().numpy() for name, value in self.net.state_dict().items()}
        options = asdict(self.options)
        del options["training"]
        return arrays, {"inputs": asdict(self.inputs), "options": options, "vertices": len(self.where)}

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        if numbers["vertices"] != len(body.vertices):
            raise ModelError(f"it is of {numbers['vertices']} vertices, the body has {len(body.vertices)}")
        inputs = read_numbers(ImpulseInputs, numbers["inputs"])
        options = with_training(DeltaConvOptions(), numbers["options"])
        net = DeltaNet(3 + inputs.count, options)
        load_weights(net, arrays)
        return cls(body, net, inputs, options)


class MeshLearner:
    """Training rows are samples: the whole mesh under one impulse each."""

    def __init__(self, model: DeltaConv, samples: Samples, validation: Samples, device: torch.device) -> None:
        self.model, self.module, self.device = model, model.net, device
        self.count = len(samples)
        self.impulses = torch.as_tensor(model.inputs(model.body, samples.impacts), device=device)
        self.targets = Targets(model.body, samples.labels, device)
        self.held_out = validation.take(slice(VALIDATION_IMPULSES))
        self.truth = model.body.fields(self.held_out.labels)

    def groups(self, rate: float) -> list[dict[str, Any]]:
        return [{"params": list(self.module.parameters())}]

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        rows = rows.to(self.device)
        return amae_loss(self.model.field(self.impulses[rows]), self.targets(rows), self.model.options.filled)

    def validate(self) -> float:
        return amae(self.truth, self.model.predict(self.held_out.impacts))
