"""What the networks of whole fields share: how they are begun, and how an impulse is put to them.

``mlp`` and ``deltaconv`` use it, and ``nearest`` compares impulses by ``resultant``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, FloatArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import TRAINING_SPLIT, VALIDATION_SPLIT, Samples
from ..geometry.sampling import SurfacePoints
from ..simulators.base import Impacts
from ..solids.surface import Surface
from .body import BodyGeometry
from .devices import device_for

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

POINT_CHUNK = 4096  # points that are asked about together: more is no faster on a CPU
VALIDATION_IMPULSES = 200  # whose fields are compared while the perceptron trains


def start_network(
    body: BodyGeometry, samples: Samples, options: Any, seed: int
) -> tuple[torch.device, tuple[Samples, Samples], ImpulseInputs]:
    """Begin to fit a network of whole fields; seeds torch.

    Parameters
    ----------
    body : BodyGeometry
        The body.
    samples : Samples
        With a training and a validation split.
    options : MLPOptions or DeltaConvOptions
        Hyperparameters.
    seed : int
        Of torch.

    Returns
    -------
    device : device
        Of the training.
    splits : tuple of Samples
        Training and validation.
    inputs : ImpulseInputs
        As the training samples call for.

    Raises
    ------
    ModelError
        Where a split is empty.
    """
    torch.manual_seed(seed)
    splits = samples.of_split(TRAINING_SPLIT), samples.of_split(VALIDATION_SPLIT)
    for split, name in zip(splits, ("training", "validation"), strict=True):
        if not len(split):
            raise ModelError(f"there are no {name} samples; make more with: fracsim dataset make")
    return device_for(options.training), splits, ImpulseInputs.of(body, splits[0], options.severity)


def check_sizes(options: Any, names: tuple[str, ...]) -> None:
    """Check what the options of both networks have in common: whole numbers of at least 1, and ``filled``.

    Parameters
    ----------
    options : MLPOptions or DeltaConvOptions
        Hyperparameters.
    names : tuple of str
        Which of them are whole numbers.

    Raises
    ------
    ModelError
        Where one is out of range.
    """
    for name in names:
        value = getattr(options, name)
        if not (isinstance(value, int) and value >= 1):
            raise ModelError(f"{name} must be a whole number and at least 1, got {value}")
    if not (math.isfinite(options.filled) and options.filled >= 0):
        raise ModelError(f"filled must be finite and at least 0, got {options.filled}")


@dataclass(frozen=True)
class ImpulseInputs:
    """How impacts are put to a network: mean position (3), resultant direction (3) and, if wanted, the total severity.

    The logarithm of the severity is clamped to the range of the training impulses, and brought to their mean 0 and
    deviation 1. The thesis's own models have no severity.

    Attributes
    ----------
    severity : bool
        Whether severity is an input.
    mean, deviation : float
        Of its logarithm over the training impulses.
    low, high : float
        Its range there.
    """

    severity: bool
    mean: float = 0.0
    deviation: float = 1.0
    low: float = 0.0
    high: float = 0.0

    @classmethod
    def of(cls, body: BodyGeometry, samples: Samples, severity: bool) -> Self:
        """Measure training impulses.

        Parameters
        ----------
        body : BodyGeometry
            The body.
        samples : Samples
            The training split.
        severity : bool
            Whether severity is an input.

        Returns
        -------
        ImpulseInputs
            The inputs.
        """
        if not severity:
            return cls(False)
        log = resultant(samples.impacts, body.surface)[:, 6]
        return cls(True, float(log.mean()), max(float(log.std()), 1e-6), float(log.min()), float(log.max()))

    @property
    def count(self) -> int:
        """How many numbers an impulse is, 6 or 7."""
        return 7 if self.severity else 6

    def __call__(self, body: BodyGeometry, impacts: Impacts) -> Float32Array:
        """Put impacts as numbers, (N, 6 or 7)."""
        whole = resultant(impacts, body.surface)
        whole[:, 6] = (np.clip(whole[:, 6], self.low, self.high) - self.mean) / self.deviation
        return whole[:, : self.count].astype(np.float32)


def load_weights(net: torch.nn.Module, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Put a file's weights into a network, and the network into evaluation mode.

    Parameters
    ----------
    net : Module
        The network.
    arrays : mapping of str to ndarray
        The weights by name.

    Raises
    ------
    ModelError
        Where names or shapes differ.
    """
    try:
        net.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in arrays.items()})
    except RuntimeError as error:
        raise ModelError(str(error)) from error
    net.eval()


def resultant(impacts: Impacts, surface: Surface) -> FloatArray:
    """Describe each impact as a whole.

    Parameters
    ----------
    impacts : Impacts
        N impacts.
    surface : Surface
        The body's.

    Returns
    -------
    ndarray of float64, shape (N, 7)
        The mean position and the mean direction of the contacts, weighted by severity, and the logarithm of the total
        severity.

    Raises
    ------
    ModelError
        Where an impact has no severity.
    """
    total = impacts.severities.sum(axis=1)
    if not (total > 0).all():
        raise ModelError(f"impact {int(np.argmin(total > 0))} has no severity; ask only about impacts that hit")
    share = (impacts.severities / total[:, None])[:, :, None]
    where = SurfacePoints(surface.vertices, surface.faces).at(impacts.faces.ravel(), impacts.barycentric.reshape(-1, 3))
    position = (share * where.reshape(*impacts.faces.shape, 3)).sum(axis=1)
    direction = (share * impacts.directions).sum(axis=1)
    return np.hstack([position, direction, np.log(total)[:, None]])
