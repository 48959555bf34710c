"""Datasets on disk: one HDF5 file that says what made it, and can be made again from its own header. Offline only.

A file holds the surface, the generator with everything it needs to answer again, and samples in chunks of one block,
compressed and checksummed. It is written block by block in HDF5's single-writer-multiple-readers mode, so another
process may read it meanwhile, and whatever stops the writer, the finished blocks stay readable.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .breaking import Interfaces
from .dataset import (
    BLOCK,
    CONTACTS,
    FOLDS,
    KINDS,
    SEVERAL,
    TEST,
    VALIDATION,
    Samples,
    draw_blows,
    run_blocks,
    sample_block,
)
from .errors import DatasetError, MissingExtraError
from .generator import TRUTHS, Generator, ModalGenerator, TruthOptions, interfaces_between, make_generator
from .mesh import Surface, facing_vertices
from .models.field import field_from_scores
from .progress import Stages
from .radial import RadialGenerator
from .sampling import CONE, SEVERITY
from .solid import Solid
from .udf import CAP, CurveDistances, interface_distances

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("h5py", "bake") from error

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FORMAT = "fracsim dataset"
VERSION = 1


class Dataset:
    """A dataset file, open for reading, possibly while another process writes it.

    header: what made it. surface, parts: what it is about. generator: the truth itself, or None where it was one of
    the user's own, which no file can hold. links: (L, 2) vertices that face each other through a thin wall.
    Raises DatasetError, naming the file and the fault.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.file = _open(self.path)
        try:
            header = json.loads(self.file.attrs["header"])
            self.header: dict[str, Any] = header
            surface = self.file["surface"]
            self.surface = Surface(
                _read(surface["vertices"], self.path),
                _read(surface["faces"], self.path).astype(np.int64),
                float(surface.attrs["scale"]),
                np.array(surface.attrs["offset"], dtype=np.float64),
                str(surface.attrs["name"]),
            )
            self.links = _read(self.file["links"], self.path).astype(np.int64)
            self.parts = _load_solid(self.file["parts"], self.path)
            self.generator = self._generator()
        except (KeyError, ValueError, TypeError) as error:
            self.file.close()
            raise DatasetError(f"{self.path}: not a complete fracsim dataset ({error})") from error

    def __enter__(self) -> Dataset:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def __len__(self) -> int:
        return int(self.complete.sum())

    @property
    def seed(self) -> int:
        return int(self.header["seed"])

    @property
    def complete(self) -> IntArray:
        """(B,) how many rows of each block are there; refreshed from the file, which may be growing."""
        blocks = self.file["complete"]
        blocks.id.refresh()
        return _read(blocks, self.path).astype(np.int64)

    def samples(self, skip_damaged: bool = False) -> Samples:
        """All samples, in order. A damaged chunk raises DatasetError by name, or is skipped with the rest of its
        block."""
        good = [block for block, count in enumerate(self.complete) if count]
        if skip_damaged:
            bad = {block for block, _ in self.damage()}
            good = [block for block in good if block not in bad]
        return Samples.join([self._block(block) for block in good]) if good else _no_samples(self)

    def fields(self, labels: IntArray) -> npt.NDArray[np.float32]:
        """(N, V + E), in units of the largest extent: geodesic distance to the nearest crack at the vertices and
        edge midpoints, capped, of fractures that leave the parts labels (N, P).

        Where cracks are fixed, the least of the stored distances to the interfaces that part pieces; else by fast
        marching, some 10 ms each."""
        if "distances" not in self.file["interfaces"]:
            curves = CurveDistances(self.parts, self.surface)
            return np.array([curves.between(row) for row in labels], dtype=np.float32)
        pairs = _read(self.file["interfaces/pairs"], self.path)
        distances = _read(self.file["interfaces/distances"], self.path)
        parted = labels[:, pairs[:, 0]] != labels[:, pairs[:, 1]]
        return np.array([field_from_scores(row.astype(np.float64), distances, CAP) for row in parted], dtype=np.float32)

    def damage(self) -> list[tuple[int, str]]:
        """Blocks that cannot be read, and the chunk's name in each."""
        found = []
        for block, count in enumerate(self.complete):
            for name, data in self.file["samples"].items():
                try:
                    data.id.refresh()
                    data[block * BLOCK : block * BLOCK + count]
                except OSError:
                    found.append((block, f"/samples/{name}, rows {block * BLOCK} to {block * BLOCK + count - 1}"))
        return found

    def _block(self, block: int) -> Samples:
        count = int(self.complete[block])
        rows = slice(block * BLOCK, block * BLOCK + count)
        values = {}
        for name in (field.name for field in fields(Samples)):
            data = self.file["samples"][name]
            data.id.refresh()
            try:
                value = data[rows]
            except OSError as error:
                raise DatasetError(
                    f"{self.path}: the chunk of /samples/{name}, rows {rows.start} to {rows.stop - 1}, is damaged; "
                    "the rest can be read with skip_damaged, and making the dataset again with the same options "
                    "mends it"
                ) from error
            if name == "broken":
                value = np.unpackbits(value, axis=1, count=int(data.attrs["width"])).astype(bool)
            elif np.issubdtype(value.dtype, np.integer):
                value = value.astype(np.int64)
            values[name] = value
        return Samples(**values)

    def _generator(self) -> Generator | None:
        floor = float(self.header["truth"].get("crumb_floor", 0.0))
        kind = self.header["truth"]["truth"]
        if kind == "radial":
            return RadialGenerator(self.surface, self.parts, floor)
        if kind not in ("modal", "elastic"):
            return None
        group = self.file["atoms"]
        joints = self.file["interfaces"]
        cells, atom = _load_solid(group["cells"], self.path), _read(group["atom"], self.path).astype(np.int64)
        rows = _read(group["rows"], self.path).astype(np.float64)
        interfaces = Interfaces(
            _read(joints["pairs"], self.path).astype(np.int64),
            *(_read(joints[name], self.path) for name in ("areas", "normals", "projected")),
        )
        if kind == "elastic":
            from .elastic import ElasticGenerator

            gauge = float(group.attrs["gauge"])
            return ElasticGenerator(self.surface, self.parts, interfaces, rows, gauge, floor, cells, atom)
        energies = tuple(tuple(energies) for energies in json.loads(group.attrs["energies"]))
        return ModalGenerator(self.surface, cells, atom, self.parts, interfaces, rows, floor, energies)


