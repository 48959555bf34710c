"""Fracture modes and what they make of a solid: atoms, the interfaces between them, and how a blow spreads.

After Sellán et al. 2022, *Breaking Good: Fracture Modes for Realtime Destruction*. Offline only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh, splu

from .breaking import components
from .errors import BakeError, MissingExtraError
from .solid import Solid, join_small, shared_faces, sums

try:
    import clarabel
except ImportError as error:
    raise MissingExtraError("clarabel", "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

JUMP = 0.1  # of a mode's largest jump: cells that no mode separates by more belong to one atom
ATOM_FLOOR = 4e-3  # of the body's volume; smaller atoms join the neighbour they share most area with
SETTLED = 1e-3  # change of a mode between iterations, in the mass norm, at which it has converged
ITERATIONS = 20
REPEATED = 0.995  # share of a start that may lie among the modes already found before another is drawn
STEPS = 1000  # first-order steps a programme, for 5,000 cells
TOLERANCE = 1e-9  # of the squared length of an iterate: a smaller squared residual ends the steps
RESTART = 0.09  # of the squared residual: how far it has to fall before the steps start from a new anchor
# Three times the paper's h and a wider patch: a small h drives the atoms under the contact so much harder than
# the rest that an object chips long before it breaks (benchmarks/calibration.py reports both heights).
DIFFUSION_TIME = 0.1  # h of Breaking Good, Eq. 22, lengths in units of the largest extent
PATCH_RADIUS = 0.1  # standard deviation of the contact patch, in units of the largest extent


@dataclass(frozen=True, eq=False)
class Modes:
    """Fracture modes of a solid.

    values: (K, C), one scalar per cell, orthonormal in the mass inner product.
    objectives: per mode, the fracture energy after each iteration (never increasing).
    restarts: how many modes were begun afresh because their start lay among those already found.
    """

    values: FloatArray
    objectives: tuple[tuple[float, ...], ...]
    restarts: int


def neighbours(solid: Solid) -> tuple[IntArray, FloatArray, FloatArray]:
    """Pairs (I, 2) of cells that share faces, their areas (I,) and diffusion conductances area/distance (I,)."""
    pairs, areas, _ = shared_faces(solid.triangles, solid.sides, solid.points)
    distance = np.linalg.norm(solid.centroids[pairs[:, 0]] - solid.centroids[pairs[:, 1]], axis=1)
    return pairs, areas, areas / distance


def laplacian(pairs: IntArray, weights: FloatArray, count: int) -> sp.csc_matrix:
    """The positive semi-definite graph Laplacian of weighted pairs."""
    difference = _difference(pairs, np.ones(len(pairs)), count)
    return sp.csc_matrix(difference.T @ sp.diags(weights) @ difference)


def fracture_modes(
    solid: Solid,
    count: int,
    progress: Callable[[float], None] = lambda _: None,
    solver: str = "first-order",
    known: FloatArray | None = None,
) -> Modes:
    """The ``count`` first non-trivial scalar fracture modes (Breaking Good, Algorithm 1).

    Each minimises the area-weighted jumps between cells, orthogonal to those before and to the constants, of unit
    length along its own previous iterate, until it settles; it starts from the Laplacian's eigenvector. An iterate
    is feasible in the programme of the next, and no solution is shorter than it, so the energy never increases.
    solver: of each programme; "first-order", or "interior-point", Clarabel's, which is exact and whose time grows
    faster with the cells (benchmarks/modes.py). known: (K, C) modes found before, after which to go on; they are not
    returned again. Raises BakeError if a solver fails.
    """
    pairs, areas, conductance = neighbours(solid)
    cells = len(solid.volumes)
    mass = solid.volumes / solid.volumes.sum()
    found = [np.ones(cells), *([] if known is None else known)]
    first = len(found) - 1
    count = max(0, min(count, cells - 2 - first))
    root = sp.diags(1.0 / np.sqrt(mass))
    scaled = root @ laplacian(pairs, conductance, cells) @ root
    # Shifted inverse power finds the smallest eigenvalues; the first is the constant's zero.
    start = np.ones(cells) / np.sqrt(cells)
    _, vectors = eigsh(scaled, k=first + count + 1, sigma=-1e-2, v0=start)
    guesses = (root @ vectors).T[1:]
    rng = np.random.default_rng(0)
    if solver not in ("first-order", "interior-point"):
        raise BakeError(f"unknown solver {solver!r}; use first-order or interior-point")
    programme: _FirstOrder | _InteriorPoint
    programme = _FirstOrder(pairs, areas, mass) if solver == "first-order" else _InteriorPoint(pairs, areas)

    def energy(u: FloatArray) -> float:
        return float(areas @ np.abs(u[pairs[:, 0]] - u[pairs[:, 1]]))

    history: list[tuple[float, ...]] = []
    restarts = 0
    for k in range(count):
        c = guesses[first + k]
        basis = np.array(found)
        if np.linalg.norm(basis * mass @ c) > REPEATED:
            c = rng.standard_normal(len(guesses)) @ guesses
            restarts += 1
        c = _orthogonal(c, found, mass)
        programme.begin(c)
        energies: list[float] = []
        stalled = 0
        while len(energies) < ITERATIONS and stalled < programme.patience:
            u = _orthogonal(programme.solve(np.vstack([found, [c]]) * mass, c), found, mass)
            value = energy(u)
            if energies and value > energies[-1]:  # no exact solution does that; this one is not worth going on from
                break
            stalled = stalled + 1 if energies and value > (1 - SETTLED) * energies[-1] else 0
            change = np.sqrt(mass @ (u - c) ** 2)
            c = u
            energies.append(value)
            if change < SETTLED:
                break
        found.append(c)
        history.append(tuple(energies))
        progress((k + 1) / count)
    return Modes(np.array(found[first + 1 :]).reshape(-1, cells), tuple(history), restarts)


def _difference(pairs: IntArray, weights: FloatArray, count: int) -> sp.csr_matrix:
    """(F, C): the weighted jump across each of the pairs."""
    rows = np.repeat(np.arange(len(pairs)), 2)
    values = np.tile([1.0, -1.0], len(pairs)) * np.repeat(weights, 2)
    return sp.csr_matrix((values, (rows, pairs.ravel())), shape=(len(pairs), count))


def _linear_programme(pairs: IntArray, areas: FloatArray, rows: FloatArray) -> FloatArray:
    """The (n,) minimiser of Σ areas |u_a - u_b| with rows @ u = (0, ..., 0, 1), by Clarabel's interior point."""
    cells, faces = rows.shape[1], len(pairs)
    # Units in which costs and unknowns are about 1 keep the interior-point method well conditioned.
    cost = areas / areas.mean() / faces
    difference, identity = _difference(pairs, np.ones(faces), cells), sp.identity(faces, format="csr")
    jumps = sp.vstack([sp.hstack([difference, -identity]), sp.hstack([-difference, -identity])])
    equalities = sp.hstack([sp.csr_matrix(rows), sp.csr_matrix((len(rows), faces))])
    right = np.zeros(len(rows) + 2 * faces)
    right[len(rows) - 1] = 1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solution = clarabel.DefaultSolver(
        sp.csc_matrix((cells + faces, cells + faces)),
        np.concatenate([np.zeros(cells), cost]),
        sp.csc_matrix(sp.vstack([equalities, jumps])),
        right,
        [clarabel.ZeroConeT(len(rows)), clarabel.NonnegativeConeT(2 * faces)],
        settings,
    ).solve()
    if "Solved" not in str(solution.status):
        raise BakeError(f"fracture modes: the solver ended with {solution.status}")
    return np.asarray(solution.x[:cells])


