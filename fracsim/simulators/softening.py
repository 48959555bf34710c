"""Faces that fail together: how the springs of a lattice soften under an impact, in a fixed number of steps.

``structural`` runs it and reads the pieces off what is left. Offline only.

Breaking one face after the other is right and chaotic: which face is first decides everything after it. Here all faces
that are pulled too hard lose stiffness at once, and the body is solved again. What is left of each face is a smooth
function of the impact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ..common.arrays import FloatArray, IntArray
from ..common.contact import ContactLaw, shared_stiffness
from .lattice import Lattice, Stiffness

STEPS = 8  # solutions of the body; the last ones change little
ENERGY = 2.0  # a face keeps the share (strength / stress)² of its stiffness: what it can bear of the energy in it
MOST_LOST = 0.02  # what a face keeps of its stiffness in a step, at least
GONE = 0.01  # of a face's stiffness: one that has no more holds nothing
LEAST_LEFT = 1e-4  # of a face's stiffness, so that loose cells keep a place
LEAST_TOUGHNESS = 0.05  # of its strength, that a face in front of a crack has left, at least
# Energy that a face of area A releases when it opens under a stress σ: RELEASE σ² A^(3/2) / E. For a round crack in a
# large body Sneddon 1946 gives 0.48.
RELEASE = 0.5


@dataclass(frozen=True, eq=False)
class Softening:
    """Softens the faces of one lattice.

    Attributes
    ----------
    lattice : Lattice
        Of I faces between N cells.
    brittleness : float
        E G_c / (strength² L).
    strain : float
        Strength / E.
    hertz : float
        k of a contact with what is hard, in E L^(1/2).
    steps : int
        Solutions of the body, at most.
    """

    lattice: Lattice
    brittleness: float
    strain: float
    hertz: float
    steps: int = STEPS

    @cached_property
    def front_strength(self) -> FloatArray:
        """(I,): the stress that each face can bear in front of a crack, over the strength.

        There a face of width h breaks by toughness, at a mean stress of about sqrt(E G_c / h).
        """
        return np.maximum(np.sqrt(self.brittleness / np.sqrt(self.lattice.faces.areas)), LEAST_TOUGHNESS)

    @cached_property
    def onset_strength(self) -> FloatArray:
        """(I,): the stress that each face can bear away from cracks, over the strength.

        It is the strength, unless the face is so small for the material that opening it would not release the energy
        that it takes (the coupled criterion of Leguillon 2002, *Strength or toughness? A criterion for crack onset at a
        notch*): a small granite figure is stronger than granite.
        """
        return np.maximum(self.front_strength / np.sqrt(RELEASE), 1.0)

    @cached_property
    def _neighbours(self) -> tuple[IntArray, IntArray]:
        """Each face and those it meets along an inner edge: where each face's begin, and which they are."""
        fronts, count = self.lattice.faces.fronts, len(self.lattice.faces)
        pairs = np.concatenate([fronts[:, [0, 1]], fronts[:, [0, 2]], fronts[:, [1, 2]]])
        own = np.arange(count)
        rows = np.concatenate([pairs[:, 0], pairs[:, 1], own])
        columns = np.concatenate([pairs[:, 1], pairs[:, 0], own])
        table = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
        table.sum_duplicates()
        return table.indptr[:-1].astype(np.int64), table.indices.astype(np.int64)

    def run(
        self, forces: FloatArray, severities: FloatArray, start: Stiffness | None = None, held: bool = False
    ) -> FloatArray:
        """Soften the faces under an impact.

        Parameters
        ----------
        forces : ndarray of float64, shape (6 N,)
            What the contacts press with on the intact body, spread over the cells, in strength times L².
        severities : ndarray of float64, shape (K,)
            The contacts' own forces.
        start : Stiffness, optional
            What is left of the springs before the impact, of a body with a crack; all of them by default.
        held : bool
            Whether the forces stay as they are however the body gives way: a weight, a testing machine.

        Returns
        -------
        ndarray of float64, shape (I,)
            The share of each face's stiffness that is left.

        Notes
        -----
        The force follows from energy. What the intact body takes up to the peak force is the energy of approach, that
        of the mass which the force moves. As faces fail, the springs that are left take more of it for the same force;
        and a part that comes loose is all that the force still moves, so only its share of the energy is still to
        come. With u the response to a unit force, the mass is 1 / (s⁴ uᵀ M u): that of the whole body for a body that
        moves as one.
        """
        lattice, total = self.lattice, float(severities.sum())
        if total == 0.0:
            return (start or lattice.whole).left
        unit = forces / total
        hertz = shared_stiffness(self.hertz, severities / total)
        stiffness, begin, neighbours = start or lattice.whole, *self._neighbours
        approach = motion = 0.0
        for step in range(self.steps):
            factor = lattice.intact if step == 0 and start is None else lattice.factorise(stiffness)
            response = factor.solve(unit)
            jumps = lattice.jumps(response)
            moved, compliance = (float(number) for number in lattice.answer(unit, response))
            law = ContactLaw(hertz, compliance)
            if step == 0:
                force, motion = total * self.strain, moved
                approach = float(law.energy(force))
            elif not held:
                force = float(law.peak_force(approach * min(1.0, motion / moved)))
            tension, _, pressure = lattice.tension(jumps * (force / self.strain), stiffness)
            left = stiffness.left
            weakest = np.minimum.reduceat(left[neighbours], begin)
            strength = self.front_strength + (self.onset_strength - self.front_strength) * weakest
            # The stress in what is left of a face, not over its whole area: a damaged face goes on failing.
            bearable = strength * left
            if not (left[tension > bearable] > GONE).any():  # what still fails holds nothing any more
                break
            kept = np.minimum(bearable / np.maximum(tension, 1e-300), 1.0) ** ENERGY
            softer = np.maximum(left * np.maximum(kept, MOST_LOST), LEAST_LEFT)
            stiffness = Stiffness(softer, pressure)
        return stiffness.left