def make_dataset(
    path: str | Path,
    surface: Surface,
    total: int,
    seed: int = 0,
    options: TruthOptions | None = None,
    generator: Generator | None = None,
    workers: int = 1,
    backend: str = "joblib",
    progress: bool = False,
) -> dict[str, float]:
    """Make a dataset of ``total`` samples, or bring the one that is there to it; what is there already stays.

    options say which truth to build; generator is one of the user's own instead. An interrupted file is taken up
    where it was left and damaged blocks are made again. Returns the seconds of each stage. Raises DatasetError when
    the file is something else, or was made of another surface, of other options or from another seed.
    """
    path = Path(path)
    if total < 1:
        raise DatasetError(f"{path}: the number of samples must be at least 1, got {total}")
    if seed < 0:
        raise DatasetError(f"{path}: a seed must be at least 0, got {seed}")
    if not path.absolute().parent.is_dir():
        raise DatasetError(f"{path}: the folder {path.parent} does not exist; create it first")
    options = options or TruthOptions()
    with Stages(progress) as stage:
        if path.exists():
            stage("check")
            with Dataset(path) as there:
                own = there.header["truth"]["truth"]
                if generator is None and own not in TRUTHS:
                    raise DatasetError(f"{path}: its truth was one of your own ({own}); pass that generator to go on")
                _same(there, surface, seed, asdict(options) if generator is None else _named(generator))
                generator = generator or there.generator
                damaged = bool(there.damage())
            if damaged or not _clean(path):
                _salvage(path)
        else:
            truth = asdict(options) if generator is None else _named(generator)
            generator = generator or make_generator(surface, options, seed, stage)
            _create(path, surface, generator, seed, truth, stage)
        stage("samples")
        with _write(path) as file:
            known = file["complete"][:]
            blocks = -(-total // BLOCK)
            present = np.zeros(blocks, dtype=np.int64)
            present[: len(known)] = known[:blocks]
            wanted = np.minimum(BLOCK, total - BLOCK * np.arange(blocks))
            missing = np.flatnonzero(present < wanted).tolist()
            file.swmr_mode = True
            assert generator is not None
            results = run_blocks(sample_block, generator, seed, missing, workers, backend)
            for done, (block, samples) in enumerate(zip(missing, results, strict=True), 1):
                _append(file, block, samples.rows(slice(int(wanted[block]))))
                stage("samples", done / len(missing))
    return stage.seconds


def regenerate(
    source: str | Path, path: str | Path, workers: int = 1, backend: str = "joblib", progress: bool = False
) -> dict[str, float]:
    """Make a dataset again from nothing but another one's header and surface; returns the seconds of each stage."""
    if Path(path).exists():
        raise DatasetError(f"{path}: exists already; name a new file")
    with Dataset(source) as old:
        kind = old.header["truth"]["truth"]
        if kind == "elastic":
            raise DatasetError(
                f"{source}: elastic stress is kept in the file but cannot be worked out again bit by bit"
            )
        if kind not in TRUTHS:
            raise DatasetError(f"{source}: its truth was one of your own and cannot be made again from the file")
        surface, total, seed, truth = old.surface, len(old), old.seed, old.header["truth"]
    return make_dataset(path, surface, total, seed, TruthOptions(**truth), None, workers, backend, progress)


def _open(path: Path) -> h5py.File:
    if not path.is_file():
        raise DatasetError(f"{path}: no such file")
    # As one of many readers only where there is a writer, or was one that never closed the file: waiting for a writer
    # that will never come, HDF5 tries for minutes to read what a truncated file has lost. Byte 11 of the superblock
    # (version 3) holds the consistency flags.
    with path.open("rb") as raw:
        head = raw.read(12)
    growing = len(head) == 12 and head.startswith(b"\x89HDF\r\n\x1a\n") and head[8] >= 3 and head[11] != 0
    try:
        file = h5py.File(path, "r", libver="latest", swmr=growing)
    except OSError as error:
        raise DatasetError(f"{path}: not an HDF5 file, or damaged beyond reading ({error})") from error
    if file.attrs.get("format") != FORMAT or file.attrs.get("version") != VERSION:
        kind = (file.attrs.get("format"), file.attrs.get("version"))
        file.close()
        raise DatasetError(f"{path}: is {kind[0]!r} version {kind[1]!r}, expected {FORMAT!r} version {VERSION}")
    return file


def _read(data: Any, path: Path) -> Any:
    try:
        return data[()]
    except OSError as error:
        raise DatasetError(f"{path}: {data.name} is damaged; make the dataset again") from error


def _clean(path: Path) -> bool:
    """Whether the last writer closed the file."""
    try:
        h5py.File(path, "r+", libver="latest").close()
    except OSError:
        return False
    return True


@contextmanager
def _write(path: Path) -> Iterator[h5py.File]:
    try:
        file = h5py.File(path, "r+", libver="latest")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written ({error}); is another process writing it?") from error
    with file:
        yield file


@contextmanager
def _beside(path: Path) -> Iterator[h5py.File]:
    """A new file that takes the place of ``path`` once it is whole."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.absolute().parent)
    os.close(handle)
    try:
        with h5py.File(name, "w", libver="latest") as file:
            yield file
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _create(
    path: Path,
    surface: Surface,
    generator: Generator,
    seed: int,
    truth: dict[str, Any],
    stage: Stages,
) -> None:
    header = {
        "fracsim": version("fracsim"),
        "seed": seed,
        "truth": truth,
        "sampling": {
            "block": BLOCK,
            "contacts": CONTACTS,
            "several": SEVERAL,
            "kinds": KINDS,
            "cone": CONE,
            "severity": SEVERITY,
            "test": TEST,
            "validation": VALIDATION,
            "folds": FOLDS,
        },
        "cap": CAP,
        "units": "lengths in units of the largest extent; severity = impulse / (mass * breaking velocity)",
    }
    stage("distances")
    with _beside(path) as file:
        file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
        file.attrs["header"] = json.dumps(header)
        group = file.create_group("surface")
        _put(group, "vertices", surface.vertices)
        _put(group, "faces", surface.faces.astype(np.int32))
        group.attrs["scale"], group.attrs["offset"], group.attrs["name"] = surface.scale, surface.offset, surface.name
        _put(file, "links", facing_vertices(surface).astype(np.int32))
        _save_solid(file.create_group("parts"), generator.parts)
        interfaces = 0
        if truth["truth"] in ("modal", "elastic"):
            group = file.create_group("atoms")
            given: Any = generator
            _save_solid(group.create_group("cells"), given.cells)
            _put(group, "atom", given.atom.astype(np.int32))
            if isinstance(generator, ModalGenerator):
                _put(group, "rows", generator.rows)
                group.attrs["energies"] = json.dumps(generator.energies)
            else:
                _put(group, "rows", given.rows.astype(np.float32))
                group.attrs["gauge"] = given.gauge
        joints = interfaces_between(generator.parts)
        group = file.create_group("interfaces")
        _put(group, "pairs", joints.pairs.astype(np.int32))
        for name in ("areas", "normals", "projected"):
            _put(group, name, getattr(joints, name))
        if generator.fixed_cracks:
            # One blow tells whether this truth says which interfaces gave way.
            told = generator.fracture(draw_blows(surface, 1, np.random.default_rng(0))[0]).broken
            interfaces = 0 if told is None else len(joints)
            curves = CurveDistances(generator.parts, surface)
            distances, _ = interface_distances(curves, joints.pairs, stage.ticker("distances"))
            _put(group, "distances", distances.astype(np.float16))
        parts = len(generator.parts.volumes)
        group = file.create_group("samples")
        contacts = (CONTACTS,)
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            "faces": (contacts, np.int32),
            "barycentric": ((*contacts, 3), np.float64),
            "directions": ((*contacts, 3), np.float64),
            "severities": (contacts, np.float64),
            "ratio": ((), np.float64),
            "kind": ((), np.int8),
            "labels": ((parts,), np.uint8 if parts <= 256 else np.uint16 if parts <= 65536 else np.int64),
            "broken": ((-(-interfaces // 8),), np.uint8),
            "split": ((), np.int8),
            "fold": ((), np.int8),
        }
        for name, (shape, dtype) in shapes.items():
            if 0 in shape:  # a generator that knows no interfaces
                shape = (1,)
            group.create_dataset(
                name,
                (0, *shape),
                dtype,
                maxshape=(None, *shape),
                chunks=(BLOCK, *shape),
                compression="gzip",
                compression_opts=4,
                shuffle=True,
                fletcher32=True,
            )
        group["broken"].attrs["width"] = interfaces
        file.create_dataset("complete", (0,), np.int32, maxshape=(None,), chunks=(1024,), fletcher32=True)


def _append(file: h5py.File, block: int, samples: Samples) -> None:
    """Write a block; only when all of it is on disk does it count."""
    start, stop = block * BLOCK, block * BLOCK + len(samples)
    values = {name.name: getattr(samples, name.name) for name in fields(Samples)}
    width = values["broken"].shape[1]
    values["broken"] = np.packbits(values["broken"], axis=1) if width else np.zeros((len(samples), 1), np.uint8)
    for name, value in values.items():
        data = file["samples"][name]
        if len(data) < stop:
            data.resize(stop, axis=0)
        data[start:stop] = value
        data.flush()
    complete = file["complete"]
    if len(complete) <= block:
        complete.resize(block + 1, axis=0)
    complete[block] = len(samples)
    complete.flush()


def _salvage(path: Path) -> None:
    """Rewrite a file that its writer did not close, or that holds damaged blocks, with what is good in it."""
    with Dataset(path) as old, _beside(path) as file:
        for name, value in old.file.attrs.items():
            file.attrs[name] = value
        for name in old.file:
            if name not in ("samples", "complete"):
                old.file.copy(name, file)
        bad = {block for block, _ in old.damage()}
        complete = old.complete
        complete[sorted(bad)] = 0
        group = file.create_group("samples")
        for name, data in old.file["samples"].items():
            rows = min(len(data), len(complete) * BLOCK)
            copy = group.create_dataset_like(name, data, shape=(rows, *data.shape[1:]))
            for key, value in data.attrs.items():
                copy.attrs[key] = value
            for block in np.flatnonzero(complete).tolist():
                part = slice(block * BLOCK, block * BLOCK + int(complete[block]))
                copy[part] = data[part]
        new = file.create_dataset_like("complete", old.file["complete"], shape=complete.shape)
        new[:] = complete


def _named(generator: Generator) -> dict[str, Any]:
    """What a header can say of a generator of the user's own."""
    return {"truth": type(generator).__name__}


def _same(there: Dataset, surface: Surface, seed: int, truth: dict[str, Any]) -> None:
    wrong = []
    if not (
        np.array_equal(there.surface.vertices, surface.vertices) and np.array_equal(there.surface.faces, surface.faces)
    ):
        wrong.append("another surface")
    if there.seed != seed:
        wrong.append(f"seed {there.seed}")
    found = there.header["truth"]
    wrong += [f"{key} {found[key]}" for key in found if found[key] != truth.get(key)]
    if wrong:
        raise DatasetError(f"{there.path}: was made from {', '.join(wrong)}; ask for the same, or name a new file")


def _no_samples(dataset: Dataset) -> Samples:
    widths: dict[str, tuple[int, ...]] = {
        "faces": (CONTACTS,),
        "barycentric": (CONTACTS, 3),
        "directions": (CONTACTS, 3),
        "severities": (CONTACTS,),
        "labels": (len(dataset.parts.volumes),),
        "broken": (int(dataset.file["samples/broken"].attrs["width"]),),
    }
    floats = ("barycentric", "directions", "severities", "ratio")
    return Samples(
        **{
            field.name: np.zeros(
                (0, *widths.get(field.name, ())),
                bool if field.name == "broken" else np.float64 if field.name in floats else np.int64,
            )
            for field in fields(Samples)
        }
    )


def _put(group: h5py.Group, name: str, values: npt.NDArray[Any]) -> None:
    if values.size:
        group.create_dataset(name, data=values, chunks=True, compression="gzip", shuffle=True, fletcher32=True)
    else:
        group.create_dataset(name, data=values)


def _save_solid(group: h5py.Group, solid: Solid) -> None:
    for field in fields(Solid):
        values = getattr(solid, field.name)
        _put(group, field.name, values.astype(np.int32) if np.issubdtype(values.dtype, np.integer) else values)


def _load_solid(group: h5py.Group, path: Path) -> Solid:
    values = {field.name: _read(group[field.name], path) for field in fields(Solid)}
    return Solid(**{k: v.astype(np.int64) if np.issubdtype(v.dtype, np.integer) else v for k, v in values.items()})
