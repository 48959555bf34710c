"""One impact on a body that cracks: the force follows the energy of the contact as cracks make the body softer.

``sequential`` runs it. Offline only.

The impact grows from nothing, and one ramp gives what every severity breaks. What grows is the energy of approach per
mass, w. A contact with the energy w m, m the mass that it moves, presses with the force at which its own and the body's
compliance have taken that energy (``common.contact``). Cracks raise the compliance, so that w must grow before the next
face breaks, or let stresses rise so much that it breaks at once. Where the struck part comes off, the contact goes on
pressing on it, and the mass is that part's. Where that part is a crumb, what is left of the body is struck in its place
by what is left of the energy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.contact import ContactLaw, shared_stiffness
from .lattice import Lattice
from .sequential_cracks import Cracks, IntactBody

HEAVIEST = 1e3  # times the body's mass: what a contact moves at most whose forces balance each other
CARRIED = 0.5  # of a contact's force: the share that a part must have carried to be the part that is struck


@dataclass(frozen=True, eq=False)
class Contacts:
    """The K contacts of one impact.

    Attributes
    ----------
    points : ndarray of float64, shape (K, 3)
        Where they are.
    directions : ndarray of float64, shape (K, 3)
        Unit vectors along the forces.
    forces : ndarray of float64, shape (K,)
        How hard each presses on the intact body, in strength times L²; above 0.
    cells : ndarray of int64, shape (K,)
        The cell at each.
    """

    points: FloatArray
    directions: FloatArray
    forces: FloatArray
    cells: IntArray


@dataclass(frozen=True, eq=False)
class Setting:
    """What an impact depends on beside the body.

    Attributes
    ----------
    brittleness : float
        E G_c / (strength² L).
    strain : float
        Strength / E.
    hertz : float
        k of a contact, F = k d^(3/2), in E L^(1/2).
    smallest : float
        Share of the body's volume below which a part is a crumb.
    """

    brittleness: float
    strain: float
    hertz: float
    smallest: float


@dataclass(frozen=True, eq=False)
class Breaks:
    """The faces that an impact breaks as it grows.

    Attributes
    ----------
    faces : ndarray of int64, shape (B,)
        In order.
    factors : ndarray of float64, shape (B,)
        The factor on the contacts' forces at which each breaks; never falling.
    """

    faces: IntArray
    factors: FloatArray

    def whole(self, factor: float, count: int) -> BoolArray:
        """Find the faces that hold.

        Parameters
        ----------
        factor : float
            On the contacts' forces.
        count : int
            I, how many faces there are.

        Returns
        -------
        ndarray of bool, shape (I,)
            Whether each holds.
        """
        result = np.ones(count, dtype=bool)
        result[self.faces[self.factors <= factor]] = False
        return result


@dataclass(eq=False)
class _Blow:
    """Contacts that strike one part of the body together.

    ``shares`` (k, N) say how the force of each is shared among the cells of the part, up to a factor; ``forces`` (6 N,)
    is the pattern of all, of a total of 1; ``spent`` is the energy per mass that went into what came off before it, and
    ``reached`` that at which the last face broke.
    """

    contacts: IntArray
    shares: FloatArray
    cells: BoolArray
    forces: FloatArray
    hertz: float
    mass: float
    spent: float
    reached: float

    def needed(self, bearable: FloatArray, compliance: float, strain: float) -> FloatArray:
        """Compute the energy per mass (F,) at which the total force is what each of some faces can bear (F,)."""
        force = np.where(np.isfinite(bearable), bearable, 0.0) * strain
        energy = ContactLaw(self.hertz, compliance).energy(force) / self.mass + self.spent
        return np.where(np.isfinite(bearable), np.maximum(energy, self.reached), np.inf)


class Impact:
    """One impact on one body.

    Parameters
    ----------
    body : IntactBody
        Of N cells and I faces.
    contacts : Contacts
        Of the impact.
    setting : Setting
        What it depends on besides.
    """

    def __init__(self, body: IntactBody, contacts: Contacts, setting: Setting) -> None:
        self.body, self.contacts, self.setting = body, contacts, setting
        lattice = body.lattice
        chosen = range(len(contacts.forces))
        spread = [lattice.force(int(contacts.cells[k]), contacts.points[k], contacts.directions[k]) for k in chosen]
        shares = np.array([row.reshape(-1, 6)[:, :3] @ contacts.directions[k] for k, row in enumerate(spread)])
        everywhere = np.ones(len(lattice), dtype=bool)
        self._first = self._blow(np.arange(len(spread)), shares, everywhere, 0.0, 0.0)
        motions = lattice.intact.solve(self._first.forces)
        self._law = ContactLaw(self._first.hertz, float(lattice.answer(self._first.forces, motions)[1]))

    def run(self, largest: float, stop: Callable[[BoolArray], bool] | None = None) -> Breaks:
        """Let the impact grow.

        Parameters
        ----------
        largest : float
            The factor on the contacts' forces at which it has its full strength; may be infinite.
        stop : callable, optional
            Told the faces (I,) that hold whenever a part has come off; the ramp ends where it says so.

        Returns
        -------
        Breaks
            What breaks on the way. At most as many faces as there are cells: by then a body is rubble.
        """
        lattice, setting, total = self.body.lattice, self.setting, float(self.contacts.forces.sum())
        cracks = Cracks(self.body, setting.brittleness, self._first.forces)
        blows, labels = [self._first], np.zeros(len(lattice), dtype=np.int64)
        first = lattice.faces.pairs[:, 0]
        most = (
            float(self._law.energy(largest * total * setting.strain)) / self._first.mass if largest < np.inf else np.inf
        )
        faces: list[int] = []
        energies: list[float] = []
        while len(faces) < len(lattice):
            jumps = cracks.jumps()
            if cracks.open_cracks(jumps):
                continue
            bearable, pressed, _ = cracks.bearable(jumps)
            needed = np.full(len(bearable), np.inf)
            for blow in blows:
                struck = np.flatnonzero(blow.cells[first])
                on = np.repeat(blow.cells, 6)
                compliance = float(lattice.answer(blow.forces, np.where(on, cracks.motions, 0.0))[1])
                needed[struck] = blow.needed(bearable[struck], compliance, setting.strain)
            face = int(np.lexsort((bearable, needed))[0])
            if not (needed[face] <= most and np.isfinite(needed[face])):
                break
            for blow in blows:
                if blow.cells[first[face]]:
                    blow.reached = float(needed[face])
            faces.append(face)
            energies.append(float(needed[face]))
            cracks.release(face, bool(pressed[face]))
            now = cracks.labels
            if now.max() != labels.max():
                labels = now
                blows = [part for blow in blows for part in self._divide(blow, labels)]
                cracks.push(np.sum([blow.forces for blow in blows], axis=0))
                if stop is not None and stop(cracks.whole):
                    break
        reached = np.maximum.accumulate(np.array(energies))
        factors = self._law.peak_force(reached * self._first.mass) / (setting.strain * total)
        return Breaks(np.array(faces, dtype=np.int64), np.asarray(factors, dtype=np.float64))

    def _blow(self, contacts: IntArray, shares: FloatArray, cells: BoolArray, spent: float, reached: float) -> _Blow:
        """Let contacts strike a part: ``shares`` (k, N) say how each force is spread, up to a factor."""
        lattice, given = self.body.lattice, self.contacts
        weight = given.forces[contacts] / given.forces[contacts].sum()
        forces = np.zeros((len(lattice), 6))
        for k, contact in enumerate(contacts.tolist()):
            share = weight[k] * shares[k] / shares[k].sum()
            arm = given.points[contact] - share @ lattice.centroids / weight[k]
            forces[:, :3] += share[:, None] * given.directions[contact]
            forces[:, 3:] += share[:, None] * np.cross(arm, given.directions[contact])
        hertz = shared_stiffness(self.setting.hertz, weight)
        mass = _moved_mass(lattice, forces.ravel(), cells)
        return _Blow(contacts, shares, cells, forces.ravel(), hertz, mass, spent, reached)

    def _divide(self, blow: _Blow, labels: IntArray) -> list[_Blow]:
        """Share a blow among the parts (N,) that the body is in now."""
        if len(np.unique(labels[blow.cells])) == 1:
            return [blow]
        lattice = self.body.lattice
        volumes = lattice.cells.volumes
        inside = np.where(blow.cells, volumes, 0.0)
        volume = np.bincount(labels, inside)
        large = volume >= self.setting.smallest * volumes.sum()
        if not large.any():
            large = volume == volume.max()
        struck: dict[int, list[tuple[int, FloatArray, bool]]] = {}
        for contact, share in zip(blow.contacts.tolist(), blow.shares, strict=True):
            carried = np.where(large, np.bincount(labels, share, minlength=len(volume)), 0.0) / share.sum()
            kept = bool(carried.max() >= CARRIED)
            part = int(np.argmax(carried if carried.any() else np.where(large, volume, 0.0)))
            share = np.where(labels == part, share, 0.0)
            if not share.any():
                share = self._landed(contact, blow.cells & (labels == part))
            struck.setdefault(part, []).append((contact, share, kept))
        result = []
        for part, members in sorted(struck.items()):
            contacts = np.array([contact for contact, _, _ in members])
            shares = np.array([share for _, share, _ in members])
            spent = blow.spent if all(kept for _, _, kept in members) else blow.reached
            result.append(self._blow(contacts, shares, blow.cells & (labels == part), spent, blow.reached))
        return result

    def _landed(self, contact: int, cells: BoolArray) -> FloatArray:
        """Spread a contact's force over a part (N,) that has carried none of it: (N,), about its nearest cell."""
        lattice, given = self.body.lattice, self.contacts
        inside = np.flatnonzero(cells)
        distance = np.linalg.norm(lattice.centroids[inside] - given.points[contact], axis=1)
        nearest = int(inside[np.argmin(distance)])
        direction = given.directions[contact]
        force = lattice.force(nearest, given.points[contact], direction).reshape(-1, 6)
        return np.where(cells, force[:, :3] @ direction, 0.0)


def _moved_mass(lattice: Lattice, forces: FloatArray, cells: BoolArray) -> float:
    """Compute the mass that unit forces (6 N,) feel that move the part of some cells (N,) as a rigid one."""
    motions = np.where(np.repeat(cells, 6)[:, None], lattice.rigid_motions, 0.0)
    whole = motions.T @ forces
    response = float(whole @ np.linalg.solve(motions.T @ (lattice.mass_matrix @ motions), whole))
    volume = float(lattice.cells.volumes.sum())
    return 1.0 / max(response, 1.0 / (HEAVIEST * volume))
