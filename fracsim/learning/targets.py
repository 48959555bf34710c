"""The loss of models that answer with whole fields, and the true fields to compare with. Models use both."""

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
    """Work out the mean of |y - ŷ| / (1 + α|y|).

    Parameters
    ----------
    predicted : Tensor
        ŷ, distances in units of the largest extent.
    truth : Tensor
        y, of the same shape.
    filled : float
        How many times more an error counts where a crack is filled in, that is where y is near 0 and ŷ above it. A
        crack with a gap separates nothing, while a crack that is too wide still does.

    Returns
    -------
    Tensor, shape ()
        The loss.

    References
    ----------
    Thesis, Eq. 4.5, with α = 10. ``filled`` is ours.
    """
    error = (predicted.float() - truth).abs() / (1.0 + ALPHA * truth)
    if filled:
        error = error * (1.0 + filled * torch.exp(-truth / NEAR) * (predicted > truth))
    return error.mean()


class Targets:
    """True fields, worked out when they are asked for: the least distance to the interfaces between two pieces.

    Parameters
    ----------
    body : BodyGeometry
        The body.
    labels : ndarray of int64, shape (N, A)
        The piece of each atom.
    device : device
        Where the fields are wanted.
    nodes : bool
        Whether edge midpoints can be asked for as well.
    """

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
        """Work out fields.

        Parameters
        ----------
        rows : Tensor of int64, shape (B,)
            Which fractures.
        columns : Tensor of int64, shape (B, K), optional
            At which vertices or nodes of each; at all of them by default.

        Returns
        -------
        Tensor of float32, shape (B, K) or (B, V)
            The fields.
        """
        count = self.count[rows]
        owner = torch.repeat_interleave(count)  # (M,) which of the B each parted interface belongs to
        first = torch.cumsum(count, 0) - count
        place = self.start[rows][owner] + torch.arange(len(owner), device=owner.device) - first[owner]
        interface = self.interface[place]
        values = self.distances[interface] if columns is None else self.distances[interface[:, None], columns[owner]]
        result = torch.full((len(rows), values.shape[1]), CAP, device=values.device)
        return result.scatter_reduce(0, owner[:, None].expand_as(values), values, "amin")
