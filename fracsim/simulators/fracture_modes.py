"""Fracture modes of a solid, and the atoms that they cut it into. Offline only; the modal simulator is built on them.

After Sellán et al. 2022, *Breaking Good: Fracture Modes for Realtime Destruction*.
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
REPEATED = 0.995  # a start of which a larger share lies among the modes before is replaced by a random one


@dataclass(frozen=True, eq=False)
class Modes:
    """Fracture modes of a solid of C cells.

    Attributes
    ----------
    values : ndarray of float64, shape (K, C)
        One number for each mode and cell, orthonormal in the mass inner product.
    objectives : tuple of tuple of float
        For each mode, the fracture energy after each iteration; it never increases.
    restarts : int
        How many modes were begun again because their start lay among the modes before.
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
    """Find the first non-trivial scalar fracture modes of a solid.

    Parameters
    ----------
    solid : Solid
        Of C cells.
    count : int
        How many modes; fewer where the solid has not as many cells.
    progress : callable
        Hears the share that is done.
    solver : str
        Of each linear programme: "first-order", or "interior-point", which is Clarabel's, exact, and slower the more
        cells there are (benchmarks/modes.py).
    known : ndarray of float64, shape (K, C), optional
        Modes found before, after which to go on. They are not returned again.

    Returns
    -------
    Modes
        ``count`` of them, the weakest first.

    Raises
    ------
    BakeError
        If a solver fails, or there is none of that name.

    Notes
    -----
    Sellán et al. 2022, *Breaking Good*, Algorithm 1. Each mode minimises the area-weighted jumps between cells. It is
    orthogonal to the modes before and to the constants, and of unit length along its own previous iterate; it is
    iterated until it settles, from the Laplacian's eigenvector on. An iterate is feasible in the programme of the
    next, and no solution is shorter than it, so the energy never increases.
    """
    pairs, areas, conductance = neighbours(solid)
    cells = len(solid.volumes)
    mass = solid.volumes / solid.volumes.sum()
    modes = [np.ones(cells), *([] if known is None else known)]  # the constants are the mode of a body that stays whole
    first = len(modes) - 1
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
        basis = np.array(modes)
        if np.linalg.norm(basis * mass @ c) > REPEATED:
            c = rng.standard_normal(len(guesses)) @ guesses
            restarts += 1
        c = _orthogonal(c, modes, mass)
        programme.begin(c)
        energies: list[float] = []
        stalled = 0
        while len(energies) < ITERATIONS and stalled < programme.patience:
            u = _orthogonal(programme.solve(np.vstack([modes, [c]]) * mass, c), modes, mass)
            value = energy(u)
            if energies and value > energies[-1]:  # no exact solution does that; this one is not worth going on from
                break
            stalled = stalled + 1 if energies and value > (1 - SETTLED) * energies[-1] else 0
            change = np.sqrt(mass @ (u - c) ** 2)
            c = u
            energies.append(value)
            if change < SETTLED:
                break
        modes.append(c)
        history.append(tuple(energies))
        progress((k + 1) / count)
    return Modes(np.array(modes[first + 1 :]).reshape(-1, cells), tuple(history), restarts)


def _orthogonal(c: FloatArray, modes: list[FloatArray], mass: FloatArray) -> FloatArray:
    """Take the modes out of a vector and give it unit length, in the mass inner product."""
    basis = np.array(modes)
    c = c - (basis * mass @ c) @ basis
    return np.asarray(c / np.sqrt(mass @ c**2))


def atoms_from_modes(solid: Solid, modes: Modes) -> IntArray:
    """Group cells that no mode separates.

    Parameters
    ----------
    solid : Solid
        Of C cells.
    modes : Modes
        Of those cells.

    Returns
    -------
    ndarray of int64, shape (C,)
        The atom of each cell. Atoms smaller than ATOM_FLOOR have joined a neighbour.
    """
    pairs, areas, _ = neighbours(solid)
    jump = np.abs(modes.values[:, pairs[:, 0]] - modes.values[:, pairs[:, 1]])
    joined = (jump <= JUMP * jump.max(axis=1, keepdims=True)).all(axis=0)
    label = components(joined[None], pairs, len(solid.volumes))[0]
    return merge_small_regions(solid.volumes, pairs, areas, ATOM_FLOOR * float(solid.volumes.sum()), label)
