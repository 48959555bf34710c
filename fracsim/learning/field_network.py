"""The network of the field model, what it is fed with, and its weights as numpy runs them. Offline only.

``field`` trains it for one body and ``shared`` for many at once.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..common.errors import MissingExtraError
from ..data.samples import Samples
from ..fracture.predictor import FLOOR, FieldWeights
from ..solids.spectrum import Spectrum
from .body import BodyGeometry

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


# Where training starts from.
FREE_DEVIATION = 0.3  # of the free weights' openings where there is no prior
HALF_FILTER = 30.0  # eigenvalue at which the filter has fallen to a half
SLOPE, OFFSET = 3.0, 0.0  # of a logit over the logarithm of the squared load
LOG_PUSH, LOG_SHEAR = -2.0, 0.0  # how much push and shear count, against pull


class FieldNetwork(torch.nn.Module):
    """The network of FieldModel. Its prior is that an impact presses on a patch and spreads from it like heat.

    The skip connection holds, beside free weights, a heat kernel between contact and atoms, Σ_rk s_r(λ_k) φ_rk(x)
    φ̄_k(a), with a learned filter s: φ_rk is the k-th eigenfunction averaged over a patch of radius r, φ̄_k its mean
    over an atom. Without the kernel the same training ends at a far larger error: benchmarks/prior.py. It has the form
    of the modal simulator, whose numbers it has to find.

    Parameters
    ----------
    geometry : Spectrum
        K eigenfunctions at V vertices and A atoms, for R radii.
    pairs : ndarray of int64, shape (I, 2)
        The atoms that meet at each interface.
    normals : ndarray of float64, shape (I, 3)
        From the first to the second.
    width : int
        Of the hidden layers.
    prior, response : bool
        See ``FieldOptions``.
    """

    heat: torch.Tensor
    normals: torch.Tensor
    incidence: torch.Tensor

    def __init__(
        self, geometry: Spectrum, pairs: IntArray, normals: FloatArray, width: int, prior: bool, response: bool
    ) -> None:
        super().__init__()
        modes, atoms = geometry.means.shape
        radii, count = geometry.functions.shape[1], len(pairs)
        inputs = 3 + radii * modes
        self.outputs, self.atoms = atoms + (9 * count if response else 0), atoms
        self.first = torch.nn.Linear(inputs, width)
        self.second = torch.nn.Linear(width, width)
        self.last = torch.nn.Linear(width, self.outputs)
        torch.nn.init.zeros_(self.last.bias)
        self.free = torch.nn.Parameter(torch.zeros(inputs, self.outputs))
        self.prior = prior
        if self.prior:
            torch.nn.init.zeros_(self.last.weight)
        else:
            torch.nn.init.normal_(self.free, std=FREE_DEVIATION * inputs**-0.5)  # at 0 an opening has no gradient
        decline = -np.log1p(geometry.values / HALF_FILTER) - np.log(radii)
        self.log_filter = torch.nn.Parameter(torch.tensor(np.tile(decline, (radii, 1)), dtype=torch.float32))
        self.log_gain = torch.nn.Parameter(torch.zeros(count))
        self.slope = torch.nn.Parameter(torch.tensor(SLOPE))
        self.offset = torch.nn.Parameter(torch.tensor(OFFSET))
        self.log_push = torch.nn.Parameter(torch.tensor(LOG_PUSH))
        self.log_shear = torch.nn.Parameter(torch.tensor(LOG_SHEAR))
        incidence = np.zeros((atoms, count), dtype=np.float32)
        incidence[pairs[:, 0], np.arange(count)] = -1.0
        incidence[pairs[:, 1], np.arange(count)] = 1.0
        self.register_buffer("heat", torch.tensor(geometry.means, dtype=torch.float32))
        self.register_buffer("normals", torch.tensor(normals.T, dtype=torch.float32))
        self.register_buffer("incidence", torch.tensor(incidence))

    def skip(self) -> torch.Tensor:
        """Add the prior to the free weights, (D, C); positions take no part in the prior."""
        if not self.prior:
            return self.free
        heat = (self.log_filter.exp()[:, :, None] * self.heat).reshape(-1, self.atoms)
        return self.free + torch.nn.functional.pad(heat, (0, self.outputs - self.atoms, 3, 0))

    def forward(
        self, x: torch.Tensor, directions: torch.Tensor, severities: torch.Tensor, row: torch.Tensor, batch: int
    ) -> torch.Tensor:
        """Work out how surely each interface breaks.

        Parameters
        ----------
        x : Tensor, shape (M, D)
            Features of all M contacts of a batch.
        directions : Tensor, shape (M, 3)
            Unit vectors along the impulses.
        severities : Tensor, shape (M,)
            Of the contacts.
        row : Tensor of int64, shape (M,)
            The sample that each contact is of.
        batch : int
            Samples, B.

        Returns
        -------
        Tensor, shape (B, I)
            Logits.
        """
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
        """Tell the few numbers of the prior and the rule from the free weights.

        Returns
        -------
        tuple of list
            The few numbers, and the free weights.
        """
        shared = [self.log_filter, self.log_gain, self.slope, self.offset, self.log_push, self.log_shear]
        return shared, [p for p in self.parameters() if all(p is not q for q in shared)]


class ContactPatches:
    """Samples as flat lists of the contacts that act; most samples have one of the possible K.

    Parameters
    ----------
    samples : Samples
        N samples.
    coordinates : ndarray of float64, shape (V, D)
        Features of the vertices; a contact has the mean of its face's corners.
    faces : ndarray of int64, shape (F, 3)
        Of the surface.
    """

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
        """Ask a network about samples.

        Parameters
        ----------
        net : Module
            Called as ``FieldNetwork.forward``.
        chosen : Tensor of int64, shape (B,)
            Which samples.

        Returns
        -------
        Tensor, shape (B, I)
            Logits.
        """
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
        """Work out the binary cross-entropy of a network on samples.

        Parameters
        ----------
        net : Module
            Called as ``FieldNetwork.forward``.
        chosen : Tensor of int64, shape (B,)
            Which samples.

        Returns
        -------
        Tensor, shape ()
            The mean over samples and interfaces.
        """
        logits = self.logits(net, chosen)
        truth = self.broken[chosen].to(logits.device, torch.float32)
        return torch.nn.functional.binary_cross_entropy_with_logits(logits, truth)


def frozen(net: FieldNetwork, body: BodyGeometry, geometry: Spectrum, severity: float) -> FieldWeights:
    """Take the weights out of torch, as numpy runs them.

    Parameters
    ----------
    net : FieldNetwork
        The network.
    body : BodyGeometry
        The body.
    geometry : Spectrum
        What the network was made with.
    severity : float
        The largest total severity that it was trained on.

    Returns
    -------
    FieldWeights
        Arrays of float32, with a level of 0.5.
    """

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
