"""Solvers of the linear programmes that fracture modes come from. Offline only; ``fracture_modes`` alone uses them.

Each programme minimises the area-weighted jumps Σ areas |u_a - u_b| between cells, under linear equalities.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError, MissingExtraError
from ..solids.spectrum import difference_operator

try:
    import clarabel
except ImportError as error:
    raise MissingExtraError("clarabel", "bake") from error

STEPS = 1000  # first-order steps a programme, for 5,000 cells
TOLERANCE = 1e-9  # of the squared length of an iterate: a smaller squared residual ends the steps
CHECKED_EVERY = 25  # steps: a check costs about as much as one
RESTART = 0.09  # of the squared residual: how far it has to fall before the steps start from a new anchor


def linear_programme(pairs: IntArray, areas: FloatArray, rows: FloatArray) -> FloatArray:
    """Minimise Σ areas |u_a - u_b| under rows @ u = (0, ..., 0, 1), by Clarabel's interior-point method.

    Parameters
    ----------
    pairs : ndarray of int64, shape (I, 2)
        Neighbouring cells a and b.
    areas : ndarray of float64, shape (I,)
        What they share.
    rows : ndarray of float64, shape (K, C)
        The equalities.

    Returns
    -------
    ndarray of float64, shape (C,)
        The minimiser u.

    Raises
    ------
    BakeError
        If the solver does not solve it.
    """
    cells, faces = rows.shape[1], len(pairs)
    # Units in which costs and unknowns are about 1 keep the interior-point method well conditioned.
    cost = areas / areas.mean() / faces
    difference, identity = difference_operator(pairs, np.ones(faces), cells), sp.identity(faces, format="csr")
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


class InteriorPoint:
    """Solves every programme to the end, by Clarabel.

    Attributes
    ----------
    patience : int
        How many iterations of a mode in a row may gain next to nothing before it counts as settled.
    pairs : ndarray of int64, shape (I, 2)
        Neighbouring cells.
    areas : ndarray of float64, shape (I,)
        What they share.
    """

    patience = 1

    def __init__(self, pairs: IntArray, areas: FloatArray) -> None:
        self.pairs, self.areas = pairs, areas

    def begin(self, c: FloatArray) -> None:
        """Begin a mode.

        Parameters
        ----------
        c : ndarray of float64, shape (C,)
            Where it starts; an exact solver does not need it.
        """

    def solve(self, rows: FloatArray, c: FloatArray) -> FloatArray:
        """Solve a programme.

        Parameters
        ----------
        rows : ndarray of float64, shape (K, C)
            Its equalities, rows @ u = (0, ..., 0, 1).
        c : ndarray of float64, shape (C,)
            The iterate before; an exact solver does not need it.

        Returns
        -------
        ndarray of float64, shape (C,)
            The minimiser.

        Raises
        ------
        BakeError
            If the solver does not solve it.
        """
        return linear_programme(self.pairs, self.areas, rows)


class FirstOrder:
    """Takes primal-dual steps, each programme from where the one before ended.

    Attributes
    ----------
    patience : int
        How many iterations of a mode in a row may gain next to nothing before it counts as settled.
    pairs : ndarray of int64, shape (I, 2)
        Neighbouring cells.
    primal, dual : ndarray of float64, shape (C,) and (I,)
        Step sizes of cells and pairs (Pock and Chambolle 2011, Eq. 10).
    up, down : scipy.sparse.csr_matrix of float32, shape (I, C) and (C, I)
        The weighted jumps and their transpose, times the step sizes.
    steps : int
        The most steps of one programme.
    y : ndarray of float32, shape (I,)
        The dual variable.

    Notes
    -----
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
        jump = difference_operator(pairs, weights, cells)
        self.primal = 1.0 / np.bincount(pairs.ravel(), np.repeat(weights, 2), minlength=cells)
        self.dual = 0.5 / weights
        # Single precision halves the memory that a step moves; what it loses is far below the tolerance.
        self.up = sp.csr_matrix(sp.diags(self.dual) @ jump).astype(np.float32)
        self.down = sp.csr_matrix(sp.diags(self.primal) @ jump.T).astype(np.float32)
        self.steps = round(STEPS * (cells / 5000) ** (1 / 3))

    def begin(self, c: FloatArray) -> None:
        """Begin a mode.

        Parameters
        ----------
        c : ndarray of float64, shape (C,)
            Where it starts; the dual variable begins at the signs of its jumps.
        """
        self.y = np.sign(c[self.pairs[:, 0]] - c[self.pairs[:, 1]]).astype(np.float32)

    def solve(self, rows: FloatArray, c: FloatArray) -> FloatArray:
        """Take steps towards the solution of a programme.

        Parameters
        ----------
        rows : ndarray of float64, shape (K, C)
            Its equalities, rows @ u = (0, ..., 0, 1).
        c : ndarray of float64, shape (C,)
            The iterate before, where u starts.

        Returns
        -------
        ndarray of float64, shape (C,)
            Nearly the minimiser.

        Raises
        ------
        BakeError
            If the steps diverge.
        """
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
            if since % CHECKED_EVERY == 0:
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
