"""What a fracture simulator is: impacts go in, and which cells of a body stay together comes out.

Datasets, learning and baking know simulators by the protocols here and by nothing else; the functions below them are
shared by the simulators themselves. Offline only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.material import Material
from ..fracture.rule import Interfaces, components, merge_small_pieces, weakest_cut
from ..solids.solid import Solid, shared_faces
from ..solids.surface import Surface

if TYPE_CHECKING:
    from .registry import SimulatorOptions

# What a simulator keeps of itself in a dataset: arrays by name, and numbers, text and lists of them by name.
State = tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]
Progress = Callable[[str, float], None]  # hears the name of a stage and the share of it that is done, 0 to 1


def no_progress(stage: str, share: float) -> None:
    """Hear nothing."""


@dataclass(frozen=True, eq=False)
class Impacts:
    """N impacts on a surface, each of up to K contacts that act together.

    Attributes
    ----------
    faces : ndarray of int64, shape (N, K)
        The face of the surface that each contact lies on.
    barycentric : ndarray of float64, shape (N, K, 3)
        Where on the face: the weights of its corners, which sum to 1.
    directions : ndarray of float64, shape (N, K, 3)
        Unit vectors along the impulses.
    severities : ndarray of float64, shape (N, K)
        How hard each contact is, without unit; 0 where there is no contact. Of a simulator whose ``severity_kind`` is
        "impulse": the impulse over mass, gauge and critical velocity. Of one whose kind is "force": the peak force
        over strength times the square of the largest extent.
    """

    faces: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray

    def __len__(self) -> int:
        return len(self.faces)

    def points(self, surface: Surface) -> FloatArray:
        """Say where the contacts are.

        Parameters
        ----------
        surface : Surface
            What the impacts are on.

        Returns
        -------
        ndarray of float64, shape (N, K, 3)
            In the unit of the surface's vertices.
        """
        corner = surface.vertices[surface.faces[self.faces]]
        return np.asarray(np.einsum("nkc,nkci->nki", self.barycentric, corner))

    def times(self, factor: FloatArray) -> Impacts:
        """Scale the severities.

        Parameters
        ----------
        factor : ndarray of float64, shape (N,)
            One factor for each impact.

        Returns
        -------
        Impacts
            The same impacts, each ``factor`` times as severe.
        """
        return Impacts(self.faces, self.barycentric, self.directions, self.severities * factor[:, None])


@dataclass(frozen=True, eq=False)
class Response:
    """What N impacts do to a body of C cells.

    Attributes
    ----------
    labels : ndarray of int64, shape (N, C)
        The piece that each cell belongs to, from 0; all 0 where the body stays whole.
    broken : ndarray of bool, shape (N, I), or None
        The interfaces between neighbouring cells that break, where the simulator knows them. An interface may break
        inside a piece: its two sides are then still joined by another way.
    """

    labels: IntArray
    broken: BoolArray | None = None


class FractureSimulator(Protocol):
    """Says how one body breaks; the same impact always has the same answer.

    Attributes
    ----------
    surface : Surface
        The body's surface, of largest extent 1, with V vertices.
    cells : Solid
        The C cells that labels speak of. Their outside is the surface exactly, and cracks run where they meet.
    fixed_cracks : bool
        Whether the cells are so few that the distances to each of their interfaces are worth keeping: pieces are
        unions of few cells, not free shapes among many.

    See Also
    --------
    FineCells, ImpactField, ContactCompliance, Described : what a simulator may have besides.
    RegisteredSimulator : what it must have besides to be known by a name.
    """

    @property
    def surface(self) -> Surface:
        """The body's surface."""
        ...

    @property
    def cells(self) -> Solid:
        """The cells that labels speak of."""
        ...

    @property
    def fixed_cracks(self) -> bool:
        """Whether cracks run only between few cells."""
        ...

    def thresholds(self, impacts: Impacts) -> FloatArray:
        """Find how severe each impact must be to break the body.

        Parameters
        ----------
        impacts : Impacts
            N impacts.

        Returns
        -------
        ndarray of float64, shape (N,)
            The least factor on each impact's severities at which the body falls into two pieces.
        """
        ...

    def fracture(self, impacts: Impacts) -> Response:
        """Break the body by each impact.

        Parameters
        ----------
        impacts : Impacts
            N impacts, each on the whole body.

        Returns
        -------
        Response
            The pieces of each.
        """
        ...


