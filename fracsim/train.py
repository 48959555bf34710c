"""Training of the field model, in torch. Offline only."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .breaking import Interfaces
from .dataset import Samples
from .errors import BakeError, MissingExtraError
from .models.field import FLOOR, FieldModel
from .spectrum import Spectrum

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TrainingOptions:
    """width of the hidden layers. batch: impulses a step. rate, decay: of AdamW, on a cosine schedule.
    prior: whether blows are presumed to spread like heat. filter_rate: how many times faster the few numbers of
    that prior learn than the free weights, which else would learn around it. steps: fixed, so that a seed fixes
    the model."""

    width: int = 192
    batch: int = 512
    rate: float = 1e-3
    filter_rate: float = 50.0
    decay: float = 1e-3
    prior: bool = True
    steps: int = 5000


class _Net(torch.nn.Module):
    """The network of FieldModel, with a prior: a blow spreads like heat.

    The skip connection holds, beside free weights, the difference of a heat kernel between the contact and the
    two sides of each interface, Σ_k s(λ_k) φ_k(x) (φ̄_k(b) - φ̄_k(a)); the filter s and a gain an interface are
    learned. Without it the same training ends at a far larger error: benchmarks/prior.py.
    """

    contrast: torch.Tensor
    normals: torch.Tensor

    def __init__(
        self, width: int, normals: FloatArray, eigenvalues: FloatArray, contrast: FloatArray, prior: bool
    ) -> None:
        super().__init__()
        count = len(normals)
        inputs = 3 + len(eigenvalues)
        self.first = torch.nn.Linear(inputs, width)
        self.second = torch.nn.Linear(width, width)
        self.last = torch.nn.Linear(width, count)
        self.free = torch.nn.Parameter(torch.zeros(inputs, count))
        self.log_filter = torch.nn.Parameter(-torch.log1p(torch.as_tensor(eigenvalues / 30, dtype=torch.float32)))
        self.log_gain = torch.nn.Parameter(torch.zeros(count))
        self.register_buffer("contrast", torch.as_tensor(contrast, dtype=torch.float32))
        self.prior = prior
        if prior:
            torch.nn.init.zeros_(self.last.weight)
        self.slope = torch.nn.Parameter(torch.full((count,), 3.0))
        self.offset = torch.nn.Parameter(torch.zeros(count))
        self.log_push = torch.nn.Parameter(torch.full((count,), -2.0))
        self.log_shear = torch.nn.Parameter(torch.zeros(count))
        self.register_buffer("normals", torch.as_tensor(normals, dtype=torch.float32))

    def skip(self) -> torch.Tensor:
        """(D, I) free weights and prior together; positions take no part in the prior."""
        if not self.prior:
            return self.free
        heat = self.log_filter.exp()[:, None] * self.contrast * self.log_gain.exp()
        return self.free + torch.cat([torch.zeros(3, heat.shape[1]), heat])

    def forward(
        self, x: torch.Tensor, directions: torch.Tensor, severities: torch.Tensor, row: torch.Tensor, batch: int
    ) -> torch.Tensor:
        moved = x @ self.skip()  # (M, I), M contacts of the whole batch
        for layer in (self.first, self.second):
            x = torch.nn.functional.silu(layer(x))
        moved = (moved + self.last(x)) * severities[:, None]
        # One (B, I) sum an axis is several times faster than one (B, I, 3).
        opening = torch.stack(
            [torch.zeros(batch, moved.shape[1]).index_add(0, row, moved * directions[:, k : k + 1]) for k in range(3)],
            dim=2,
        )  # (B, I, 3)
        normal = (opening * self.normals).sum(dim=2)
        tangent = torch.relu((opening**2).sum(dim=2) - normal**2)
        squared = (
            torch.relu(normal) ** 2 + self.log_push.exp() * torch.relu(-normal) ** 2 + self.log_shear.exp() * tangent
        )
        return self.slope * torch.log(squared + FLOOR) + self.offset  # (B, I)


def train_field(
    samples: Samples,
    geometry: Spectrum,
    faces: IntArray,
    interfaces: Interfaces,
    seed: int,
    options: TrainingOptions | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[FieldModel, dict[str, float]]:
    """Fit the field model to which interfaces broke in the training samples, by binary cross-entropy.

    faces: (F, 3). Returns the model and figures of its training, with
    the loss on the validation samples. Raises BakeError if the loss is not finite.
    """
    options = options or TrainingOptions()
    torch.set_num_threads(1)  # sums in one order, whatever the machine
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    coordinates = geometry.coordinates
    first, second = interfaces.pairs.T
    contrast = geometry.means[:, second] - geometry.means[:, first]
    net = _Net(options.width, interfaces.normals, geometry.values, contrast, options.prior)
    filters = [net.log_filter, net.log_gain, net.slope, net.offset, net.log_push, net.log_shear]
    others = [p for p in net.parameters() if all(p is not f for f in filters)]
    optimiser = torch.optim.AdamW(
        [{"params": others, "weight_decay": options.decay}, {"params": filters, "weight_decay": 0.0}], options.rate
    )
    train, validation = _Contacts(samples.part(0), coordinates, faces), _Contacts(samples.part(1), coordinates, faces)
    begin = time.perf_counter()
    step = 0
    while step < options.steps:
        order = torch.randperm(len(train.broken), generator=generator)
        for chosen in torch.split(order, options.batch):
            cosine = 0.5 + 0.5 * np.cos(np.pi * step / options.steps)
            for group, scale in zip(optimiser.param_groups, (1.0, options.filter_rate), strict=True):
                group["lr"] = options.rate * scale * cosine
            loss = train.loss(net, chosen)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            step += 1
            if step % 50 == 0:
                progress(step / options.steps)
            if step == options.steps:
                break
        if not torch.isfinite(loss):
            raise BakeError("training diverged: the loss is not finite; lower the learning rate")
    with torch.no_grad():
        held_out = float(validation.loss(net, torch.arange(len(validation.broken))))
    figures = {
        "samples": float(len(train.broken)),
        "steps": float(step),
        "seconds": time.perf_counter() - begin,
        "training_loss": float(loss.detach()),
        "validation_loss": held_out,
    }

    def array(tensor: torch.Tensor) -> npt.NDArray[np.float32]:
        return np.ascontiguousarray(tensor.detach().numpy(), dtype=np.float32)

    weights = {}
    for k, layer in enumerate((net.first, net.second, net.last)):
        weights[f"weights_{k}"] = array(layer.weight.T)
        weights[f"biases_{k}"] = array(layer.bias)
    model = FieldModel(
        coordinates=coordinates.astype(np.float32),
        skip=array(net.skip()),
        **weights,
        slope=array(net.slope),
        offset=array(net.offset),
        push=array(net.log_push.exp()),
        shear=array(net.log_shear.exp()),
        normals=interfaces.normals.astype(np.float32),
        severity=np.array([samples.part(0).severities.sum(axis=1).max()], dtype=np.float32),
    )
    return model, figures


class _Contacts:
    """Samples as flat lists of the contacts that are there, most samples having one of the most possible."""

    def __init__(self, samples: Samples, coordinates: FloatArray, faces: IntArray) -> None:
        there = samples.severities > 0
        row, slot = np.nonzero(there)
        corner = faces[samples.faces[row, slot]]
        x = np.einsum("nc,ncd->nd", samples.barycentric[row, slot], coordinates[corner])
        self.x = torch.as_tensor(x, dtype=torch.float32)
        self.directions = torch.as_tensor(samples.directions[row, slot], dtype=torch.float32)
        self.severities = torch.as_tensor(samples.severities[row, slot], dtype=torch.float32)
        self.count = torch.as_tensor(there.sum(axis=1))
        self.start = torch.cumsum(self.count, 0) - self.count
        self.broken = torch.as_tensor(samples.broken, dtype=torch.float32)

    def loss(self, net: _Net, chosen: torch.Tensor) -> torch.Tensor:
        count = self.count[chosen]
        row = torch.repeat_interleave(torch.arange(len(chosen)), count)
        first = torch.cumsum(count, 0) - count
        contact = self.start[chosen][row] + torch.arange(len(row)) - first[row]
        logits = net(self.x[contact], self.directions[contact], self.severities[contact], row, len(chosen))
        return torch.nn.functional.binary_cross_entropy_with_logits(logits, self.broken[chosen])
