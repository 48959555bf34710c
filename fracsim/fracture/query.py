"""The query: from impulses to break scores, from these to a field, and from the field to labels and pieces.

``BreakableAsset`` and ``BreakablePiece`` put their questions to it; nothing else needs it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import FieldError, FracsimError
from ..common.impulse import Impulse
from ..common.material import Material
from ..geometry.locate import closest_on_surface
from .arrays import AssetArrays, Domain, SimulatorRecord
from .assemble import assemble_pieces, mass_properties
from .predictor import FieldWeights, field_from_scores, minimax_scores
from .result import Fracture, LateVertexAnswer
from .rule import components, load_ratios, merge_small_pieces, separated
from .severity import MassProperties, SeverityScale

PREDICTORS = ("field", "interfaces", "simulator")
ALIASES = {"modes": "simulator"}  # what it was called before

# Surface points near given ones (K, 3) m, as vertices (K, 3) and barycentric coordinates (K, 3)
Locator = Callable[[FloatArray], tuple[IntArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class SurfaceImpulses:
    """K impulses that act together on the surface of an asset.

    Attributes
    ----------
    corners : ndarray of int64, shape (K, 3)
        The vertices of the face that each acts on.
    barycentric : ndarray of float64, shape (K, 3)
        Where on that face.
    directions : ndarray of float64, shape (K, 3)
        Unit vectors.
    severities : ndarray of float64, shape (K,)
        How hard each is for the asset (`fracsim.fracture.severity`).
    """

    corners: IntArray
    barycentric: FloatArray
    directions: FloatArray
    severities: FloatArray


@dataclass(frozen=True, eq=False)
class _Answer:
    """What is known of a fracture before its pieces are; attributes as of `Fracture`."""

    domain: Domain
    predictor: str
    severity: float
    clamped: bool
    timings: dict[str, float]


@dataclass(frozen=True, eq=False)
class FractureQuery:
    """Everything that an answer follows from, for one size and material of an asset.

    Attributes
    ----------
    name : str
        What messages call the asset.
    material : Material
        Its material.
    scale : float
        m, its largest extent.
    offset : ndarray of float64, shape (3,)
        m, where the origin of the arrays' units lies in its frame.
    cap : float
        The largest value of a field, in units of the largest extent.
    min_piece_volume_fraction : float
        Pieces of a smaller share of the volume join a neighbour.
    arrays : AssetArrays
        Geometry and impact field.
    model : FieldWeights
        The learned predictor.
    baked_from : SimulatorRecord
        What made its training data.
    """

    name: str
    material: Material
    scale: float
    offset: FloatArray
    cap: float
    min_piece_volume_fraction: float
    arrays: AssetArrays
    model: FieldWeights
    baked_from: SimulatorRecord

    @property
    def volume(self) -> float:
        """Volume, m³."""
        return float(self.arrays.moments[0].sum()) * self.scale**3

    @property
    def mass(self) -> float:
        """Mass, kg."""
        return self.volume * self.material.density

    @cached_property
    def mass_properties(self) -> MassProperties:
        """Mass, centre of mass and inertia of the whole."""
        atoms = np.arange(self.arrays.complex.count)
        return MassProperties(*mass_properties(self.arrays, atoms, self.material.density, self.scale, self.offset)[1:])

    @cached_property
    def severity(self) -> SeverityScale:
        """What turns impulses into severities."""
        known, record = self.arrays.compliance, self.baked_from
        shape = np.zeros(len(self.arrays.impact_field)) if known is None else known
        return SeverityScale.of(record.severity_kind, record.gauge, shape, self.material, self.scale, self.mass)

    @cached_property
    def weakest(self) -> tuple[FloatArray, FloatArray]:
        """`AssetArrays.weakest`; where the simulator is known by its samples alone, what they tell of it."""
        if self.baked_from.driven_by_impact_field:
            return self.arrays.weakest
        everywhere = np.full(len(self.arrays.impact_field), self.baked_from.min_severity)
        return everywhere, everywhere

    # Where impulses act, and whether they can matter

    def locate(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """Find the surface points that are nearest to given points.

        Parameters
        ----------
        points : ndarray of float64, shape (K, 3)
            m, in the asset's frame.

        Returns
        -------
        corners : ndarray of int64, shape (K, 3)
            The vertices of the faces that the surface points lie on.
        barycentric : ndarray of float64, shape (K, 3)
            Where on these.
        """
        arrays = self.arrays
        local = (points - self.offset) / self.scale
        face, barycentric = closest_on_surface(local, arrays.points, arrays.faces, arrays.face_tree)
        return arrays.faces[face], barycentric

    def on_surface(
        self, impulses: Sequence[Impulse], locate: Locator | None = None, body: MassProperties | None = None
    ) -> SurfaceImpulses:
        """Bring impulses to the surface and to severities.

        Parameters
        ----------
        impulses : sequence of Impulse
            What acts together.
        locate : callable, optional
            Finds the surface points; `FractureQuery.locate` by default.
        body : MassProperties, optional
            Of the piece that is struck; of the whole asset by default.

        Returns
        -------
        SurfaceImpulses
            The same as the model takes them.
        """
        corners, barycentric = (locate or self.locate)(np.array([impulse.point for impulse in impulses]))
        directions = np.array([impulse.direction for impulse in impulses])
        points = self.points_at(corners, barycentric)
        severities = self.severity.severities(impulses, corners, barycentric, points, body or self.mass_properties)
        return SurfaceImpulses(corners, barycentric, directions, severities)

    def points_at(self, corners: IntArray, barycentric: FloatArray) -> FloatArray:
        """Compute where points of the surface are.

        Parameters
        ----------
        corners : ndarray of int64, shape (K, 3)
            Vertices of faces.
        barycentric : ndarray of float64, shape (K, 3)
            Where on these.

        Returns
        -------
        ndarray of float64, shape (K, 3)
            m.
        """
        local = np.einsum("kc,kcx->kx", barycentric, self.arrays.points[corners])
        return np.asarray(local * self.scale + self.offset)

    def may_break(self, impulses: SurfaceImpulses, whole: bool = True) -> bool:
        """Tell whether impulses can break anything; asks no model.

        Parameters
        ----------
        impulses : SurfaceImpulses
            What acts together.
        whole : bool
            Whether they act on the unbroken asset. A piece is weaker, as it has fewer interfaces that hold it.

        Returns
        -------
        bool
            False where they surely do nothing.
        """
        corners = impulses.corners
        nearest = corners[np.arange(len(corners)), np.argmax(impulses.barycentric, axis=1)]
        bound = self.weakest[0 if len(corners) == 1 and whole else 1][nearest]
        return float((impulses.severities / bound).sum()) >= 1.0

    # The answer

    def fracture(
        self,
        impulses: Sequence[Impulse],
        predictor: str = "field",
        skip_weak: bool = True,
        domain: Domain | None = None,
        locate: Locator | None = None,
        body: MassProperties | None = None,
    ) -> Fracture:
        """Answer what impulses that act together do.

        Parameters
        ----------
        impulses : sequence of Impulse
            At least one.
        predictor : str
            As for `BreakableAsset.fracture`.
        skip_weak : bool
            Whether impulses that `may_break` rules out are answered without asking the model.
        domain : Domain, optional
            The atoms of a piece that is struck; the whole asset by default.
        locate : callable, optional
            Finds the surface points of that piece.
        body : MassProperties, optional
            Of that piece.

        Returns
        -------
        Fracture
            The pieces.

        Raises
        ------
        FracsimError
            If the predictor is unknown or the asset has not got it.
        FieldError
            If the model's scores are negative or not finite.

        Notes
        -----
        A piece answers with the model of the whole. An impact leaves its momentum near the contact whatever the size
        of the body. What would have gone on into the atoms that broke off stays in those that are left, spread over all
        of them. So the jumps of velocity between these are as in the whole body under the same impulse, and cracks that
        exist already only take interfaces out of it.
        """
        predictor = self._known(predictor)
        begin = time.perf_counter()
        whole = domain is None
        domain = domain or self.arrays.whole
        located = self.on_surface(impulses, locate, body)
        severities = located.severities
        total, limit = float(severities.sum()), float(self.model.severity[0])
        clamped = predictor != "simulator" and total > limit
        if clamped:
            severities *= limit / total
        own = 1.0 if self.severity.is_force else domain.share  # a lighter piece takes an impulse harder
        answer = _Answer(domain, predictor, total / own, clamped, {"impulse": _ms(begin)})
        begin = time.perf_counter()
        pairs, count = domain.interfaces.pairs, len(domain.atoms)
        if predictor == "simulator":
            broken = self._simulated(located, domain)
        elif len(pairs) == 0 or (skip_weak and not self.may_break(located, whole)):
            answer.timings["field"] = _ms(begin)
            return self._finish(answer, np.zeros(count, dtype=np.int64), np.zeros(len(pairs)))
        else:
            scores = self._scores(located, domain)
            if predictor == "field":
                minimax = minimax_scores(scores, pairs, count).astype(np.float64)
                udf = field_from_scores(minimax, self.arrays.trace[1][domain.interface_indices], self.cap)
                answer.timings["field"] = _ms(begin)
                return self._segment(answer, udf, minimax)
            broken = scores >= self.model.level[0]
        labels = self._merge(components(~broken[None], pairs, count)[0], domain)
        answer.timings["labels"] = _ms(begin)
        return self._finish(answer, labels, separated(labels, pairs).astype(np.float64))

    def fracture_from_field(self, field: FloatArray) -> Fracture:
        """Cut the whole asset along a field.

        Parameters
        ----------
        field : ndarray of float64, shape (V,)
            Finite distances to the nearest crack, in units of the largest extent.

        Returns
        -------
        Fracture
            The pieces.
        """
        answer = _Answer(self.arrays.whole, "given", 0.0, False, {})
        return self._segment(answer, field[self.arrays.trace[0]], field)

    def unbroken(self, domain: Domain | None = None) -> Fracture:
        """Answer that nothing breaks; asks no model.

        Parameters
        ----------
        domain : Domain, optional
            The atoms of a piece; the whole asset by default.

        Returns
        -------
        Fracture
            A single piece.
        """
        domain = domain or self.arrays.whole
        answer = _Answer(domain, "none", 0.0, False, {})
        return self._finish(answer, np.zeros(len(domain.atoms), np.int64), np.zeros(len(domain.interface_indices)))

    def _known(self, predictor: str) -> str:
        """Return the predictor's present name; raise FracsimError where the asset has no such predictor."""
        predictor = ALIASES.get(predictor, predictor)
        if predictor not in PREDICTORS:
            raise FracsimError(f"unknown predictor {predictor!r}; use one of {', '.join(PREDICTORS)}")
        if predictor == "simulator" and not self.baked_from.driven_by_impact_field:
            raise FracsimError(
                f"{self.name}: was baked from a simulator that it does not carry ({self.baked_from.simulator}); "
                f"use the predictor 'field' or 'interfaces'"
            )
        return predictor

    def _simulated(self, impulses: SurfaceImpulses, domain: Domain) -> BoolArray:
        """Tell which interfaces (I,) of the domain the modal simulator breaks."""
        arrays = self.arrays
        rows = np.einsum("kc,kca->ka", impulses.barycentric, arrays.impact_field[impulses.corners])
        ratios = load_ratios(rows[None], impulses.directions[None], impulses.severities[None], arrays.interfaces)
        return np.asarray(ratios[0, domain.interface_indices] >= 1.0)

    def _scores(self, impulses: SurfaceImpulses, domain: Domain) -> FloatArray:
        """Ask the model for the break scores (I,) of the domain's interfaces, and check them."""
        pairs = self.arrays.pairs
        scores = np.asarray(
            self.model.scores(impulses.corners, impulses.barycentric, impulses.directions, impulses.severities, pairs)
        )
        if scores.shape != (len(pairs),):
            raise FieldError(
                f"{self.name}: the model gives scores of shape {scores.shape}, not one for each of {len(pairs)} "
                f"interfaces"
            )
        inside = scores[domain.interface_indices].astype(np.float64)
        if not (np.isfinite(inside).all() and (inside >= 0.0).all()):
            raise FieldError(
                f"{self.name}: the model's scores are negative or not finite; no fracture follows from them"
            )
        return inside

    def _merge(self, labels: IntArray, domain: Domain) -> IntArray:
        """Return the labels (A,) after small pieces have joined a neighbour."""
        floor = self.min_piece_volume_fraction / domain.share
        return merge_small_pieces(labels, domain.volumes, domain.interfaces, floor)

    def _segment(self, answer: _Answer, udf: FloatArray, values: FloatArray) -> Fracture:
        """Cut along a field ``udf`` (U,) at the vertices of `AssetArrays.trace`; ``values`` as `_finish` takes them."""
        begin = time.perf_counter()
        domain = answer.domain
        labels = self.arrays.atom_watershed.labels(udf, self.model.pass_height, domain.is_inside)[domain.atoms]
        labels = self._merge(labels, domain)
        answer.timings["segmentation"] = _ms(begin)
        return self._finish(answer, labels, values)

    def _finish(self, answer: _Answer, labels: IntArray, values: FloatArray) -> Fracture:
        """Make pieces of labels (A,); ``values`` is what the field at the vertices follows from."""
        begin = time.perf_counter()
        domain, arrays = answer.domain, self.arrays
        order = np.argsort(labels, kind="stable")
        groups = np.split(domain.atoms[order], np.cumsum(np.bincount(labels))[:-1])
        pieces = assemble_pieces(arrays, groups, self.material.density, self.scale, self.offset)
        cracks = separated(labels, domain.interfaces.pairs)
        area = float(domain.interfaces.projected[cracks].sum()) * self.scale**2
        answer.timings["pieces"] = _ms(begin)
        are_scores = answer.predictor != "given"
        at_vertices = LateVertexAnswer(arrays, domain, labels, values, are_scores, self.cap, self.scale)
        return Fracture(pieces, answer.timings, answer.predictor, answer.severity, answer.clamped, area, at_vertices)


def _ms(begin: float) -> float:
    return (time.perf_counter() - begin) * 1e3
