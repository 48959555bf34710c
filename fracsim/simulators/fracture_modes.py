"""Fracture modes and what they make of a solid: atoms, the interfaces between them, and how an impact spreads.

After Sellán et al. 2022, *Breaking Good: Fracture Modes for Realtime Destruction*. Offline only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError
from ..fracture.rule import components
from ..solids.solid import Solid, merge_small_regions
from ..solids.spectrum import laplacian, neighbours
from .linear_programmes import FirstOrder, InteriorPoint

JUMP = 0.1  # of a mode's largest jump: cells that no mode separates by more belong to one atom
ATOM_FLOOR = 4e-3  # of the body's volume; smaller atoms join the neighbour they share most area with
SETTLED = 1e-3  # change of a mode between iterations, in the mass norm, at which it has converged
ITERATIONS = 20
REPEATED = 0.995  # share of a start that may lie among the modes already found before another is drawn


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
    programme: FirstOrder | InteriorPoint
    programme = FirstOrder(pairs, areas, mass) if solver == "first-order" else InteriorPoint(pairs, areas)

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


def _orthogonal(c: FloatArray, found: list[FloatArray], mass: FloatArray) -> FloatArray:
    basis = np.array(found)
    c = c - (basis * mass @ c) @ basis
    return np.asarray(c / np.sqrt(mass @ c**2))


def atoms_from_modes(solid: Solid, modes: Modes) -> IntArray:
    """(C,) the atom of each cell: cells that no mode separates, crumbs joined to their neighbour."""
    pairs, areas, _ = neighbours(solid)
    jump = np.abs(modes.values[:, pairs[:, 0]] - modes.values[:, pairs[:, 1]])
    joined = (jump <= JUMP * jump.max(axis=1, keepdims=True)).all(axis=0)
    label = components(joined[None], pairs, len(solid.volumes))[0]
    return merge_small_regions(solid.volumes, pairs, areas, ATOM_FLOOR * float(solid.volumes.sum()), label)