class _InteriorPoint:
    """Every programme solved to the end by Clarabel."""

    patience = 1

    def __init__(self, pairs: IntArray, areas: FloatArray) -> None:
        self.pairs, self.areas = pairs, areas

    def begin(self, c: FloatArray) -> None:
        pass

    def solve(self, rows: FloatArray, c: FloatArray) -> FloatArray:
        return _linear_programme(self.pairs, self.areas, rows)


class _FirstOrder:
    """Primal-dual steps, warm from programme to programme.

    The saddle problem min_u max_|y|<=1 y·Ku, K = diag(areas) D, on the affine set rows @ u = e, by the preconditioned
    primal-dual method (Chambolle and Pock 2011; Pock and Chambolle 2011, Eq. 10) with reflected Halpern steps and
    restarts (Lu and Yang 2024, for linear programmes). A step costs two sparse products, linear in the cells, and
    the steps grow with the number of cells across the body.
    """

    patience = 2

    def __init__(self, pairs: IntArray, areas: FloatArray, mass: FloatArray) -> None:
        self.pairs = pairs
        cells = len(mass)
        weights = areas / areas.mean()
        jump = _difference(pairs, weights, cells)
        self.primal = 1.0 / np.bincount(pairs.ravel(), np.repeat(weights, 2), minlength=cells)
        self.dual = 0.5 / weights
        # Single precision halves the memory that a step moves; what it loses is far below the tolerance.
        self.up = sp.csr_matrix(sp.diags(self.dual) @ jump).astype(np.float32)
        self.down = sp.csr_matrix(sp.diags(self.primal) @ jump.T).astype(np.float32)
        self.steps = round(STEPS * (cells / 5000) ** (1 / 3))

    def begin(self, c: FloatArray) -> None:
        self.y = np.sign(c[self.pairs[:, 0]] - c[self.pairs[:, 1]]).astype(np.float32)

    def solve(self, rows: FloatArray, c: FloatArray) -> FloatArray:
        lift = np.linalg.solve(rows * self.primal @ rows.T, rows) * self.primal
        lift = np.ascontiguousarray(lift.T, dtype=np.float32)  # (C, K): back onto the affine set
        rows = rows.astype(np.float32)
        right = np.zeros(len(rows), dtype=np.float32)
        right[-1] = 1.0
        u, y = c.astype(np.float32), self.y
        u_anchor, y_anchor = u.copy(), y.copy()
        since, last = 0, 0.0
        for _ in range(self.steps):
            u_next = u - self.down @ y
            with np.errstate(invalid="ignore"):  # what BLAS raises on lanes that it pads with; see below for the sum
                u_next -= lift @ (rows @ u_next - right)
            y_next = self.up @ (2.0 * u_next - u)
            y_next += y
            np.clip(y_next, -1.0, 1.0, out=y_next)
            since += 1
            if since % 25 == 0:
                residual = float(((u_next - u) ** 2 / self.primal).sum() + ((y_next - y) ** 2 / self.dual).sum())
                if residual < TOLERANCE * float((u**2 / self.primal).sum()):
                    break
                if last == 0.0:
                    last = residual
                elif residual < RESTART * last:
                    u, y, last, since = u_next, y_next, residual, 0
                    u_anchor, y_anchor = u.copy(), y.copy()
                    continue
            share = np.float32(since / (since + 1))
            for now, after, anchor in ((u, u_next, u_anchor), (y, y_next, y_anchor)):  # halfway through the reflection
                now *= -share
                now += 2 * share * after
                now += (1 - share) * anchor
        if not np.isfinite(u_next).all():
            raise BakeError("fracture modes: the solver diverged; try solver='interior-point'")
        self.y = y_next
        return u_next.astype(np.float64)


