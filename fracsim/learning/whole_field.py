"""TODO learning.whole_field."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, FloatArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import Samples
from ..geometry.sampling import SurfacePoints
from ..simulators.base import Impacts
from ..solids.surface import Surface
from .body import BodyGeometry
from .trainer import device_for

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

POINT_CHUNK = 4096  # points that are asked about together: more is no faster on a CPU
VALIDATION_IMPULSES = 200  # whose fields are compared while the perceptron trains


def start_network(
    body: BodyGeometry, samples: Samples, options: Any, seed: int
) -> tuple[torch.device, tuple[Samples, Samples], ImpulseInputs]:
    """How fitting a network of whole fields begins: the device, training and validation samples, and the inputs that
    the former call for. Seeds torch."""
    torch.manual_seed(seed)
    splits = samples.of_split(0), samples.of_split(1)
    for split, name in zip(splits, ("training", "validation"), strict=True):
        if not len(split):
            raise ModelError(f"there are no {name} samples; make more with: fracsim dataset make")
    return device_for(options.training), splits, ImpulseInputs.of(body, splits[0], options.severity)


def check_sizes(options: Any, names: tuple[str, ...]) -> None:
    """What the options of torch models have in common: whole numbers of at least 1, and ``filled``."""
    for name in names:
        value = getattr(options, name)
        if not (isinstance(value, int) and value >= 1):
            raise ModelError(f"{name} must be a whole number and at least 1, got {value}")
    if not (math.isfinite(options.filled) and options.filled >= 0):
        raise ModelError(f"filled must be finite and at least 0, got {options.filled}")


@dataclass(frozen=True)
class ImpulseInputs:
    """Impacts as network inputs: mean position (3), resultant direction (3) and, unless the thesis's own are wanted,
    the logarithm of the total severity, which is brought to mean 0 and deviation 1 over the training impulses, and
    clamped to their range."""

    severity: bool
    mean: float = 0.0
    deviation: float = 1.0
    low: float = 0.0
    high: float = 0.0

    @classmethod
    def of(cls, body: BodyGeometry, samples: Samples, severity: bool) -> Self:
        if not severity:
            return cls(False)
        log = resultant(samples.impacts, body.surface)[:, 6]
        return cls(True, float(log.mean()), max(float(log.std()), 1e-6), float(log.min()), float(log.max()))

    @property
    def count(self) -> int:
        return 7 if self.severity else 6

    def __call__(self, body: BodyGeometry, impacts: Impacts) -> Float32Array:
        """(N, 6 or 7)"""
        whole = resultant(impacts, body.surface)
        whole[:, 6] = (np.clip(whole[:, 6], self.low, self.high) - self.mean) / self.deviation
        return whole[:, : self.count].astype(np.float32)


def load_weights(net: torch.nn.Module, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    try:
        net.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in arrays.items()})
    except RuntimeError as error:
        raise ModelError(str(error)) from error
    net.eval()


def resultant(impacts: Impacts, surface: Surface) -> FloatArray:
    """(N, 7) what an impact is as a whole: the mean of its contacts' positions and of their directions, weighted by
    severity, and the logarithm of the total severity."""
    total = impacts.severities.sum(axis=1)
    if not (total > 0).all():
        raise ModelError(f"impact {int(np.argmin(total > 0))} has no severity; ask only about impacts that hit")
    share = (impacts.severities / total[:, None])[:, :, None]
    where = SurfacePoints(surface.vertices, surface.faces).at(impacts.faces.ravel(), impacts.barycentric.reshape(-1, 3))
    position = (share * where.reshape(*impacts.faces.shape, 3)).sum(axis=1)
    direction = (share * impacts.directions).sum(axis=1)
    return np.hstack([position, direction, np.log(total)[:, None]])
