"""The baked asset: everything that a running simulation needs to break one object.

``fracsim.load`` reads one; physics, environments and users ask it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray, IntArray
from ..common.checks import is_number
from ..common.contact import LOAD_DURATION
from ..common.errors import AssetError, FieldError
from ..common.files import write_beside
from ..common.impulse import Impulse, as_impulses
from ..common.material import Material, as_material
from ..geometry.complex import Hull
from ..geometry.sampling import CONE, SurfacePoints, cone, ratios
from .arrays import AssetArrays, SimulatorRecord
from .breakable_piece import BreakablePiece
from .file import AssetContents, pack, read_source, unpack
from .pieces import ConvexParts, Piece
from .predictor import FieldWeights
from .query import FractureQuery
from .result import Fracture
from .rule import load_ratios, weakest_cut

if TYPE_CHECKING:
    from .. import Simulator


@dataclass(frozen=True, eq=False)
class BreakableAsset:
    """A breakable object: made by ``fracsim.bake``, read by ``fracsim.load``.

    Attributes
    ----------
    name : str
        What messages call it.
    material : Material
        What it is made of.
    scale : float
        m, its largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the centre of its bounding box lies in its own frame.
    cap : float
        The largest distance that a field holds, as a share of the largest extent.
    min_piece_volume_fraction : float
        Pieces of a smaller share of the volume join a neighbour.
    arrays : AssetArrays
        Geometry and impact field, shared by all sizes and materials of it.
    model : FieldWeights
        The learned predictor.
    metadata : dict
        How it was baked and how good it is.
    baked_from : SimulatorRecord
        Which fracture simulator its training data came from.

    Examples
    --------
    >>> import fracsim
    >>> vase = fracsim.load("vase").scaled(0.5).with_material("glass")
    >>> fracture = vase.fracture(fracsim.Impulse(vase.vertices[0], (0, 0, -1), 1000 * vase.breaking_impulse[0]))
    >>> fracture.broken, abs(sum(piece.mass for piece in fracture.pieces) - vase.mass) < 1e-9
    (True, True)
    """

    name: str
    material: Material
    scale: float
    offset: FloatArray
    cap: float
    min_piece_volume_fraction: float
    arrays: AssetArrays
    model: FieldWeights
    metadata: dict[str, Any]
    baked_from: SimulatorRecord = field(default_factory=SimulatorRecord)

    @cached_property
    def query(self) -> FractureQuery:
        """What answers for this size and material."""
        return FractureQuery(**{each.name: getattr(self, each.name) for each in fields(FractureQuery)})

    # The body as a whole

    @property
    def size(self) -> float:
        """m, the largest extent."""
        return self.scale

    @cached_property
    def vertices(self) -> FloatArray:
        """(V, 3) m."""
        return self.arrays.points[: self.vertex_count] * self.scale + self.offset

    @property
    def faces(self) -> IntArray:
        """(F, 3) indices of vertices, outward."""
        return self.arrays.faces

    @property
    def vertex_count(self) -> int:
        """V, the number of vertices of its surface."""
        return len(self.arrays.impact_field)

    @property
    def volume(self) -> float:
        """Volume, m³."""
        return self.query.volume

    @property
    def volume_fraction(self) -> float:
        """Its share of its own volume, which is 1; a piece of it has less."""
        return 1.0

    @property
    def mass(self) -> float:
        """Mass, kg."""
        return self.query.mass

    @property
    def center_of_mass(self) -> FloatArray:
        """(3,) m."""
        return np.asarray(self.arrays.moments[1].sum(axis=0) / self.arrays.moments[0].sum() * self.scale + self.offset)

    @property
    def inertia(self) -> FloatArray:
        """(3, 3) kg·m² about the centre of mass, along the asset's axes."""
        return self.query.mass_properties.inertia

    @cached_property
    def hulls(self) -> tuple[Hull, ...]:
        """Convex parts of the unbroken body, as vertices (n, 3) in m and faces (k, 3) each."""
        return tuple((points * self.scale + self.offset, faces) for points, faces in self.arrays.whole_hulls)

    @property
    def convex_parts(self) -> ConvexParts:
        """The same, as an engine takes them in."""
        return replace(self.arrays.whole_convex_parts, scale=self.scale, offset=self.offset)

    @cached_property
    def reach(self) -> float:
        """m, from the centre of mass to the furthest point."""
        return float(np.linalg.norm(self.vertices - self.center_of_mass, axis=1).max())

    @property
    def bearable_impulse(self) -> float:
        """N·s; impulses that sum to less break nothing, wherever they act.

        Where severities count forces, it holds for up to 96 of them that close at up to 100 m/s with anything.
        """
        bound = float(self.query.weakest[1].min())
        return self.query.severity.bearable_impulse(bound, self.vertices, self.query.mass_properties)

    @property
    def severity_kind(self) -> str:
        """What breaks it, as its simulator counts it: "impulse" or "force"."""
        return self.baked_from.severity_kind

    @property
    def bearable_force(self) -> float:
        """N; lasting forces that sum to less break nothing, wherever they act."""
        if self.severity_kind == "force":
            return float(self.query.weakest[1].min()) * self.query.severity.unit
        return self.bearable_impulse / LOAD_DURATION

    @cached_property
    def breaking_impulse(self) -> FloatArray:
        """(V,) N·s; no single impulse below it on the faces around that vertex breaks anything, in any direction.

        An impulse of unknown duration, as of something hard and heavy.
        """
        query = self.query
        return query.severity.breaking_impulses(query.weakest[0], self.vertices, self.faces, query.mass_properties)

    def scaled(self, scale: float) -> BreakableAsset:
        """Make the same object of another size.

        Parameters
        ----------
        scale : float
            How many times as large; above 0.

        Returns
        -------
        BreakableAsset
            It shares the arrays of this one.

        Raises
        ------
        AssetError
            If the scale is not a positive finite number.
        """
        if not is_number(scale) or scale <= 0.0:
            raise AssetError(f"{self.name}: scale must be positive and finite, got {scale!r}")
        return replace(self, scale=self.scale * float(scale), offset=self.offset * float(scale))

    def with_material(self, material: str | Material) -> BreakableAsset:
        """Make the same object of another material.

        Parameters
        ----------
        material : str or Material
            A preset's name, or a material of your own.

        Returns
        -------
        BreakableAsset
            It shares the arrays of this one.

        Raises
        ------
        MaterialError
            If there is no such preset.

        Notes
        -----
        Strength, stiffness and density change. What the model has learned does not: an asset baked from a simulator
        that depends on the material, such as ``structural``, goes on breaking into the pieces of the material that it
        was baked of. Bake it again for those of another one.
        """
        return replace(self, material=as_material(material))

    # Breaking it

    def compliance_at(self, points: FloatArray) -> FloatArray:
        """Look up how far the surface gives way to forces, beyond what the body moves as a whole.

        Parameters
        ----------
        points : ndarray of float64, shape (K, 3)
            m, in its own frame; the nearest points of the surface count.

        Returns
        -------
        ndarray of float64, shape (K,)
            m/N; 0 where the asset does not know.
        """
        return self.query.severity.compliance_at(*self.query.locate(points))

    def impulse_of(self, severity: float, point: npt.ArrayLike, direction: npt.ArrayLike) -> Impulse:
        """Make the impulse of something hard and heavy that has a given severity.

        Parameters
        ----------
        severity : float
            At least 0, as the asset's simulator counts it.
        point, direction : array_like, shape (3,)
            As of `Impulse`.

        Returns
        -------
        Impulse
            Of unknown duration.
        """
        unit = Impulse(np.asarray(point), np.asarray(direction), 0.0)
        corners, barycentric = self.query.locate(unit.point[None])
        where = corners, barycentric, self.query.points_at(corners, barycentric)
        query = self.query
        [size] = query.severity.magnitudes(np.array([severity]), *where, unit.direction[None], query.mass_properties)
        return Impulse(unit.point, unit.direction, float(size))

    def may_break(self, impulses: Impulse | Sequence[Impulse]) -> bool:
        """Tell whether impulses can break the unbroken asset; asks no model.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in its own frame (m, N·s).

        Returns
        -------
        bool
            False where they are surely too weak.
        """
        return self.query.may_break(self.query.on_surface(as_impulses(impulses)))

    def fracture(
        self, impulses: Impulse | Sequence[Impulse], predictor: str = "field", *, skip_weak: bool = True
    ) -> Fracture:
        """Break the unbroken asset.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in its own frame (m, N·s).
        predictor : {"field", "interfaces", "simulator"}
            "field": the learned distance field, segmented. "interfaces": the pieces that the same model's break scores
            leave, with no field between. "simulator": the modal simulator's own answer ("modes" is its old name); an
            asset baked from another simulator does not carry it.
        skip_weak : bool
            Whether impulses that `may_break` rules out are answered without asking the model. False judges the model
            alone.

        Returns
        -------
        Fracture
            The pieces; a single one where nothing breaks.

        Raises
        ------
        FracsimError
            ImpulseError if no impulse is given, FieldError if the model's scores are not finite; else the predictor is
            unknown, or the asset does not carry it.
        """
        return self.query.fracture(as_impulses(impulses), predictor, skip_weak)

    def unbroken(self) -> Fracture:
        """Return the answer to no impulse at all; asks no model.

        Returns
        -------
        Fracture
            A single piece.
        """
        return self.query.unbroken()

    def fracture_from_field(self, udf: npt.ArrayLike) -> Fracture:
        """Cut the asset along a field, such as one that a model of your own predicts.

        Parameters
        ----------
        udf : array_like, shape (V,)
            m, distance of each vertex to the nearest crack.

        Returns
        -------
        Fracture
            The pieces.

        Raises
        ------
        FieldError
            If the field is not V finite numbers.
        """
        try:
            values = np.asarray(udf, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise FieldError(f"{self.name}: a field must be numbers ({error})") from error
        if values.shape != (self.vertex_count,):
            raise FieldError(f"{self.name}: a field must have shape ({self.vertex_count},), got {values.shape}")
        if not np.isfinite(values).all():
            raise FieldError(f"{self.name}: the field holds values that are not finite; no fracture follows from it")
        return self.query.fracture_from_field(values / self.scale)

    def breakable_piece(self, piece: Piece) -> BreakablePiece:
        """Make one of its pieces something that breaks in turn.

        Parameters
        ----------
        piece : Piece
            One of the pieces of its fracture.

        Returns
        -------
        BreakablePiece
            It answers by the model of this asset.
        """
        return BreakablePiece(self, piece)

    def prepare(self) -> None:
        """Work out all that a first break would otherwise wait for, once for all sizes; ``World.add`` calls it."""
        if not self.arrays.prepared:
            nothing = Impulse(self.vertices[0], np.array([0.0, 0.0, 1.0]), 0.0)
            self.query.fracture([nothing], skip_weak=False)
            _ = self.arrays.weakest, self.arrays.whole_convex_parts
            self.arrays.mark_prepared()

    def sample_impulses(self, count: int, seed: int | np.random.Generator) -> list[Impulse]:
        """Draw single impulses that break it about as often as not.

        Points are uniform over the area and directions lie in a cone about the inward normal. Magnitudes are 0.3 to 5
        times what first breaks the body there, or what typically does where the asset does not carry its simulator.

        Parameters
        ----------
        count : int
            How many.
        seed : int or numpy.random.Generator
            Where randomness comes from.

        Returns
        -------
        list of Impulse
            In the asset's frame (m, N·s).
        """
        rng = np.random.default_rng(seed)
        pool = SurfacePoints(self.arrays.points[: self.vertex_count], self.faces)
        face, barycentric = pool.draw(count, rng)
        directions = cone(-pool.normals[face], CONE, rng)
        ratio = ratios(count, rng)
        severity = ratio * self.baked_from.typical_severity
        if self.baked_from.driven_by_impact_field:
            rows = pool.rows(self.arrays.impact_field, face[:, None], barycentric[:, None])
            loads = load_ratios(rows, directions[:, None], np.ones((count, 1)), self.arrays.interfaces)
            severity = ratio / weakest_cut(loads, self.arrays.pairs, self.arrays.complex.count)
        points = pool.at(face, barycentric) * self.scale + self.offset
        magnitude = self.query.severity.magnitudes(
            severity, self.faces[face], barycentric, points, directions, self.query.mass_properties
        )
        return [Impulse(*impact) for impact in zip(points, directions, magnitude, strict=True)]

    def simulator(self) -> Simulator:
        """Make the simulator again that the asset was baked from. It needs the extra ``bake``, and takes seconds.

        Returns
        -------
        Simulator
            Of the asset's size and material; its options are those of the bake.

        Raises
        ------
        BakeError
            If it has no registered name here.
        MissingExtraError
            If what makes it is not installed.
        """
        from .. import Simulator  # loads what makes assets, which a simulation does without

        vertices = self.arrays.points[: self.vertex_count]
        return Simulator.of_bake(vertices, self.faces, self.scale, self.offset, self.name, self.material, self.metadata)

    # The file

    def save(self, path: str | Path) -> None:
        """Write the asset to a file, whole or not at all.

        Parameters
        ----------
        path : str or Path
            Where; a file that is there is replaced. The usual suffix is ".frac".

        Raises
        ------
        AssetError
            If it cannot be written there.
        """
        contents = AssetContents(**{each.name: getattr(self, each.name) for each in fields(self)})
        write_beside(Path(path), pack(contents), AssetError)


def load(source: str | os.PathLike[str]) -> BreakableAsset:
    """Read an asset from a file, or one that ships with fracsim.

    Parameters
    ----------
    source : str or path
        A file, or the name of one that ships: "bunny", "chair", "vase".

    Returns
    -------
    BreakableAsset
        The asset.

    Raises
    ------
    AssetError
        If the file is missing, truncated, damaged, or of another format; the message names it and the fault.

    Examples
    --------
    >>> import fracsim
    >>> fracsim.load("bunny").vertices.shape
    (3338, 3)
    """
    data, where = read_source(source)
    return BreakableAsset(**vars(unpack(data, where)))