@runtime_checkable
class FineCells(Protocol):
    """A simulator whose cells are themselves made of smaller cells, which baking then uses for the body's inside.

    Attributes
    ----------
    fine_cells : Solid
        F cells, of the same body.
    fine_to_cell : ndarray of int64, shape (F,)
        The cell that each fine cell is a part of.
    """

    @property
    def fine_cells(self) -> Solid:
        """The smaller cells."""
        ...

    @property
    def fine_to_cell(self) -> IntArray:
        """The cell of each smaller cell."""
        ...


@runtime_checkable
class ImpactField(Protocol):
    """A simulator that breaks interfaces by ``fracture.rule.load_ratios`` from an impact field of its own.

    Attributes
    ----------
    impact_field : ndarray of float64, shape (V, C)
        How a unit impact at each vertex spreads over the cells; of volume-weighted mean 1 over each row.
    """

    @property
    def impact_field(self) -> FloatArray:
        """How a unit impact spreads."""
        ...


@runtime_checkable
class ContactCompliance(Protocol):
    """A simulator that knows how far its body yields under a contact, which limits the force of an impulse.

    Attributes
    ----------
    compliance : ndarray of float64, shape (V,)
        How far the surface at each vertex gives way to a unit force along its normal, beyond what the body moves as a
        whole; in units of 1 / (Young's modulus * largest extent).
    """

    @property
    def compliance(self) -> FloatArray:
        """How far each vertex gives way."""
        ...


@runtime_checkable
class MaterialDependent(Protocol):
    """A simulator's class whose options depend on what the body is made of, and how large it is."""

    @classmethod
    def material_options(cls, material: Material, size: float) -> dict[str, float]:
        """Work out the options of a body.

        Parameters
        ----------
        material : Material
            What it is made of.
        size : float
            m, its largest extent.

        Returns
        -------
        dict of str to float
            Options of its ``options_type``, by name. Whatever a user sets goes before them.
        """
        ...


@runtime_checkable
class Described(Protocol):
    """A simulator that has figures of its own for an asset's metadata."""

    def figures(self) -> dict[str, Any]:
        """Collect the figures.

        Returns
        -------
        dict
            Of what JSON can hold, by name.
        """
        ...


class RegisteredSimulator(FractureSimulator, Protocol):
    """What a class must carry to be known by a name (``fracsim.register_simulator``).

    Attributes
    ----------
    options_type : type
        ``SimulatorOptions``, or a dataclass derived from it that adds options with defaults.
    repeatable : bool
        Whether ``build`` with the same seed gives the same bits again, so that a dataset can be made again from its
        header alone.
    driven_by_impact_field : bool
        Whether its instances are an ``ImpactField``.
    severity_kind : str
        "force" or "impulse": what severities are to it, see ``Impacts``. A class that does not say means "impulse".

    See Also
    --------
    MaterialDependent, capabilities.Slow : what such a class may have besides.
    """

    options_type: ClassVar[type[SimulatorOptions]]
    repeatable: ClassVar[bool]
    driven_by_impact_field: ClassVar[bool]
    severity_kind: ClassVar[str]

    @classmethod
    def build(cls, surface: Surface, options: Any, rng: np.random.Generator, progress: Progress = no_progress) -> Self:
        """Make the simulator of a surface.

        Parameters
        ----------
        surface : Surface
            Of largest extent 1.
        options : SimulatorOptions
            Of the class's ``options_type``.
        rng : numpy.random.Generator
            The only source of chance.
        progress : callable
            Hears the stage and the share of it that is done.

        Returns
        -------
        RegisteredSimulator
            An instance of this class.

        Raises
        ------
        BakeError
            If the surface cannot be simulated so.
        """
        ...

    def state(self) -> State:
        """Collect what a dataset keeps of the simulator beside its surface, cells and interfaces.

        Returns
        -------
        arrays : dict of ndarray
            Of floats or integers, by name; a slash in a name groups.
        numbers : dict
            Of what JSON can hold.
        """
        ...

    @classmethod
    def restore(
        cls,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        arrays: Mapping[str, npt.NDArray[Any]],
        numbers: Mapping[str, Any],
    ) -> Self:
        """Make a simulator again that answers with the same bits as the one whose state was kept.

        Parameters
        ----------
        surface : Surface
            As it was.
        cells : Solid
            As they were.
        interfaces : Interfaces
            As ``interfaces_between(cells)`` was.
        arrays, numbers : mapping
            What ``state`` gave. Floats are of the dtype they had, integers int64.

        Returns
        -------
        RegisteredSimulator
            An instance of this class.
        """
        ...


