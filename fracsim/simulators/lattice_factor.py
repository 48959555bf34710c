"""A lattice's system of equations, factorised in an order that fills in little. ``lattice`` solves with it.

Offline only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from ..common.arrays import FloatArray, IntArray

OPTIONS = {"SymmetricMode": True, "Equil": False}


@dataclass(frozen=True, eq=False)
class Factor:
    """A factorised system.

    Attributes
    ----------
    lu : SuperLU
        Of the ordered system.
    place : ndarray of int64, shape (6 N,)
        Where each unknown stands in the order.
    """

    lu: SuperLU
    place: IntArray

    def solve(self, forces: FloatArray) -> FloatArray:
        """Solve for the motions of the cells.

        Parameters
        ----------
        forces : ndarray of float64, shape (6 N,) or (6 N, R)
            On the cells.

        Returns
        -------
        ndarray of float64, of the same shape
            Their motions.
        """
        ordered = np.empty_like(forces)
        ordered[self.place] = forces
        return np.asarray(self.lu.solve(ordered)[self.place])


def filling_least(pairs: IntArray, count: int) -> IntArray:
    """Find the order of cells in which a factorisation fills in least, as SuperLU finds it on the graph of cells.

    Parameters
    ----------
    pairs : ndarray of int64, shape (I, 2)
        Which cells are joined.
    count : int
        N, the number of cells.

    Returns
    -------
    ndarray of int64, shape (N,)
        The place of each cell.
    """
    graph = sp.coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    graph = sp.csc_matrix(graph + graph.T + sp.diags(np.full(count, float(count))))
    order = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=OPTIONS).perm_c
    return np.asarray(order, dtype=np.int64)


def factorise(system: sp.csc_matrix, place: IntArray) -> Factor:
    """Factorise an ordered system.

    Parameters
    ----------
    system : scipy.sparse.csc_matrix, shape (n, n)
        Symmetric and positive definite, in the order of ``place``.
    place : ndarray of int64, shape (n,)
        Where each unknown stands in it.

    Returns
    -------
    Factor
        It solves for right sides in the unknowns' own order.
    """
    return Factor(splu(system, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=OPTIONS), place)
