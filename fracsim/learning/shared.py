"""One model for many bodies: how an impact spreads and what breaks an interface, learned once for all of them.

Nothing in it belongs to one body. A body brings its geometry (the eigenfunctions of its Laplacian and the interfaces
between its atoms), so a new body needs a solid and its atoms, but no samples and no training. Reached by its name in
MODELS.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray
from ..common.errors import MissingExtraError, ModelError
from ..data.samples import TRAINING_SPLIT, VALIDATION_SPLIT, Samples
from ..solids.spectrum import Spectrum
from .body import BodyGeometry
from .field import FieldModel
from .field_network import (
    HALF_FILTER,
    LOG_PUSH,
    LOG_SHEAR,
    OFFSET,
    SLOPE,
    ContactPatches,
    FieldNetwork,
    frozen,
)
from .options import TrainingOptions
from .search import Range
from .trainer import Run, train

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


LOWEST, HIGHEST = 1.0, 1e4  # eigenvalues between which the filter's knots stand, evenly in their logarithm
VALIDATED = 2048  # samples of each body
RULE = ("slope", "offset", "log_push", "log_shear")


@dataclass(frozen=True)
class SharedOptions:
    """Hyperparameters of the shared model.

    Attributes
    ----------
    knots : int
        Of the filter, a piecewise linear function of the logarithm of the eigenvalue.
    eigenfunctions : int
        Of each body's Laplacian, see ``solids.spectrum``.
    radii : tuple of float
        Of the patches that these are averaged over, in units of the largest extent.
    training : TrainingOptions
        Its batch is a number of samples, of all bodies together.
    """

    knots: int = 16
    eigenfunctions: int = 96
    radii: tuple[float, ...] = (0.05, 0.15)
    training: TrainingOptions = field(
        default_factory=lambda: TrainingOptions(steps=3000, batch=512, rate=2e-2, schedule="cosine")
    )


class _SharedNet(torch.nn.Module):
    """The numbers that all bodies share; a body's own network takes them in place of its own."""

    def __init__(self, radii: int, knots: int) -> None:
        super().__init__()
        places = np.exp(np.linspace(np.log(LOWEST), np.log(HIGHEST), knots))
        start = -np.log1p(places / HALF_FILTER) - np.log(radii)
        self.filter = torch.nn.Parameter(torch.tensor(np.tile(start, (radii, 1)), dtype=torch.float32))
        self.slope = torch.nn.Parameter(torch.tensor(SLOPE))
        self.offset = torch.nn.Parameter(torch.tensor(OFFSET))
        self.log_push = torch.nn.Parameter(torch.tensor(LOG_PUSH))
        self.log_shear = torch.nn.Parameter(torch.tensor(LOG_SHEAR))

    def numbers(self, hat: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"log_filter": self.filter @ hat, **{name: getattr(self, name) for name in RULE}}


class _TrainingBody(torch.nn.Module):
    """One body's share of the training: its contacts, and its network with the shared numbers in it."""

    def __init__(self, body: BodyGeometry, samples: Samples, options: SharedOptions, shared: _SharedNet) -> None:
        super().__init__()
        geometry = body.spectrum(options.eigenfunctions, options.radii)
        self.net = blank(body, geometry)
        self.hat = hats(geometry.values, options.knots)
        self.shared = shared
        self.contacts = [
            ContactPatches(samples.of_split(split), geometry.coordinates, body.faces)
            for split in (TRAINING_SPLIT, VALIDATION_SPLIT)
        ]

    def forward(self, *arguments: Any) -> torch.Tensor:
        return torch.func.functional_call(self.net, self.shared.numbers(self.hat), arguments)


def blank(body: BodyGeometry, geometry: Spectrum) -> FieldNetwork:
    """Make a body's network with no weights of its own: the smallest hidden layers, all zero.

    Parameters
    ----------
    body : BodyGeometry
        The body.
    geometry : Spectrum
        Its eigenfunctions.

    Returns
    -------
    FieldNetwork
        The network.
    """
    net = FieldNetwork(geometry, body.interfaces.pairs, body.interfaces.normals, 1, prior=True, response=False)
    for parameter in net.parameters():
        parameter.requires_grad_(False)
        if parameter.ndim:
            parameter.zero_()
    return net


def hats(values: FloatArray, knots: int) -> torch.Tensor:
    """Work out the weights of linear interpolation between the knots; beyond the ends, their values are held.

    Parameters
    ----------
    values : ndarray of float64, shape (K,)
        Eigenvalues.
    knots : int
        Knots, evenly spaced in the logarithm from LOWEST to HIGHEST.

    Returns
    -------
    Tensor of float32, shape (knots, K)
        The weights.
    """
    where = np.log(np.clip(values, LOWEST, HIGHEST) / LOWEST) / np.log(HIGHEST / LOWEST) * (knots - 1)
    weights = np.maximum(0.0, 1.0 - np.abs(where[None] - np.arange(knots)[:, None]))
    return torch.tensor(weights, dtype=torch.float32)


