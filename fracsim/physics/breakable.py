"""What a world asks of things that break: protocols that assets, their pieces and a user's own objects satisfy.

`World.add`, the verdicts and the replacement know breakable things by these protocols only.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from ..common.contact import LOAD_DURATION
from ..common.errors import PhysicsError

if TYPE_CHECKING:
    from ..common.arrays import FloatArray, IntArray
    from ..common.impulse import Impulse
    from ..fracture.pieces import ConvexParts, Piece
    from ..fracture.result import Fracture


class BreakableMaterial(Protocol):
    """What contacts and cracks need to know of a material; `fracsim.Material` has it."""

    @property
    def friction(self) -> float:
        """Coefficient of friction of contacts, dimensionless."""

    @property
    def restitution(self) -> float:
        """Coefficient of restitution of contacts, 0 to 1."""

    @property
    def fracture_energy(self) -> float:
        """Energy that opens a unit of crack area, J/m²."""


@runtime_checkable
class ElasticMaterial(Protocol):
    """What the contact law needs to know of a material besides; `fracsim.Material` has it."""

    @property
    def youngs_modulus(self) -> float:
        """Young's modulus, Pa."""

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio."""


@runtime_checkable
class ElasticBreakable(Protocol):
    """What a breakable thing has besides if it gives way to forces. Others count as rigid."""

    @property
    def material(self) -> ElasticMaterial:
        """Material of the whole object."""

    @property
    def severity_kind(self) -> str:
        """What breaks it: "impulse", or "force", the peak force of contacts."""

    @property
    def bearable_force(self) -> float:
        """Lasting force that breaks nothing wherever it acts, alone or as the sum of several, N."""

    def compliance_at(self, points: FloatArray) -> FloatArray:
        """Give how far the surface gives way to a force, beyond what the body moves as a whole.

        Parameters
        ----------
        points : ndarray of float64, shape (K, 3)
            m, in the object's frame.

        Returns
        -------
        ndarray of float64, shape (K,)
            m/N.
        """


class Breakable(Protocol):
    """Something that may break: an asset, a piece of one, or an object of a user's own.

    Lengths are in metres and points in the object's own frame. A piece is in the frame of its
    object.
    """

    @property
    def name(self) -> str:
        """Name for messages."""

    @property
    def material(self) -> BreakableMaterial:
        """Material of the whole object."""

    @property
    def size(self) -> float:
        """Largest extent of the unbroken object, m."""

    @property
    def mass(self) -> float:
        """Mass, kg."""

    @property
    def center_of_mass(self) -> FloatArray:
        """Centre of mass, shape (3,), m."""

    @property
    def reach(self) -> float:
        """Distance from the centre of mass to the furthest point, m."""

    @property
    def convex_parts(self) -> ConvexParts:
        """Convex parts that the engine collides."""

    @property
    def bearable_impulse(self) -> float:
        """Impulse that breaks nothing wherever it acts, alone or as the sum of several, N·s."""

    @property
    def volume_fraction(self) -> float:
        """Volume as a share of the unbroken object's, above 0 and at most 1."""

    def may_break(self, impulses: Sequence[Impulse]) -> bool:
        """Tell whether impulses that act together may break it; False only where they surely do not.

        Parameters
        ----------
        impulses : sequence of Impulse
            What acts on it, in its own frame (m, N·s).

        Returns
        -------
        bool
            False saves the question to the model.
        """

    def fracture(self, impulses: Sequence[Impulse]) -> Fracture:
        """Ask the model what impulses that act together do.

        Parameters
        ----------
        impulses : sequence of Impulse
            What acts on it, in its own frame (m, N·s), strongest first.

        Returns
        -------
        Fracture
            The pieces; a single one where it holds.

        Raises
        ------
        FracsimError
            Where the model has no answer that makes sense. The world then leaves the body whole and warns once. Any
            other exception is a fault in the model's code: it leaves `World.step` as it is.
        """

    def unbroken(self) -> Fracture:
        """Give the answer to no impulse at all, without asking the model."""

    def breakable_piece(self, piece: Piece) -> Breakable:
        """Make one of its pieces something that breaks in turn.

        Parameters
        ----------
        piece : Piece
            One of the pieces that `fracture` returned.

        Returns
        -------
        Breakable
            The piece, in the same frame.
        """


class BreakableObject(Breakable, Protocol):
    """An unbroken object, as `World.add` takes it."""

    @property
    def vertices(self) -> FloatArray:
        """Vertices of the surface, shape (V, 3), m."""

    @property
    def faces(self) -> IntArray:
        """Triangles of the surface, shape (F, 3)."""

    @property
    def inertia(self) -> FloatArray:
        """Inertia about the centre of mass along the frame's axes, shape (3, 3), kg·m²."""

    def scaled(self, scale: float) -> BreakableObject:
        """Make the same object, `scale` times as large."""

    def prepare(self) -> None:
        """Work out what a first break would otherwise wait for.

        Raises
        ------
        FracsimError
            Where the model has no answer that makes sense, as `fracture`.
        """


def bearable_force_of(thing: Breakable) -> float:
    """Give the lasting force that a thing surely bears.

    Parameters
    ----------
    thing : Breakable
        The thing.

    Returns
    -------
    float
        N; where it knows impulses only, the force that gives a bearable one in `LOAD_DURATION`.
    """
    if isinstance(thing, ElasticBreakable):
        return thing.bearable_force
    return thing.bearable_impulse / LOAD_DURATION


_MEMBERS = tuple(
    sorted(name for protocol in (Breakable, BreakableObject) for name in vars(protocol) if not name.startswith("_"))
)


def require_breakable(thing: object) -> None:
    """Refuse what has not all the members of `BreakableObject`.

    Parameters
    ----------
    thing : object
        What somebody gave to `World.add`. Its properties are looked up and not worked out.

    Raises
    ------
    PhysicsError
        Where members are missing; the message names them.
    """
    absent = object()
    missing = [name for name in _MEMBERS if inspect.getattr_static(thing, name, absent) is absent]
    if missing:
        raise PhysicsError(
            f"add takes an asset, as fracsim.load gives it, or an object with the members of "
            f"fracsim.physics.breakable.BreakableObject; {thing!r:.80} lacks {', '.join(missing)}"
        )
