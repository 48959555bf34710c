"""The two lattice simulators as testing machines for the specimens of ``physics_bodies``."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
from physics_bodies import Specimen, owner

from fracsim.common.arrays import BoolArray, FloatArray, IntArray
from fracsim.fracture.rule import components
from fracsim.simulators.base import interfaces_between, merge_small_pieces_each
from fracsim.simulators.lattice import Stiffness
from fracsim.simulators.piece_reading import PieceReading
from fracsim.simulators.sequential_cracks import CrackPath, IntactBody, crack_ramp
from fracsim.simulators.sequential_impact import Breaks, Contacts, Impact, Setting
from fracsim.simulators.softening import LEAST_LEFT, Softening
from fracsim.simulators.structural import StructuralOptions, group_cells
from fracsim.solids.solid import relabel

SMALLEST = 0.01  # of the body: what counts as a piece
PRECISION = 0.01  # of a critical factor
GROWTH = 1.3  # of the factor while the body holds
LARGEST = 200.0  # times the factor that opens a first crack; what still holds then does not break


class Engine(Protocol):
    """Breaks one specimen."""

    def __init__(self, specimen: Specimen, seed: int) -> None: ...

    def first_face(self) -> int:
        """Find the face that breaks first."""
        ...

    def critical(self) -> float:
        """Find the least load factor at which the body is in two pieces; infinite where it does not break."""
        ...

    def labels(self, factor: float) -> IntArray:
        """Find the piece of each of the N cells of the lattice under a load factor."""
        ...


def count_pieces(specimen: Specimen, labels: IntArray, least: float = SMALLEST) -> int:
    """Count the pieces of at least a share of the body."""
    return int((shares(specimen, labels) >= least).sum())


def shares(specimen: Specimen, labels: IntArray) -> FloatArray:
    """Measure the pieces as shares of the body, the largest first."""
    volumes = np.bincount(labels, specimen.solid.volumes)
    return np.sort(volumes / volumes.sum())[::-1]


class StructuralEngine:
    """All faces soften at once, under a load that is held or that of a hit; pieces are read off what is left."""

    def __init__(self, specimen: Specimen, seed: int) -> None:
        solid, faces = specimen.solid, specimen.lattice.faces
        atoms, options = StructuralOptions().atoms, specimen.options
        floor = max(SMALLEST, 1.0 / (3.0 * atoms)) * float(solid.volumes.sum())
        self.specimen = specimen
        self.atom = group_cells(solid, faces.pairs, faces.areas, atoms, floor, np.random.default_rng(seed))
        self.cells = relabel(solid, self.atom)
        volumes = self.cells.volumes
        self.reading = PieceReading(faces, solid.volumes, self.atom, volumes, interfaces_between(self.cells), SMALLEST)
        self.softening = Softening(specimen.lattice, options.brittleness, options.strain, options.hertz)
        self.start = None
        if specimen.cracked.any():
            left = np.where(specimen.cracked, LEAST_LEFT, 1.0)
            self.start = Stiffness(left, np.zeros(len(left), dtype=bool))

    @cached_property
    def tension(self) -> FloatArray:
        """(I,) on every face under a load of factor 1."""
        specimen = self.specimen
        lattice, stiffness = specimen.lattice, self.start or specimen.lattice.whole
        tension, _, _ = lattice.tension(lattice.jumps(lattice.factorise(stiffness).solve(specimen.forces)), stiffness)
        return np.where(specimen.cracked, 0.0, tension)

    def first_face(self) -> int:
        """Find the face that is pulled hardest."""
        return int(np.argmax(self.tension))

    def critical(self) -> float:
        """Bisect for the least factor that leaves two pieces."""
        low = high = 0.5 / float(self.tension.max())
        while not (broken := self.labels(high).any()) and high < LARGEST * low:
            high *= GROWTH
        if not broken:
            return np.inf
        low = high / GROWTH
        while high / low > 1.0 + PRECISION:
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if self.labels(middle).any() else (middle, high)
        return high

    def labels(self, factor: float) -> IntArray:
        """Join atoms over what is left between them."""
        specimen = self.specimen
        load = np.array([factor])
        left = self.softening.run(factor * specimen.forces, load, self.start, not specimen.direction.any())
        return self.reading.pieces(self.reading.left_of_interfaces(left))[self.atom]


class SequentialEngine:
    """Cracks run face by face, under a load that is held or that of a hit."""

    def __init__(self, specimen: Specimen, seed: int) -> None:
        options = specimen.options
        self.specimen = specimen
        self.body = IntactBody(specimen.lattice)
        self.interfaces = interfaces_between(specimen.solid)
        self.setting = Setting(options.brittleness, options.strain, options.hertz, SMALLEST)

    @property
    def struck(self) -> bool:
        """Whether the load is that of a hit."""
        return bool(self.specimen.direction.any())

    @cached_property
    def path(self) -> CrackPath:
        """How a held load cracks the body."""
        specimen = self.specimen
        brittleness = self.setting.brittleness
        return crack_ramp(self.body, specimen.forces, brittleness, specimen.cracked, smallest=SMALLEST)

    @cached_property
    def impact(self) -> Impact:
        """The hit."""
        specimen = self.specimen
        cell = np.array([owner(specimen.solid, specimen.point)])
        contacts = Contacts(specimen.point[None], specimen.direction[None], np.ones(1), cell)
        return Impact(self.body, contacts, self.setting)

    @cached_property
    def breaks(self) -> Breaks:
        """What a hit breaks until the body comes apart."""
        return self.impact.run(np.inf, lambda whole: bool(self.pieces(whole).any()))

    def pieces(self, whole: BoolArray) -> IntArray:
        """Find the piece of each cell that whole faces (I,) leave; crumbs join a neighbour."""
        volumes = self.specimen.solid.volumes
        labels = components(whole[None], self.interfaces.pairs, len(volumes))
        return merge_small_pieces_each(labels, volumes, self.interfaces, SMALLEST)[0]

    def first_face(self) -> int:
        """Find the face that breaks first."""
        return int((self.breaks if self.struck else self.path).faces[0])

    def critical(self) -> float:
        """Let the load grow until the body comes apart."""
        if not self.struck:
            return self.path.separation
        whole = self.breaks.whole(np.inf, len(self.interfaces))
        return float(self.breaks.factors[-1]) if self.pieces(whole).any() else np.inf

    def labels(self, factor: float) -> IntArray:
        """Let the load grow to a factor; a load that is held is taken away once the body comes apart."""
        count = len(self.interfaces)
        if self.struck:
            return self.pieces(self.impact.run(factor, None).whole(factor, count))
        whole = ~self.specimen.cracked
        whole[self.path.faces[self.path.factors <= factor]] = False
        return self.pieces(whole)


ENGINES: dict[str, type[Engine]] = {"sequential": SequentialEngine, "structural": StructuralEngine}
