"""TODO learning.targets."""

from __future__ import annotations

import numpy as np

from ..common.arrays import IntArray
from ..common.errors import MissingExtraError
from ..fracture.rule import separated
from ..metrics import ALPHA
from ..solids.geodesics import CAP
from .body import BodyGeometry

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

NEAR = 0.02  # of the largest extent: how far a crack's neighbourhood reaches, in ``amae_loss``


def amae_loss(predicted: torch.Tensor, truth: torch.Tensor, filled: float = 0.0) -> torch.Tensor:
    """The mean of |y - ŷ| / (1 + α|y|) (thesis, Eq. 4.5, α = 10).

    filled: how many times more an error counts that fills in a crack, where y is near 0 and ŷ above it: a crack with
    a gap parts nothing, while one that is too wide still does.
    """
    error = (predicted.float() - truth).abs() / (1.0 + ALPHA * truth)
    if filled:
        error = error * (1.0 + filled * torch.exp(-truth / NEAR) * (predicted > truth))
    return error.mean()


class Targets:
    """True fields, made as they are asked for: for each row the least distance to the interfaces that part pieces."""

    def __init__(self, body: BodyGeometry, labels: IntArray, device: torch.device, nodes: bool = False) -> None:
        """labels: (N, A). nodes: whether edge midpoints can be asked for, too."""
        distances = body.distances if nodes else body.distances[:, : len(body.vertices)]
        self.distances = torch.as_tensor(np.ascontiguousarray(distances), device=device)  # (I, V or V + E)
        row, interface = np.nonzero(separated(labels, body.interfaces.pairs))
        count = np.bincount(row, minlength=len(labels))
        self.interface = torch.as_tensor(interface, device=device)
        self.count = torch.as_tensor(count, device=device)
        self.start = torch.as_tensor(np.cumsum(count) - count, device=device)

    def __call__(self, rows: torch.Tensor, columns: torch.Tensor | None = None) -> torch.Tensor:
        """(B, K) the fields of rows (B,) at columns (B, K), or (B, V) at all of them."""
        count = self.count[rows]
        owner = torch.repeat_interleave(count)  # (M,) which of the B each parted interface belongs to
        first = torch.cumsum(count, 0) - count
        place = self.start[rows][owner] + torch.arange(len(owner), device=owner.device) - first[owner]
        interface = self.interface[place]
        values = self.distances[interface] if columns is None else self.distances[interface[:, None], columns[owner]]
        result = torch.full((len(rows), values.shape[1]), CAP, device=values.device)
        return result.scatter_reduce(0, owner[:, None].expand_as(values), values, "amin")