def interfaces_between(cells: Solid) -> Interfaces:
    """Find where neighbouring cells of a solid meet.

    Parameters
    ----------
    cells : Solid
        Of C cells.

    Returns
    -------
    Interfaces
        One for each pair of cells that share an area.
    """
    pairs, areas, vectors = shared_faces(cells.triangles, cells.sides, cells.points)
    projected = np.linalg.norm(vectors, axis=1)
    # A crack that folds back on itself may have no mean direction; any will do, its projected area being 0.
    normals = vectors / np.maximum(projected, 1e-300)[:, None]
    return Interfaces(pairs, areas, normals, projected)


def critical_load_factor(load_ratios: FloatArray, cells: Solid, interfaces: Interfaces) -> FloatArray:
    """Find the factors at which loads first break a body in two.

    Parameters
    ----------
    load_ratios : ndarray of float64, shape (N, I)
        Load over strength of each interface.
    cells : Solid
        The body's cells.
    interfaces : Interfaces
        The I interfaces between them.

    Returns
    -------
    ndarray of float64, shape (N,)
        The factor on each row.
    """
    return 1.0 / weakest_cut(load_ratios, interfaces.pairs, len(cells.volumes))


def pieces_from_broken(
    broken: BoolArray, cells: Solid, interfaces: Interfaces, min_piece_volume_fraction: float
) -> Response:
    """Find the pieces that remain when interfaces break.

    Parameters
    ----------
    broken : ndarray of bool, shape (N, I)
        The interfaces that break.
    cells : Solid
        The body's C cells.
    interfaces : Interfaces
        The I interfaces between them.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the body's volume, join a neighbour.

    Returns
    -------
    Response
        Labels (N, C) and ``broken``.
    """
    labels = components(~broken, interfaces.pairs, len(cells.volumes))
    return Response(merge_small_pieces_each(labels, cells.volumes, interfaces, min_piece_volume_fraction), broken)


def merge_small_pieces_each(
    labels: IntArray, volumes: FloatArray, interfaces: Interfaces, min_piece_volume_fraction: float
) -> IntArray:
    """Apply ``fracture.rule.merge_small_pieces`` to many bodies.

    Parameters
    ----------
    labels : ndarray of int64, shape (N, C)
        The piece of each cell.
    volumes : ndarray of float64, shape (C,)
        Of the cells, in any unit.
    interfaces : Interfaces
        Between the cells.
    min_piece_volume_fraction : float
        Smaller pieces, as fractions of the whole volume, join a neighbour.

    Returns
    -------
    ndarray of int64, shape (N, C)
        The piece of each cell now.
    """
    share = volumes / volumes.sum()
    if share.min() >= min_piece_volume_fraction:  # then no piece can be too small
        return labels
    merged = [merge_small_pieces(row, share, interfaces, min_piece_volume_fraction) for row in labels]
    return np.array(merged).reshape(labels.shape)
