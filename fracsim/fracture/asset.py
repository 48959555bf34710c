"""The baked asset: everything a running simulation needs to break one object, in one file of plain arrays."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..common.arrays import FloatArray, IntArray
from ..common.errors import AssetError, FieldError, FracsimError
from ..common.files import compact, header_of, write_beside
from ..common.impulse import Impulse, as_impulses
from ..common.material import Material, as_material
from ..geometry.complex import Hull
from ..geometry.locate import closest_on_triangles
from ..geometry.sampling import CONE, SurfacePoints, cone, ratios
from .arrays import AssetArrays, Domain, SimulatorRecord
from .file import FORMAT, SUFFIX, contradictions
from .pieces import ConvexParts, Piece
from .predictor import FieldWeights, field_from_scores, minimax_scores
from .result import Answer, Fracture
from .rule import components, load_ratios, merge_small_pieces, separated, weakest_cut

PREDICTORS = ("field", "interfaces", "modes")


@dataclass(frozen=True, eq=False)
class BreakableAsset:
    """A breakable object: made by ``fracsim.bake``, read by ``fracsim.load``.

    scale: m, its largest extent. offset: (3,) m, where the centre of its bounding box lies in its own frame.
    cap, min_piece_volume_fraction: of the largest extent, of the volume. metadata: how it was baked and how good it is.
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
        """(F, 3)."""
        return self.arrays.faces

    @property
    def vertex_count(self) -> int:
        return len(self.arrays.impact_field)

    @property
    def volume(self) -> float:
        """m³."""
        return float(self.arrays.moments[0].sum()) * self.scale**3

    @property
    def mass(self) -> float:
        """kg."""
        return self.volume * self.material.density

    @property
    def center_of_mass(self) -> FloatArray:
        """(3,) m."""
        return np.asarray(self.arrays.moments[1].sum(axis=0) / self.arrays.moments[0].sum() * self.scale + self.offset)

    @property
    def inertia(self) -> FloatArray:
        """(3, 3) kg·m² about the centre of mass, along the asset's axes."""
        return self._mass_properties(np.arange(len(self.arrays.moments[0])))[3]

    @cached_property
    def hulls(self) -> tuple[Hull, ...]:
        """Convex parts of the unbroken body."""
        arrays = self.arrays
        return self._hulls(arrays.body_points, arrays.body_faces, arrays.body_sizes)

    @property
    def convex_parts(self) -> ConvexParts:
        """The same as an engine takes them in."""
        return replace(self.arrays.whole_convex_parts, scale=self.scale, offset=self.offset)

    @cached_property
    def reach(self) -> float:
        """m, from the centre of mass to the furthest point."""
        return float(np.linalg.norm(self.vertices - self.center_of_mass, axis=1).max())

    @property
    def bearable_impulse(self) -> float:
        """N·s: impulses that sum to less break nothing, wherever they act."""
        return float(self._weakest[1].min()) * self.mass * self.material.breaking_velocity

    @cached_property
    def breaking_impulse(self) -> FloatArray:
        """(V,) N·s: no single impulse below it on the faces around that vertex breaks anything, whichever way."""
        return self._weakest[0] * self.mass * self.material.breaking_velocity

    def scaled(self, scale: float) -> BreakableAsset:
        """The same object, ``scale`` times as large; arrays are shared."""
        if not (np.isfinite(scale) and scale > 0):
            raise AssetError(f"{self.name}: scale must be positive and finite, got {scale!r}")
        return replace(self, scale=self.scale * float(scale), offset=self.offset * float(scale))

    def with_material(self, material: str | Material) -> BreakableAsset:
        """The same object of another material, by preset name or as a Material; arrays are shared."""
        return replace(self, material=as_material(material))

    # Breaking it

    def may_break(self, impulses: Impulse | Sequence[Impulse]) -> bool:
        """False when these impulses together are surely too weak; costs no model query."""
        impulses = as_impulses(impulses)
        corners, barycentric = self._locate(np.array([impulse.point for impulse in impulses]))
        return self._may_break(corners, barycentric, self._severities(impulses))

    @cached_property
    def _weakest(self) -> tuple[FloatArray, FloatArray]:
        """``AssetArrays.weakest``, or what is known of it where the truth is known by its samples alone."""
        if self.baked_from.simulator == "modal":
            return self.arrays.weakest
        least = np.full(self.vertex_count, self.baked_from.min_severity)
        return least, least

    def _severities(self, impulses: Sequence[Impulse]) -> FloatArray:
        return np.array([impulse.magnitude for impulse in impulses]) / (self.mass * self.material.breaking_velocity)

    def _may_break(
        self, corners: IntArray, barycentric: FloatArray, severities: FloatArray, whole: bool = True
    ) -> bool:
        """whole: False for a piece, which has fewer ways to hold together."""
        nearest = corners[np.arange(len(corners)), np.argmax(barycentric, axis=1)]
        bound = self._weakest[0 if len(corners) == 1 and whole else 1][nearest]
        return float((severities / bound).sum()) >= 1.0

    def fracture(self, impulses: Impulse | Sequence[Impulse], predictor: str = "field") -> Fracture:
        """What one impulse, or several acting together, do to the unbroken asset.

        predictor: "field", the learned distance field, segmented; "interfaces", the pieces that the same model's
        break scores leave, with no field between; or "modes", the modal truth's own answer, which an asset baked from
        another truth does not carry.
        Raises ImpulseError, or FieldError when the model's field is not finite.
        """
        return self._fracture(as_impulses(impulses), predictor, gated=True)

    def unbroken(self) -> Fracture:
        """What no impulse at all would do; asks no model."""
        return self._nothing(self.arrays.whole)

    def _nothing(self, domain: Domain) -> Fracture:
        answer = Answer(domain, "none", 0.0, False, {})
        return self._finish(answer, np.zeros(len(domain.atoms), np.int64), np.zeros(len(domain.interface_indices)))

    def breakable_piece(self, piece: Piece) -> BreakablePiece:
        """One of its pieces as something that can be struck and broken in turn."""
        return BreakablePiece(self, piece)

    def prepare(self) -> None:
        """Work out all that a first break would otherwise wait for. ``World.add`` does; once for all sizes."""
        if "prepared" not in vars(self.arrays):
            nothing = Impulse(self.vertices[0], np.array([0.0, 0.0, 1.0]), 0.0)
            for piece in self._fracture([nothing], "field", gated=False).pieces:
                _ = piece.convex_parts
            _ = self.arrays.weakest, self.arrays.whole_convex_parts
            vars(self.arrays)["prepared"] = True

    def _fracture(
        self, impulses: Sequence[Impulse], predictor: str, gated: bool, fragment: BreakablePiece | None = None
    ) -> Fracture:
        """gated: whether impacts that are surely too weak are spared the model, which is to be told when it is judged.

        A piece answers with the model of the whole. An impact leaves its momentum near the contact whatever the size of
        the body, and what would have gone on into the atoms that are gone stays in those that are left, spread over
        all of them: so the jumps between these are as in the whole body under the same impulse, and cracks that are
        there already only take interfaces out of it.
        """
        if predictor not in PREDICTORS:
            raise FracsimError(f"unknown predictor {predictor!r}; use one of {', '.join(PREDICTORS)}")
        if predictor == "modes" and self.baked_from.simulator != "modal":
            raise FracsimError(
                f"{self.name}: was baked from a truth that it does not carry ({self.baked_from.simulator})"
            )
        begin = time.perf_counter()
        arrays = self.arrays
        domain = arrays.whole if fragment is None else fragment.domain
        locate = self._locate if fragment is None else fragment.locate
        corners, barycentric = locate(np.array([impulse.point for impulse in impulses]))
        directions = np.array([impulse.direction for impulse in impulses])
        severities = self._severities(impulses)
        total = float(severities.sum())
        limit = float(self.model.severity[0])
        clamped = predictor != "modes" and total > limit
        if clamped:
            severities *= limit / total
        answer = Answer(domain, predictor, total / domain.share, clamped, {"impulse": _ms(begin)})
        begin = time.perf_counter()
        pairs, count = domain.interfaces.pairs, len(domain.atoms)
        if predictor == "modes":
            rows = np.einsum("kc,kca->ka", barycentric, arrays.impact_field[corners])
            broken = (
                load_ratios(rows[None], directions[None], severities[None], arrays.interfaces)[
                    0, domain.interface_indices
                ]
                >= 1.0
            )
        elif len(pairs) == 0 or (gated and not self._may_break(corners, barycentric, severities, fragment is None)):
            answer.timings["field"] = _ms(begin)
            return self._finish(answer, np.zeros(count, dtype=np.int64), np.zeros(len(pairs)))
        else:
            scores = np.asarray(self.model.scores(corners, barycentric, directions, severities, arrays.pairs))
            if scores.shape != (len(arrays.pairs),):
                raise FieldError(f"{self.name}: the model gives scores of shape {scores.shape}, not one an interface")
            scores = scores[domain.interface_indices].astype(np.float64)
            if not (np.isfinite(scores).all() and (scores >= 0.0).all()):
                raise FieldError(
                    f"{self.name}: the model's scores are negative or not finite; no fracture follows from them"
                )
            if predictor == "field":
                parting = minimax_scores(scores, pairs, count).astype(np.float64)
                udf = field_from_scores(parting, arrays.trace[1][domain.interface_indices], self.cap)
                answer.timings["field"] = _ms(begin)
                return self._cut(answer, udf, parting)
            broken = scores >= self.model.level[0]
        labels = components(~broken[None], pairs, count)[0]
        labels = merge_small_pieces(
            labels, domain.volumes, domain.interfaces, self.min_piece_volume_fraction / domain.share
        )
        answer.timings["labels"] = _ms(begin)
        return self._finish(answer, labels, separated(labels, pairs).astype(np.float64))

    def fracture_from_field(self, udf: npt.ArrayLike) -> Fracture:
        """The pieces of a given field: udf (V,) m, distance to the nearest crack, such as a model of one's own."""
        try:
            values = np.asarray(udf, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise FieldError(f"{self.name}: a field must be numbers ({error})") from error
        if values.shape != (self.vertex_count,):
            raise FieldError(f"{self.name}: a field must have shape ({self.vertex_count},), got {values.shape}")
        if not np.isfinite(values).all():
            raise FieldError(f"{self.name}: the field holds values that are not finite; no fracture follows from it")
        given = values / self.scale
        answer = Answer(self.arrays.whole, "given", 0.0, False, {})
        return self._cut(answer, given[self.arrays.trace[0]], given)

    def sample_impulses(self, count: int, seed: int | np.random.Generator) -> list[Impulse]:
        """Single impulses over the area, in a cone about the inward normal, at 0.3 to 5 times what first
        parts the body at that point in that direction (typically parts it, for an asset of another truth than the
        modal one)."""
        rng = np.random.default_rng(seed)
        pool = SurfacePoints(self.arrays.points[: self.vertex_count], self.faces)
        face, barycentric = pool.draw(count, rng)
        directions = cone(-pool.normals[face], CONE, rng)
        ratio = ratios(count, rng)
        severity = ratio * self.baked_from.typical_severity
        if self.baked_from.simulator == "modal":
            rows = pool.rows(self.arrays.impact_field, face[:, None], barycentric[:, None])
            drive = load_ratios(rows, directions[:, None], np.ones((count, 1)), self.arrays.interfaces)
            severity = ratio / weakest_cut(drive, self.arrays.pairs, self.arrays.complex.count)
        magnitude = severity * self.mass * self.material.breaking_velocity
        points = pool.at(face, barycentric) * self.scale + self.offset
        return [Impulse(*impact) for impact in zip(points, directions, magnitude, strict=True)]

    # Parts of the above

    def _locate(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """The surface points nearest to ``points`` (K, 3) m, as vertices (K, 3) and barycentric coordinates."""
        local = (points - self.offset) / self.scale
        _, nearest = self.arrays.face_tree.query(local, k=min(16, len(self.faces)))
        corner = self.arrays.points[self.faces[nearest]]  # (K, 16, 3, 3)
        barycentric, square = closest_on_triangles(local[:, None], corner)
        best = np.argmin(square, axis=1)
        row = np.arange(len(points))
        return self.faces[nearest[row, best]], barycentric[row, best]

    def _cut(self, answer: Answer, udf: FloatArray, given: FloatArray) -> Fracture:
        """udf: (U,) on the coast. given: what the field everywhere follows from, as ``_finish`` takes it."""
        begin = time.perf_counter()
        domain = answer.domain
        labels = self.arrays.atom_watershed.labels(udf, self.model.pass_height, domain.is_inside)[domain.atoms]
        labels = merge_small_pieces(
            labels, domain.volumes, domain.interfaces, self.min_piece_volume_fraction / domain.share
        )
        answer.timings["segmentation"] = _ms(begin)
        return self._finish(answer, labels, given)

    def _finish(self, answer: Answer, labels: IntArray, given: FloatArray) -> Fracture:
        """labels: (A,) of the domain's atoms. given: the field (V,) itself, or the parting score of each of the
        domain's interfaces."""
        begin = time.perf_counter()
        domain, arrays = answer.domain, self.arrays
        order = np.argsort(labels, kind="stable")
        groups = np.split(domain.atoms[order], np.cumsum(np.bincount(labels))[:-1])
        pieces = self._pieces(groups)
        cracks = separated(labels, domain.interfaces.pairs)
        area = float(domain.interfaces.projected[cracks].sum()) * self.scale**2
        answer.timings["pieces"] = _ms(begin)

        def vertex_labels() -> IntArray:
            of_atom = np.full(arrays.complex.count, -1)
            of_atom[domain.atoms] = labels
            return of_atom[arrays.vertex_atom]

        def udf() -> FloatArray:
            if answer.predictor == "given":
                return given * self.scale
            return field_from_scores(given, arrays.distances[domain.interface_indices], self.cap) * self.scale

        return Fracture(
            pieces, answer.timings, answer.predictor, answer.severity, answer.clamped, area, vertex_labels, udf
        )

    def _pieces(self, groups: Sequence[IntArray]) -> tuple[Piece, ...]:
        arrays = self.arrays
        parts = replace(arrays.atom_convex_parts, scale=self.scale, offset=self.offset)

        def piece(atoms: IntArray) -> Piece:
            volume, mass, center, inertia = self._mass_properties(atoms)
            rows = [row for atom in atoms.tolist() for row in arrays.convex_parts_of_atom[atom]]

            def hulls() -> tuple[Hull, ...]:
                return tuple(self._atom_hulls[row] for row in rows)

            def surface() -> tuple[FloatArray, IntArray, npt.NDArray[np.bool_]]:
                vertices, faces, outer = arrays.complex.surface(np.isin(np.arange(arrays.complex.count), atoms))
                return vertices * self.scale + self.offset, faces, outer

            return Piece(volume, mass, center, inertia, parts.select(rows), atoms, hulls, surface)

        return tuple(piece(group) for group in groups)

    def _mass_properties(self, atoms: IntArray) -> tuple[float, float, FloatArray, FloatArray]:
        """Volume, mass, centre of mass and inertia about it of some atoms together."""
        zeroth, first, second = (moment[atoms].sum(axis=0) for moment in self.arrays.moments)
        center = first / zeroth
        spread = second - zeroth * np.outer(center, center)
        volume = float(zeroth) * self.scale**3
        density = self.material.density
        inertia = (np.trace(spread) * np.eye(3) - spread) * (density * self.scale**5)
        return volume, volume * density, center * self.scale + self.offset, inertia

    def _hulls(self, points: FloatArray, faces: IntArray, sizes: IntArray) -> tuple[Hull, ...]:
        ends = np.cumsum(sizes, axis=0)[:-1].T
        blocks = np.split(points * self.scale + self.offset, ends[0])
        return tuple(zip(blocks, np.split(faces, ends[1]), strict=True))

    @cached_property
    def _atom_hulls(self) -> tuple[Hull, ...]:
        return self._hulls(self.arrays.hull_points, self.arrays.hull_faces, self.arrays.hull_sizes)

    # The file

    def save(self, path: str | Path) -> None:
        """Write the asset, beside and then over ``path``, so that no half of a file is ever there."""
        from safetensors.numpy import save

        tensors = {f"asset.{name}": compact(getattr(self.arrays, name)) for name in AssetArrays.__dataclass_fields__}
        tensors |= {f"model.{name}": np.ascontiguousarray(value) for name, value in vars(self.model).items()}
        header = {
            "format": FORMAT,
            "name": self.name,
            "material": self.material.to_dict(),
            "scale": self.scale,
            "offset": self.offset.tolist(),
            "cap": self.cap,
            "min_piece_volume_fraction": self.min_piece_volume_fraction,
            "metadata": self.metadata,
            "baked_from": asdict(self.baked_from),
        }
        write_beside(Path(path), save(tensors, metadata={"fracsim": json.dumps(header, sort_keys=True)}))


@dataclass(frozen=True, eq=False)
class BreakablePiece:
    """A piece of a broken asset as something that breaks in turn, by the asset's model; in the asset's frame."""

    asset: BreakableAsset
    piece: Piece

    @cached_property
    def domain(self) -> Domain:
        arrays = self.asset.arrays
        return Domain.of(self.piece.atoms, arrays.interfaces, arrays.moments[0])

    @property
    def name(self) -> str:
        return self.asset.name

    @property
    def material(self) -> Material:
        return self.asset.material

    @property
    def size(self) -> float:
        """m, the largest extent of the whole."""
        return self.asset.size

    @property
    def mass(self) -> float:
        return self.piece.mass

    @cached_property
    def reach(self) -> float:
        """m, from the centre of mass to the furthest point of the convex parts."""
        parts = self.piece.convex_parts
        points = np.concatenate(parts.points) * parts.scale + parts.offset
        return float(np.linalg.norm(points - self.piece.center_of_mass, axis=1).max())

    @property
    def bearable_impulse(self) -> float:
        """N·s: impulses that sum to less break nothing, wherever they act."""
        return self.asset.bearable_impulse

    def may_break(self, impulses: Impulse | Sequence[Impulse]) -> bool:
        """False when these impulses together are surely too weak; costs no model query."""
        impulses = as_impulses(impulses)
        if len(self.piece.atoms) == 1:
            return False
        corners, barycentric = self.locate(np.array([impulse.point for impulse in impulses]))
        return self.asset._may_break(corners, barycentric, self.asset._severities(impulses), whole=False)

    def fracture(self, impulses: Impulse | Sequence[Impulse], predictor: str = "field") -> Fracture:
        """What impulses do to the piece, as ``BreakableAsset.fracture``; pieces are of the asset's atoms again.

        The severity is the impulse over the piece's own mass times the breaking velocity.
        """
        return self.asset._fracture(as_impulses(impulses), predictor, gated=True, fragment=self)

    def unbroken(self) -> Fracture:
        """What no impulse at all would do; asks no model."""
        return self.asset._nothing(self.domain)

    def breakable_piece(self, piece: Piece) -> BreakablePiece:
        """One of its pieces, which is one of the asset's."""
        return BreakablePiece(self.asset, piece)

    @cached_property
    def _outside(self) -> tuple[IntArray, cKDTree]:
        """The vertices of the asset's surface that the piece has (all, if it has none), to be found by place."""
        arrays = self.asset.arrays
        own = np.flatnonzero(np.isin(arrays.vertex_atom, self.piece.atoms))
        own = own if len(own) else np.arange(self.asset.vertex_count)
        return own, cKDTree(arrays.points[own])

    def locate(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """The vertices of the asset's surface nearest to ``points`` (K, 3) m that the piece has, as
        ``BreakableAsset._locate`` would give them: an impact on a crack counts where the surface is next."""
        own, tree = self._outside
        nearest = own[tree.query((points - self.asset.offset) / self.asset.scale)[1]]
        return np.repeat(nearest[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(points), 1))


def load(source: str | os.PathLike[str]) -> BreakableAsset:
    """Read an asset from a file, or one that ships by its name: bunny, chair, vase.

    Raises AssetError, naming the file and the fault, if it is missing, truncated, or of another format.
    """
    path = Path(source)
    shipped = resources.files("fracsim.meshes")
    if not path.suffix and not path.exists():
        entry = shipped / f"{source}{SUFFIX}"
        if not entry.is_file():
            names = sorted(item.name[: -len(SUFFIX)] for item in shipped.iterdir() if item.name.endswith(SUFFIX))
            raise AssetError(f"{source}: no such asset; those that ship are {', '.join(names)}; or give a file")
        return _parse(entry.read_bytes(), str(source))
    if not path.is_file():
        raise AssetError(f"{path}: no such file")
    return _parse(path.read_bytes(), str(path))


def _parse(data: bytes, where: str) -> BreakableAsset:
    from safetensors import SafetensorError
    from safetensors.numpy import load as load_tensors

    again = "bake it again with: fracsim bake"
    try:
        tensors = load_tensors(data)
        header = header_of(data, "fracsim")
    except SafetensorError as error:
        raise AssetError(f"{where}: truncated or not an asset ({error}); {again}") from error
    except (KeyError, ValueError, TypeError) as error:
        raise AssetError(f"{where}: not a fracsim asset (its header is missing); {again}") from error
    if header.get("format") != FORMAT:
        raise AssetError(f"{where}: format {header.get('format')}, this version reads {FORMAT}; {again}")
    try:
        arrays = {name: tensors[f"asset.{name}"] for name in AssetArrays.__dataclass_fields__}
        for name, value in arrays.items():
            if value.dtype.kind == "i":
                arrays[name] = value.astype(np.int64)
        model = FieldWeights(**{name: tensors[f"model.{name}"] for name in FieldWeights.names()})
        material = Material(**header["material"])
        asset = BreakableAsset(
            name=str(header["name"]),
            material=material,
            scale=float(header["scale"]),
            offset=np.array(header["offset"], dtype=np.float64),
            cap=float(header["cap"]),
            min_piece_volume_fraction=float(header["min_piece_volume_fraction"]),
            arrays=AssetArrays(**arrays),
            model=model,
            metadata=header["metadata"],
            baked_from=SimulatorRecord(**header["baked_from"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise AssetError(f"{where}: an entry of the asset is missing or malformed ({error}); {again}") from error
    for name, value in tensors.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise AssetError(f"{where}: {name} holds values that are not finite; {again}")
    for fault in contradictions(asset.arrays, asset.model):
        raise AssetError(f"{where}: {fault}; {again}")
    return asset


def _ms(begin: float) -> float:
    return (time.perf_counter() - begin) * 1e3