def _orthogonal(c: FloatArray, found: list[FloatArray], mass: FloatArray) -> FloatArray:
    basis = np.array(found)
    c = c - (basis * mass @ c) @ basis
    return np.asarray(c / np.sqrt(mass @ c**2))


def atoms(solid: Solid, modes: Modes) -> IntArray:
    """(C,) the atom of each cell: cells that no mode separates, crumbs joined to their neighbour."""
    pairs, areas, _ = neighbours(solid)
    jump = np.abs(modes.values[:, pairs[:, 0]] - modes.values[:, pairs[:, 1]])
    joined = (jump <= JUMP * jump.max(axis=1, keepdims=True)).all(axis=0)
    label = components(joined[None], pairs, len(solid.volumes))[0]
    return join_small(solid.volumes, pairs, areas, ATOM_FLOOR * float(solid.volumes.sum()), label)


def impact_field(solid: Solid, atom: IntArray, points: FloatArray) -> FloatArray:
    """How a unit blow at each point spreads: (N, A), per atom, of volume-weighted mean 1 over each row.

    A Gaussian patch on the solid diffused for DIFFUSION_TIME with the finite-volume heat equation
    (Breaking Good, Eq. 22, momentum for heat); implicit, so it conserves the total exactly: the body's
    velocity field ``impulse / mass * row * direction`` carries exactly the momentum of the impulse.
    """
    pairs, _, conductance = neighbours(solid)
    cells = len(solid.volumes)
    mass = sp.diags(solid.volumes)
    factor = splu(sp.csc_matrix(mass + DIFFUSION_TIME * laplacian(pairs, conductance, cells)))
    count = int(atom.max()) + 1
    # The diffusion is symmetric, so diffusing the atoms instead of every patch gives the same matrix.
    member = sp.csr_matrix((solid.volumes, (np.arange(cells), atom)), shape=(cells, count)).toarray()
    spread = factor.solve(member) / sums(atom, solid.volumes, count)  # (C, A)
    result = np.empty((len(points), count))
    for start in range(0, len(points), 512):
        block = points[start : start + 512]
        square = ((block[:, None] - solid.centroids[None]) ** 2).sum(axis=2)
        # Subtracting the nearest keeps a row's largest weight at 1 however coarse the cells are.
        patch = np.exp(-(square - square.min(axis=1, keepdims=True)) / (2 * PATCH_RADIUS**2)) * solid.volumes
        result[start : start + 512] = patch / patch.sum(axis=1, keepdims=True) @ spread
    return result * solid.volumes.sum()