class _SharedLearner:
    def __init__(self, bodies: Sequence[tuple[BodyGeometry, Samples]], options: SharedOptions) -> None:
        self.module = _SharedNet(len(options.radii), options.knots)
        self.parts = [_TrainingBody(body, samples, options, self.module) for body, samples in bodies]
        sizes = [len(part.contacts[0].count) for part in self.parts]
        self.ends = torch.cumsum(torch.tensor([0, *sizes]), 0)
        self.count = int(self.ends[-1])

    def groups(self, rate: float) -> list[dict[str, Any]]:
        return [{"params": list(self.module.parameters()), "lr": rate}]

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        total = torch.zeros(())
        for part, low, high in zip(self.parts, self.ends[:-1], self.ends[1:], strict=True):
            mine = rows[(rows >= low) & (rows < high)] - low
            if len(mine):
                total = total + part.contacts[0].loss(part, mine) * len(mine)
        return total / len(rows)

    def validate(self) -> float:
        with torch.no_grad():
            losses = [
                float(p.contacts[1].loss(p, torch.arange(min(VALIDATED, len(p.contacts[1].count))))) for p in self.parts
            ]
        return float(np.mean(losses))


@dataclass(frozen=True, eq=False)
class SharedField(FieldModel):
    """The shared numbers in one body; ``on`` takes them to another.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    net : FieldWeights
        The weights that the shared numbers give in it.
    numbers : dict of str to ndarray
        What all bodies share.
    options : SharedOptions
        Hyperparameters.
    """

    kind: ClassVar[str] = "shared"
    options_type: ClassVar[type] = SharedOptions
    search_space: ClassVar[Mapping[str, Range]] = {
        "knots": Range(4, 32),
        "eigenfunctions": Range(24, 192, log=True),
        "rate": Range(3e-3, 1e-1, log=True),
    }
    numbers: Mapping[str, npt.NDArray[np.float32]]
    options: SharedOptions

    @classmethod
    def fit(  # type: ignore[override]
        cls,
        body: BodyGeometry,
        samples: Samples,
        options: SharedOptions | None = None,
        seed: int = 0,
        run: Run | None = None,
    ) -> tuple[Self, dict[str, float]]:
        """Learn from one body, see ``fit_many``."""
        return cls.fit_many([(body, samples)], options, seed, run)

    @classmethod
    def fit_many(
        cls,
        bodies: Sequence[tuple[BodyGeometry, Samples]],
        options: SharedOptions | None = None,
        seed: int = 0,
        run: Run | None = None,
    ) -> tuple[Self, dict[str, float]]:
        """Learn from several bodies at once; the model returned is of the first.

        Parameters
        ----------
        bodies : sequence of tuple
            Bodies and their samples, which say which interfaces broke.
        options : SharedOptions, optional
            Hyperparameters.
        seed : int
            Fixes the numbers to the bit on a CPU.
        run : Run, optional
            Progress, checkpoint and log.

        Returns
        -------
        tuple
            The model, and figures of the training.

        Raises
        ------
        ModelError
            Where samples do not say which interfaces broke, or the training diverges.
        """
        options = options or SharedOptions()
        for body, samples in bodies:
            if not samples.broken.shape[1]:
                raise ModelError(f"{body.surface.name}: its samples do not say which interfaces broke")
        torch.manual_seed(seed)
        learner = _SharedLearner(bodies, options)
        figures = train(learner, options.training, seed, run)
        numbers = {name: value.detach().numpy().astype(np.float32) for name, value in learner.module.named_parameters()}
        severity = max(float(samples.of_split(TRAINING_SPLIT).severities.sum(axis=1).max()) for _, samples in bodies)
        return cls._build(bodies[0][0], {**numbers, "severity": np.array([severity], np.float32)}, options), figures

    def on(self, body: BodyGeometry) -> Self:
        """Take the same model to another body.

        Parameters
        ----------
        body : BodyGeometry
            Any body.

        Returns
        -------
        SharedField
            The same numbers there.
        """
        return self._build(body, self.numbers, self.options)

    @classmethod
    def _build(cls, body: BodyGeometry, numbers: Mapping[str, npt.NDArray[np.float32]], options: SharedOptions) -> Self:
        shared = _SharedNet(len(options.radii), options.knots)
        shared.load_state_dict({n: torch.from_numpy(np.array(v)) for n, v in numbers.items() if n != "severity"})
        geometry = body.spectrum(options.eigenfunctions, options.radii)
        net = blank(body, geometry)
        with torch.no_grad():
            for name, value in shared.numbers(hats(geometry.values, options.knots)).items():
                getattr(net, name).copy_(value)
        return cls(body, frozen(net, body, geometry, float(numbers["severity"][0])), numbers, options)

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Lay down the shared numbers."""
        options = self.options
        numbers = {"knots": options.knots, "eigenfunctions": options.eigenfunctions, "radii": list(options.radii)}
        return dict(self.numbers), numbers

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Make the model again from its numbers, in any body."""
        options = SharedOptions(int(numbers["knots"]), int(numbers["eigenfunctions"]), tuple(numbers["radii"]))
        return cls._build(body, arrays, options)
