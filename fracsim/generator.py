"""The door behind which the truth stands: blows go in, and which parts of a body stay together comes out.

``Generator`` is the interface that datasets, training and baking rely on; ``ModalGenerator`` stands behind it by
default. ``elastic.ElasticGenerator`` drives the same atoms by another physics, ``radial.RadialGenerator`` has none of
them. Offline only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from .breaking import Interfaces, absorb_crumbs, components, drives, weakest_cut
from .errors import BakeError, MissingExtraError
from .fracture_modes import Modes, atoms, fracture_modes, impact_field
from .mesh import Surface
from .sampling import SurfacePoints
from .solid import Solid, coarsen, cut_lattice, relabel, shared_faces

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError("threadpoolctl", "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

TRUTHS = ("modal", "elastic", "radial")


@dataclass(frozen=True, eq=False)
class Blows:
    """N blows on a surface, each of up to K contacts acting together.

    faces: (N, K) and barycentric: (N, K, 3), where on the surface; directions: (N, K, 3), unit.
    severities: (N, K), impulse / (mass * breaking velocity), 0 where there is no contact.
    """

    faces: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray

    def __len__(self) -> int:
        return len(self.faces)

    def times(self, factor: FloatArray) -> Blows:
        """The same blows, each ``factor`` (N,) as severe."""
        return Blows(self.faces, self.barycentric, self.directions, self.severities * factor[:, None])


@dataclass(frozen=True, eq=False)
class Response:
    """What N blows do.

    labels: (N, P), the piece of each part of the generator's body, from 0; all 0 where nothing parts.
    broken: (N, I), the interfaces between neighbouring parts that gave way, where the generator knows them; one
    that broke within a piece, its sides being joined another way, parts nothing.
    """

    labels: IntArray
    broken: BoolArray | None = None


class Generator(Protocol):
    """A truth about how one body breaks. Deterministic: a blow has one answer.

    surface: of largest extent 1, with V vertices. parts: P parts whose outside is that surface exactly; labels
    speak of them, and cracks run where they meet. fixed_cracks: whether the parts are so few that distances to
    each of their interfaces are worth keeping (pieces are unions of few parts, not free shapes among many).
    A generator of fixed cracks may also have ``cells``, a finer Solid, and ``atom``, the part of each of its cells;
    baking then sees the body through them.
    """

    @property
    def surface(self) -> Surface: ...

    @property
    def parts(self) -> Solid: ...

    @property
    def fixed_cracks(self) -> bool: ...

    def thresholds(self, blows: Blows) -> FloatArray:
        """(N,) the factor by which each blow's severities have to be multiplied for it just to part the body."""
        ...

    def fracture(self, blows: Blows) -> Response: ...


@dataclass(frozen=True, eq=False)
class ModalGenerator:
    """Fracture modes (Sellán et al. 2022), momentum diffusion and the breaking rule of ``breaking.drives``.

    cells: the fine solid; atom: (C,), the atom of each cell; parts: the atoms. rows: (V, A), the impact field at
    each vertex. crumb_floor: fraction of the volume below which a piece joins a neighbour.
    energies: per mode, its fracture energy after each iteration.
    """

    surface: Surface
    cells: Solid
    atom: IntArray
    parts: Solid
    interfaces: Interfaces
    rows: FloatArray
    crumb_floor: float
    energies: tuple[tuple[float, ...], ...]
    fixed_cracks: bool = True

    @cached_property
    def points(self) -> SurfacePoints:
        return SurfacePoints(self.surface.vertices, self.surface.faces)

    def drives(self, blows: Blows) -> FloatArray:
        """(N, I) effective jumps across the interfaces, 1 being what breaks them; proportional to severity."""
        field = self.points.rows(self.rows, blows.faces, blows.barycentric)
        return drives(field, blows.directions, blows.severities, self.interfaces)

    def thresholds(self, blows: Blows) -> FloatArray:
        return just_parting(self.drives(blows), self.parts, self.interfaces)

    def fracture(self, blows: Blows) -> Response:
        return fall_apart(self.drives(blows) >= 1.0, self.parts, self.interfaces, self.crumb_floor)


