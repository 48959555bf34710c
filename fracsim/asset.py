"""The baked asset: everything a running simulation needs to break one object, in one file of plain arrays."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from .breaking import Interfaces, absorb_crumbs, components, drives, separated, weakest_cut
from .errors import AssetError, FieldError, FracsimError
from .impulse import Impulse, as_impulses
from .material import Material, as_material
from .models.field import FieldModel, field_from_scores, parting_scores
from .pieces import AtomComplex, Hull, Piece, vertex_cells
from .sampling import CONE, SurfacePoints, cone, ratios
from .segmentation.basins import Basins

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FORMAT = 2
SUFFIX = ".frac"
PREDICTORS = ("field", "interfaces", "modes")


@dataclass(frozen=True, eq=False)
class AssetArrays:
    """What is in the file, lengths in units of the largest extent.

    faces: (F, 3) of the surface, whose vertices are the first V points. points, triangles, sides: the atoms'
    complex. rows: (V, A) impact field. pairs, areas, normals, projected: the interfaces.
    distances: (I, V) geodesic distances to their curves. shores: (I, S) vertices along these, -1 where an
    interface does not reach the surface. hull_points, hull_faces: the atoms' convex parts one after the other,
    with hull_sizes (H, 2) points and faces in each, and hull_atoms (H,); body_...: those of the whole.
    """

    faces: IntArray
    points: FloatArray
    triangles: IntArray
    sides: IntArray
    rows: npt.NDArray[np.float32]
    pairs: IntArray
    areas: FloatArray
    normals: FloatArray
    projected: FloatArray
    distances: npt.NDArray[np.float16]
    shores: IntArray
    hull_points: FloatArray
    hull_faces: IntArray
    hull_sizes: IntArray
    hull_atoms: IntArray
    body_points: FloatArray
    body_faces: IntArray
    body_sizes: IntArray

    # What follows from them, worked out once and shared by all sizes and materials of an asset

    @cached_property
    def complex(self) -> AtomComplex:
        return AtomComplex(self.points, self.triangles, self.sides)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.complex.moments()

    @cached_property
    def interfaces(self) -> Interfaces:
        return Interfaces(self.pairs, self.areas, self.normals, self.projected)

    @cached_property
    def vertex_atom(self) -> IntArray:
        """(V,) the atom of each vertex."""
        return vertex_cells(self.triangles, self.sides, len(self.points))[: len(self.rows)]

    @cached_property
    def basins(self) -> Basins:
        return Basins.of(self.shores, self.distances, self.pairs, self.areas, self.complex.count)

    @cached_property
    def weakest(self) -> tuple[FloatArray, FloatArray]:
        """(V,) severities below which no point of the faces around a vertex can be hit to any effect: by one
        blow, nothing parts; by several, each counted as a share of its own, no interface even breaks."""
        pairs = self.pairs
        jump = np.abs(self.rows[:, pairs[:, 0]] - self.rows[:, pairs[:, 1]]).astype(np.float64)
        # Between vertices the field is linear, so no jump there exceeds the largest around; and no direction
        # drives an interface by more than the whole jump, as neither κ nor β exceeds 1.
        start, end = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]).T
        order = np.argsort(start, kind="stable")  # a closed surface runs along every edge in both directions
        first = np.searchsorted(start[order], np.arange(len(jump)))
        jump = np.maximum(jump, np.maximum.reduceat(jump[end[order]], first))
        return 1.0 / weakest_cut(jump, pairs, self.complex.count), 1.0 / jump.max(axis=1)

    @cached_property
    def face_tree(self) -> cKDTree:
        return cKDTree(self.points[self.faces].mean(axis=1))


@dataclass(frozen=True)
class Truth:
    """What the asset was baked from. kind: "modal", whose impact field the asset carries and can answer from; any
    other is known by its samples alone. least: total severity below which none of these broke, halved to be safe.
    typical: the median one at which a single blow first parts the body.
    """

    kind: str = "modal"
    least: float = 0.0
    typical: float = 1.0


@dataclass(frozen=True, eq=False)
class Fracture:
    """What a blow does to an asset.

    labels: (V,), the piece that each vertex lies on. udf: (V,) m, distance to the nearest crack, capped.
    pieces: one for each label; a single one is the unbroken body. timings: ms by stage.
    severity: the impulse over mass times breaking velocity; clamped: whether it lay beyond what the model was
    trained on and was lowered to that.
    """

    labels: IntArray
    udf: FloatArray
    pieces: tuple[Piece, ...]
    timings: dict[str, float]
    predictor: str
    severity: float
    clamped: bool

    @property
    def broken(self) -> bool:
        return len(self.pieces) > 1


@dataclass(frozen=True, eq=False)
class BreakableAsset:
    """A breakable object: made by ``fracsim.bake``, read by ``fracsim.load``.

    scale: m, its largest extent. offset: (3,) m, where the centre of its bounding box lies in its own frame.
    cap, crumb_floor: of the largest extent, of the volume. metadata: how it was baked and how good it is.
    """

    name: str
    material: Material
    scale: float
    offset: FloatArray
    cap: float
    crumb_floor: float
    arrays: AssetArrays
    model: FieldModel
    metadata: dict[str, Any]
    truth: Truth = Truth()

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
        return len(self.arrays.rows)

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
        unit = self.mass * self.material.breaking_velocity
        severities = np.array([impulse.magnitude for impulse in impulses]) / unit
        return self._may_break(corners, barycentric, severities)

    @cached_property
    def _weakest(self) -> tuple[FloatArray, FloatArray]:
        """``AssetArrays.weakest``, or what is known of it where the truth is known by its samples alone."""
        if self.truth.kind == "modal":
            return self.arrays.weakest
        least = np.full(self.vertex_count, self.truth.least)
        return least, least

    def _may_break(self, corners: IntArray, barycentric: FloatArray, severities: FloatArray) -> bool:
        nearest = corners[np.arange(len(corners)), np.argmax(barycentric, axis=1)]
        bound = self._weakest[0 if len(corners) == 1 else 1][nearest]
        return float((severities / bound).sum()) >= 1.0

    def fracture(self, impulses: Impulse | Sequence[Impulse], predictor: str = "field") -> Fracture:
        """What one impulse, or several acting together, do to the unbroken asset.

        predictor: "field", the learned distance field, segmented; "interfaces", the pieces that the same model's
        break scores leave, with no field between; or "modes", the modal truth's own answer, which an asset baked from
        another truth does not carry.
        Raises ImpulseError, or FieldError when the model's field is not finite.
        """
        return self._fracture(as_impulses(impulses), predictor, gated=True)

    def _fracture(self, impulses: Sequence[Impulse], predictor: str, gated: bool) -> Fracture:
        """gated: whether blows that are surely too weak are spared the model, which is to be told when it is judged."""
        if predictor not in PREDICTORS:
            raise FracsimError(f"unknown predictor {predictor!r}; use one of {', '.join(PREDICTORS)}")
        if predictor == "modes" and self.truth.kind != "modal":
            raise FracsimError(f"{self.name}: was baked from a truth that it does not carry ({self.truth.kind})")
        begin = time.perf_counter()
        corners, barycentric = self._locate(np.array([impulse.point for impulse in impulses]))
        directions = np.array([impulse.direction for impulse in impulses])
        severities = np.array([impulse.magnitude for impulse in impulses]) / (
            self.mass * self.material.breaking_velocity
        )
        severity = float(severities.sum())
        limit = float(self.model.severity[0])
        clamped = predictor != "modes" and severity > limit
        if clamped:
            severities *= limit / severity
        timings = {"impulse": _ms(begin)}
        begin = time.perf_counter()
        pairs, count = self.arrays.pairs, self.arrays.complex.count
        if predictor == "modes":
            rows = np.einsum("kc,kca->ka", barycentric, self.arrays.rows[corners])
            broken = drives(rows[None], directions[None], severities[None], self.arrays.interfaces)[0] >= 1.0
        elif gated and not self._may_break(corners, barycentric, severities):
            timings["field"] = _ms(begin)
            whole, flat = np.zeros(count, dtype=np.int64), np.full(self.vertex_count, self.cap)
            return self._finish(whole, flat, timings, predictor, severity, clamped)
        else:
            scores = self.model.scores(corners, barycentric, directions, severities, pairs)
            if not np.isfinite(scores).all():
                raise FieldError(f"{self.name}: the model's scores are not finite; no fracture follows from them")
            if predictor == "field":
                field = field_from_scores(parting_scores(scores, pairs, count), self.arrays.distances, self.cap)
                timings["field"] = _ms(begin)
                return self._cut(field, timings, predictor, severity, clamped)
            broken = scores >= self.model.level[0]
        labels = components(~broken[None], pairs, count)[0]
        labels = absorb_crumbs(labels, self.arrays.moments[0], self.arrays.interfaces, self.crumb_floor)
        timings["labels"] = _ms(begin)
        begin = time.perf_counter()
        field = field_from_scores(separated(labels, pairs).astype(np.float64), self.arrays.distances, self.cap)
        timings["field"] = _ms(begin)
        return self._finish(labels, field, timings, predictor, severity, clamped)

    def fracture_from_field(self, udf: npt.ArrayLike) -> Fracture:
        """The pieces of a given field: udf (V,) m, distance to the nearest crack, such as a model of one's own."""
        field = np.asarray(udf, dtype=np.float64)
        if field.shape != (self.vertex_count,):
            raise FieldError(f"{self.name}: a field must have shape ({self.vertex_count},), got {field.shape}")
        return self._cut(field / self.scale, {}, "given", 0.0, False)

    def sample_impulses(self, count: int, seed: int | np.random.Generator) -> list[Impulse]:
        """Single impulses over the area, in a cone about the inward normal, at 0.3 to 5 times what first
        parts the body at that point in that direction (typically parts it, for an asset of another truth than the
        modal one)."""
        rng = np.random.default_rng(seed)
        pool = SurfacePoints(self.arrays.points[: self.vertex_count], self.faces)
        face, barycentric = pool.draw(count, rng)
        directions = cone(-pool.normals[face], CONE, rng)
        ratio = ratios(count, rng)
        severity = ratio * self.truth.typical
        if self.truth.kind == "modal":
            rows = pool.rows(self.arrays.rows, face[:, None], barycentric[:, None])
            drive = drives(rows, directions[:, None], np.ones((count, 1)), self.arrays.interfaces)
            severity = ratio / weakest_cut(drive, self.arrays.pairs, self.arrays.complex.count)
        magnitude = severity * self.mass * self.material.breaking_velocity
        points = pool.at(face, barycentric) * self.scale + self.offset
        return [Impulse(*blow) for blow in zip(points, directions, magnitude, strict=True)]

    # Parts of the above

    def _locate(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """The surface points nearest to ``points`` (K, 3) m, as vertices (K, 3) and barycentric coordinates."""
        local = (points - self.offset) / self.scale
        _, nearest = self.arrays.face_tree.query(local, k=min(16, len(self.faces)))
        corner = self.arrays.points[self.faces[nearest]]  # (K, 16, 3, 3)
        barycentric, square = _closest_on_triangles(local[:, None], corner)
        best = np.argmin(square, axis=1)
        row = np.arange(len(points))
        return self.faces[nearest[row, best]], barycentric[row, best]

    def _cut(
        self, field: FloatArray, timings: dict[str, float], predictor: str, severity: float, clamped: bool
    ) -> Fracture:
        if not np.isfinite(field).all():
            raise FieldError(f"{self.name}: the field holds values that are not finite; no fracture follows from it")
        begin = time.perf_counter()
        arrays = self.arrays
        labels = arrays.basins.labels(field, self.model.pass_height)
        labels = absorb_crumbs(labels, self.arrays.moments[0], self.arrays.interfaces, self.crumb_floor)
        timings["segmentation"] = _ms(begin)
        return self._finish(labels, field, timings, predictor, severity, clamped)

    def _finish(
        self,
        labels: IntArray,
        field: FloatArray,
        timings: dict[str, float],
        predictor: str,
        severity: float,
        clamped: bool,
    ) -> Fracture:
        begin = time.perf_counter()
        order = np.argsort(labels, kind="stable")
        groups = np.split(order, np.cumsum(np.bincount(labels))[:-1])
        pieces = tuple(self._piece(group, labels, k) for k, group in enumerate(groups))
        timings["pieces"] = _ms(begin)
        vertex_labels = labels[self.arrays.vertex_atom]
        return Fracture(vertex_labels, field * self.scale, pieces, timings, predictor, severity, clamped)

    def _piece(self, atoms: IntArray, labels: IntArray, index: int) -> Piece:
        volume, mass, center, inertia = self._mass_properties(atoms)
        hulls = tuple(hull for atom in atoms.tolist() for hull in self._atom_hulls[atom])

        def surface() -> tuple[FloatArray, IntArray, npt.NDArray[np.bool_]]:
            vertices, faces, outer = self.arrays.complex.surface(labels == index)
            return vertices * self.scale + self.offset, faces, outer

        return Piece(volume, mass, center, inertia, hulls, atoms, surface)

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
    def _atom_hulls(self) -> list[list[Hull]]:
        result: list[list[Hull]] = [[] for _ in range(self.arrays.complex.count)]
        arrays = self.arrays
        hulls = self._hulls(arrays.hull_points, arrays.hull_faces, arrays.hull_sizes)
        for atom, hull in zip(self.arrays.hull_atoms.tolist(), hulls, strict=True):
            result[atom].append(hull)
        return result

    # The file

    def save(self, path: str | Path) -> None:
        """Write the asset, beside and then over ``path``, so that no half of a file is ever there."""
        from safetensors.numpy import save

        tensors = {f"asset.{name}": _compact(getattr(self.arrays, name)) for name in AssetArrays.__dataclass_fields__}
        tensors |= {f"model.{name}": np.ascontiguousarray(value) for name, value in vars(self.model).items()}
        header = {
            "format": FORMAT,
            "name": self.name,
            "material": self.material.to_dict(),
            "scale": self.scale,
            "offset": self.offset.tolist(),
            "cap": self.cap,
            "crumb_floor": self.crumb_floor,
            "metadata": self.metadata,
            "truth": asdict(self.truth),
        }
        write_beside(Path(path), save(tensors, metadata={"fracsim": json.dumps(header, sort_keys=True)}))


def write_beside(path: Path, data: bytes) -> None:
    """Write a file under another name in the same folder, then rename it: all of it, or nothing."""
    if not path.parent.is_dir():
        raise AssetError(f"{path}: the folder {path.parent} does not exist")
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise AssetError(f"{path}: cannot be written ({error.strerror})") from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


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


def header_of(data: bytes, key: str) -> dict[str, Any]:
    """What is told under ``key`` in the metadata of a safetensors file that has been found to be one. Raises KeyError,
    ValueError or TypeError where there is nothing of the kind."""
    length = int.from_bytes(data[:8], "little")
    return json.loads(json.loads(data[8 : 8 + length])["__metadata__"][key])


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
        model = FieldModel(**{name: tensors[f"model.{name}"] for name in FieldModel.names()})
        material = Material(**header["material"])
        asset = BreakableAsset(
            name=str(header["name"]),
            material=material,
            scale=float(header["scale"]),
            offset=np.array(header["offset"], dtype=np.float64),
            cap=float(header["cap"]),
            crumb_floor=float(header["crumb_floor"]),
            arrays=AssetArrays(**arrays),
            model=model,
            metadata=header["metadata"],
            truth=Truth(**header.get("truth", {})),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise AssetError(f"{where}: an entry of the asset is missing or malformed ({error}); {again}") from error
    for name, value in tensors.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise AssetError(f"{where}: {name} holds values that are not finite; {again}")
    for fault in _contradictions(asset.arrays, asset.model):
        raise AssetError(f"{where}: {fault}; {again}")
    return asset


def _contradictions(arrays: AssetArrays, model: FieldModel) -> Iterator[str]:
    """What cannot be, so that no later question trips over it: indices out of range, sizes that do not agree."""
    vertices, atoms, interfaces = *arrays.rows.shape, len(arrays.pairs)
    for name, limit in (
        ("faces", vertices),
        ("triangles", len(arrays.points)),
        ("sides", atoms),
        ("pairs", atoms),
        ("shores", vertices),
        ("hull_atoms", atoms),
    ):
        values = getattr(arrays, name)
        lowest = -1 if name in ("sides", "shores") else 0
        if values.size and not (lowest <= values.min() and values.max() < limit):
            yield f"{name} points outside its range"
    if vertices > len(arrays.points) or len(model.coordinates) != vertices:
        yield "the numbers of vertices do not agree"
    if not interfaces == len(arrays.distances) == len(arrays.shores) == len(arrays.normals) == len(model.slope):
        yield "the numbers of interfaces do not agree"
    if arrays.distances.shape != (interfaces, vertices):
        yield "the distances do not fit the vertices"
    for kind in ("hull", "body"):
        points, faces, sizes = (getattr(arrays, f"{kind}_{what}") for what in ("points", "faces", "sizes"))
        if not np.array_equal(sizes.sum(axis=0), (len(points), len(faces))):
            yield "the convex parts are not of the sizes stated"


def _compact(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Integers in no more bits than they need; everything else as it is."""
    if values.dtype.kind == "i":
        for small in (np.int16, np.int32):
            if values.size == 0 or max(values.max(), -values.min()) <= np.iinfo(small).max:
                return np.ascontiguousarray(values, dtype=small)
    return np.ascontiguousarray(values)


def _ms(begin: float) -> float:
    return (time.perf_counter() - begin) * 1e3


def _closest_on_triangles(points: FloatArray, triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nearest points on triangles: barycentric coordinates (..., 3) and squared distances (...)."""
    a, b, c = np.moveaxis(triangles, -2, 0)
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (np.einsum("...i,...i->...", x, y) for x, y in ((u, u), (u, v), (v, v)))
    uw, vw = (np.einsum("...i,...i->...", x, w) for x in (u, v))
    determinant = uu * vv - uv**2
    s, t = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    along_u, along_v = np.clip(uw / uu, 0, 1), np.clip(vw / vv, 0, 1)
    edge = np.clip((vw - uw - uv + uu) / (uu - 2 * uv + vv), 0, 1)
    zero = np.zeros_like(s)
    options = np.stack(
        [np.stack([along_u, zero], -1), np.stack([zero, along_v], -1), np.stack([1 - edge, edge], -1)], axis=-2
    )
    reach = options[..., :1] * u[..., None, :] + options[..., 1:] * v[..., None, :] - w[..., None, :]
    nearest = np.argmin((reach**2).sum(-1), axis=-1)
    on_edge = np.take_along_axis(options, nearest[..., None, None], axis=-2)[..., 0, :]
    st = np.where(inside[..., None], np.stack([s, t], -1), on_edge)
    gap = st[..., :1] * u + st[..., 1:] * v - w
    return np.concatenate([1 - st.sum(-1, keepdims=True), st], axis=-1), (gap**2).sum(-1)