def modal_generator(
    surface: Surface,
    rng: np.random.Generator,
    cells: int = 5000,
    modes: int = 20,
    crumb_floor: float = 1e-3,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> ModalGenerator:
    """Build the default truth of a surface; ``progress`` hears the stage and its share done.

    cells: of the solid, about. modes: fracture modes. Raises BakeError when the surface cannot be cut into cells
    or no mode parts it.
    """
    progress("solid", 0.0)
    solid = cut_lattice(surface, cells, rng)
    progress("modes", 0.0)
    found = fracture_modes(solid, modes, lambda share: progress("modes", share))
    progress("atoms", 0.0)
    return modal_from(surface, solid, found, crumb_floor, progress)


def modal_from(
    surface: Surface,
    cells: Solid,
    modes: Modes,
    crumb_floor: float,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> ModalGenerator:
    """The modal truth of a solid whose modes are known."""
    atom = atoms(cells, modes)
    parts = coarsen(relabel(cells, atom), surface)
    joints = interfaces_between(parts)
    if len(joints) == 0:
        raise BakeError(f"{surface.name}: no fracture mode parts it; raise the number of modes or cells")
    progress("impact", 0.0)
    rows = impact_field(cells, atom, surface.vertices)
    return ModalGenerator(surface, cells, atom, parts, joints, rows, crumb_floor, modes.objectives)


def interfaces_between(parts: Solid) -> Interfaces:
    """Where neighbouring parts of a solid meet."""
    pairs, areas, vectors = shared_faces(parts.triangles, parts.sides, parts.points)
    projected = np.linalg.norm(vectors, axis=1)
    # A crack that folds back on itself may have no mean direction; any will do, its projected area being 0.
    normals = vectors / np.maximum(projected, 1e-300)[:, None]
    return Interfaces(pairs, areas, normals, projected)


def just_parting(drives: FloatArray, parts: Solid, interfaces: Interfaces) -> FloatArray:
    """(N,) the factors on drives (N, I) at which the parts first fall apart."""
    return 1.0 / weakest_cut(drives, interfaces.pairs, len(parts.volumes))


def fall_apart(broken: BoolArray, parts: Solid, interfaces: Interfaces, crumb_floor: float) -> Response:
    """What is left when interfaces give way: broken (N, I)."""
    labels = components(~broken, interfaces.pairs, len(parts.volumes))
    return Response(absorb_all(labels, parts.volumes, interfaces, crumb_floor), broken)


def absorb_all(labels: IntArray, volumes: FloatArray, interfaces: Interfaces, floor: float) -> IntArray:
    """``breaking.absorb_crumbs`` over the rows of labels (N, P)."""
    share = volumes / volumes.sum()
    if share.min() >= floor:  # then no piece can be a crumb
        return labels
    return np.array([absorb_crumbs(row, share, interfaces, floor) for row in labels]).reshape(labels.shape)


@dataclass(frozen=True)
class TruthOptions:
    """What ``make_generator`` builds.

    truth: "modal"; "elastic", the modal atoms driven apart by elastic stress; or "radial". cells: of the solid, about.
    modes: fracture modes, which radial cracks do without. crumb_floor: of the volume; smaller pieces join a
    neighbour.
    """

    truth: str = "modal"
    cells: int = 5000
    modes: int = 20
    crumb_floor: float = 1e-3

    def __post_init__(self) -> None:
        if self.truth not in TRUTHS:
            raise BakeError(f"unknown truth {self.truth!r}; use {' or '.join(TRUTHS)}")
        for name, least in (("cells", 50), ("modes", 0)):
            if not (isinstance(getattr(self, name), int) and getattr(self, name) >= least):
                raise BakeError(f"{name} must be a whole number and at least {least}, got {getattr(self, name)}")
        if not 0.0 <= self.crumb_floor < 1.0:
            raise BakeError(f"crumb_floor must be at least 0 and below 1, got {self.crumb_floor}")


def make_generator(
    surface: Surface,
    options: TruthOptions,
    seed: int,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> Generator:
    """The truth of a surface, the same for the same seed (the elastic one but nearly so: fTetWild, which makes its
    mesh, does not repeat itself). Raises BakeError when the surface cannot be cut up."""
    if seed < 0:
        raise BakeError(f"a seed must be at least 0, got {seed}")
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        if options.truth == "radial":
            from .radial import radial_generator

            progress("solid", 0.0)
            return radial_generator(surface, rng, options.cells, options.crumb_floor)
        modal = modal_generator(surface, rng, options.cells, options.modes, options.crumb_floor, progress)
    if options.truth == "elastic":
        from .elastic import elastic_generator

        return elastic_generator(modal, progress=progress)
    return modal
