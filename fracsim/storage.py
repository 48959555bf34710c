"""Datasets on disk: one HDF5 file that says what made it, and can be made again from its own header. Offline only.

A file holds the surface, the generator with everything it needs to answer again, and samples in chunks of one block,
compressed and checksummed. It is written block by block in HDF5's single-writer-multiple-readers mode, so another
process may read it meanwhile, and whatever stops the writer, the finished blocks stay readable.
"""

from __future__ import annotations

import fcntl
import json
import operator
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from functools import cached_property
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
    POOL,
    RING,
    SEVERAL,
    TEST,
    TILT,
    VALIDATION,
    Samples,
    check_workers,
    checked,
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
SIGNATURE = b"\x89HDF\r\n\x1a\n"
UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)  # what h5py raises on damage


class Dataset:
    """A dataset file, open for reading, possibly while another process writes it (if it did when this was opened, the
    file may be seen to grow; otherwise open it anew to see more).

    header: what made it. surface, parts: what it is about. links: (L, 2) vertices that face each other through a thin
    wall. Raises DatasetError, naming the file and the fault.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.file = _open(self.path)
        try:
            with _typed(self.path):
                header = json.loads(self.file.attrs["header"])
                self.header: dict[str, Any] = header
                self.block = int(header["sampling"]["block"])
                surface = self.file["surface"]
                self.surface = Surface(
                    surface["vertices"][()],
                    surface["faces"][()].astype(np.int64),
                    float(surface.attrs["scale"]),
                    np.array(surface.attrs["offset"], dtype=np.float64),
                    str(surface.attrs["name"]),
                )
                self.links = self.file["links"][()].astype(np.int64)
                self.parts = _load_solid(self.file["parts"])
                self.names = tuple(self.file["samples"])
                if set(self.names) != {field.name for field in fields(Samples)}:
                    raise ValueError("its samples are not of this version")
        except BaseException:
            self.file.close()
            raise

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
        with _typed(self.path):
            blocks = self.file["complete"]
            blocks.id.refresh()
            return np.asarray(blocks[()], dtype=np.int64)

    @property
    def held(self) -> int:
        """Samples up to the last that is there, blocks missing before it included."""
        complete = self.complete
        return max((block * self.block + int(count) for block, count in enumerate(complete) if count), default=0)

    @cached_property
    def generator(self) -> Generator | None:
        """The truth itself, or None where it was one of the user's own, which no file can hold."""
        truth = self.header["truth"]
        with _typed(self.path):
            if truth["truth"] not in TRUTHS:
                return None
            floor = float(truth["crumb_floor"])
            if truth["truth"] == "radial":
                return RadialGenerator(self.surface, self.parts, floor)
            group, joints = self.file["atoms"], self.file["interfaces"]
            cells, atom = _load_solid(group["cells"]), group["atom"][()].astype(np.int64)
            rows = group["rows"][()].astype(np.float64)
            interfaces = Interfaces(
                joints["pairs"][()].astype(np.int64), *(joints[name][()] for name in ("areas", "normals", "projected"))
            )
            if truth["truth"] == "elastic":
                from .elastic import ElasticGenerator

                gauge = float(group.attrs["gauge"])
                return ElasticGenerator(self.surface, self.parts, interfaces, rows, gauge, floor, cells, atom)
            energies = tuple(tuple(energies) for energies in json.loads(group.attrs["energies"]))
            return ModalGenerator(self.surface, cells, atom, self.parts, interfaces, rows, floor, energies)

    def samples(self, skip_damaged: bool = False) -> Samples:
        """All samples, in order. A damaged chunk raises DatasetError by name, or is skipped with the rest of its
        block."""
        blocks = list(self.blocks(skip_damaged))
        return Samples.join(blocks) if blocks else self._rows(0, 0)

    def blocks(self, skip_damaged: bool = False) -> Iterator[Samples]:
        """The same block by block, for files larger than memory."""
        for block, count in enumerate(self.complete.tolist()):
            if count:
                try:
                    yield self._rows(block * self.block, block * self.block + count)
                except DatasetError:
                    if not skip_damaged:
                        raise

    def fields(self, labels: IntArray) -> npt.NDArray[np.float32]:
        """(N, V + E), in units of the largest extent: geodesic distance to the nearest crack at the vertices and
        edge midpoints, capped, of fractures that leave the parts labels (N, P).

        Where cracks are fixed, the least of the stored distances to the interfaces that part pieces; else by fast
        marching, some 10 ms each."""
        with _typed(self.path):
            joints = self.file["interfaces"]
            pairs = joints["pairs"][()]
            distances = joints["distances"][()] if "distances" in joints else None
        if distances is None:
            curves = CurveDistances(self.parts, self.surface)
            return np.array([curves.between(row) for row in labels], dtype=np.float32)
        parted = labels[:, pairs[:, 0]] != labels[:, pairs[:, 1]]
        cap = float(self.header["cap"])
        return np.array([field_from_scores(row.astype(np.float64), distances, cap) for row in parted], dtype=np.float32)

    def damage(self) -> list[tuple[int, str]]:
        """What cannot be read: blocks and the chunk's name in each; block -1 is not of the samples, and cannot be
        mended."""
        found: list[tuple[int, str]] = []

        def look(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith(("samples/", "complete")):
                try:
                    item[()]
                except UNREADABLE:
                    found.append((-1, f"/{name}"))

        with _typed(self.path):
            self.file.visititems(look)
        for block, count in enumerate(self.complete.tolist()):
            for name in self.names:
                start = block * self.block
                try:
                    data = self.file["samples"][name]
                    data.id.refresh()
                    data[start : start + count]
                except UNREADABLE:
                    found.append((block, f"/samples/{name}, rows {start} to {start + count - 1}"))
        return found

    def _rows(self, start: int, stop: int) -> Samples:
        values = {}
        for name in self.names:
            where = f"the chunk of /samples/{name}, rows {start} to {stop - 1}, is damaged"
            with _typed(self.path, where, "the rest can be read with skip_damaged, and making it again mends it"):
                data = self.file["samples"][name]
                data.id.refresh()
                value = data[start:stop]
                if name == "broken":
                    value = np.unpackbits(value, axis=1, count=int(data.attrs["width"])).astype(bool)
                elif np.issubdtype(value.dtype, np.integer):
                    value = value.astype(np.int64)
                values[name] = value
        return Samples(**values)


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
    """Make a dataset of ``total`` samples, or bring the one that is there to at least as many; what is there stays.

    options say which truth to build; generator is one of the user's own instead, to be passed again to go on. An
    interrupted file is taken up where it was left and damaged blocks are made again. Returns the seconds of each
    stage. Raises DatasetError when the file is something else, was made of another surface, of other options or from
    another seed, or is being written by another process.
    """
    path = Path(path)
    try:
        total, seed = operator.index(total), operator.index(seed)
    except TypeError as error:
        raise DatasetError(f"{path}: the number of samples and the seed must be integers") from error
    if total < 1:
        raise DatasetError(f"{path}: the number of samples must be at least 1, got {total}")
    if seed < 0:
        raise DatasetError(f"{path}: a seed must be at least 0, got {seed}")
    check_workers(workers, backend)
    if not path.absolute().parent.is_dir():
        raise DatasetError(f"{path}: the folder {path.parent} does not exist; create it first")
    options = options or TruthOptions()
    with _alone(path), Stages(progress) as stage:
        if path.exists():
            stage("check")
            with Dataset(path) as there:
                truth = there.header["truth"]
                if generator is None and truth["truth"] not in TRUTHS:
                    raise DatasetError(
                        f"{path}: its truth was one of your own ({truth.get('class')}); pass that generator to go on"
                    )
                _same(there, surface, seed, asdict(options) if generator is None else _named(generator))
                if generator is None:
                    generator = there.generator
                elif not np.array_equal(generator.parts.volumes, there.parts.volumes):
                    raise DatasetError(f"{path}: was made by a generator with other parts; name a new file")
                total = max(total, there.held)
                damage = there.damage()
            for block, name in damage:
                if block < 0:
                    raise DatasetError(f"{path}: {name} is damaged, which cannot be mended; name a new file")
            if damage or _flagged(path):
                _salvage(path)
        else:
            truth = asdict(options) if generator is None else _named(generator)
            if generator is None:
                generator = make_generator(surface, options, seed, stage)
            _create(path, surface, generator, seed, truth, stage)
        stage("samples")
        if generator is None:
            raise DatasetError(f"{path}: holds no generator to go on with")
        with _writing(path):  # no lock of HDF5's: there is ours, and readers must not keep a writer out
            file = h5py.File(path, "r+", libver="latest", locking=False)
        try:
            known = file["complete"][:]
            blocks = -(-total // BLOCK)
            present = np.zeros(blocks, dtype=np.int64)
            present[: len(known)] = known[:blocks]
            wanted = np.minimum(BLOCK, total - BLOCK * np.arange(blocks))
            missing = np.flatnonzero(present < wanted).tolist()
            file.swmr_mode = True
            results = run_blocks(sample_block, generator, seed, missing, workers, backend)
            for done, (block, samples) in enumerate(zip(missing, results, strict=True), 1):
                with _writing(path):
                    _append(file, block, samples.rows(slice(int(wanted[block]))))
                stage("samples", done / len(missing))
        finally:
            with _writing(path):
                file.close()
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
        _same(old, old.surface, old.seed, old.header["truth"])
        surface, total, seed, truth = old.surface, old.held, old.seed, old.header["truth"]
    return make_dataset(path, surface, total, seed, TruthOptions(**truth), None, workers, backend, progress)


def sampling_rules() -> dict[str, Any]:
    """How samples are drawn; files drawn by other rules are read but not gone on with."""
    return {
        "block": BLOCK,
        "contacts": CONTACTS,
        "several": SEVERAL,
        "kinds": list(KINDS),
        "cone": CONE,
        "severity": list(SEVERITY),
        "test": TEST,
        "validation": VALIDATION,
        "folds": FOLDS,
        "pool": POOL,
        "ring": list(RING),
        "tilt": TILT,
    }


@contextmanager
def _typed(
    path: Path, where: str = "damaged or incomplete", way_out: str = "make it again, in a new file"
) -> Iterator[None]:
    """Whatever h5py raises on a damaged file, as a DatasetError."""
    try:
        yield
    except UNREADABLE as error:
        raise DatasetError(f"{path}: {where} ({error}); {way_out}") from error


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keeps any other process from making the same file meanwhile. HDF5's own locks end where readers are let in."""
    lock = path.with_name(f".{path.name}.lock")
    try:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written ({error.strerror})") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(handle).st_nlink == 0:  # its last owner has just removed it
                raise BlockingIOError
        except BlockingIOError as error:
            raise DatasetError(f"{path}: another process is writing it; wait for it, or name a new file") from error
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _flagged(path: Path) -> bool:
    """Whether the file says that somebody has it open for writing, in byte 11 of a version 3 superblock."""
    with path.open("rb") as raw:
        head = raw.read(12)
    return len(head) == 12 and head.startswith(SIGNATURE) and head[8] >= 3 and head[11] != 0


def _open(path: Path) -> h5py.File:
    if path.is_dir():
        raise DatasetError(f"{path}: is a folder; name a file in it")
    if not path.is_file():
        raise DatasetError(f"{path}: no such file")
    try:
        with path.open("rb") as raw:
            head = raw.read(len(SIGNATURE))
        if head != SIGNATURE:
            raise OSError("no HDF5 signature")
        file = _patiently(path)
    except OSError as error:
        raise DatasetError(f"{path}: not an HDF5 file, or damaged beyond reading ({error})") from error
    try:
        with _typed(path):
            kind = (file.attrs.get("format"), file.attrs.get("version"))
        if kind != (FORMAT, VERSION):
            raise DatasetError(f"{path}: is {kind[0]!r} version {kind[1]!r}, expected {FORMAT!r} version {VERSION}")
    except BaseException:
        file.close()
        raise
    return file


def _patiently(path: Path) -> h5py.File:
    """Open it, as one of many readers only where there is a writer, or was one that never closed the file: as such HDF5
    tries for minutes to read what is damaged. There is a moment in which a writer does not let readers in yet."""
    for wait in (0.05, 0.2, 0.8, 0.0):
        try:
            return h5py.File(path, "r", libver="latest", swmr=_flagged(path), locking=False)
        except OSError:
            if not wait or not _flagged(path):
                raise
            time.sleep(wait)
    raise AssertionError("the last wait is 0")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Whatever h5py raises when it cannot write, as a DatasetError."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise DatasetError(f"{path}: cannot be written ({error}); is there space, and are you allowed to?") from error


@contextmanager
def _beside(path: Path) -> Iterator[h5py.File]:
    """A new file that takes the place of ``path`` once it is whole."""
    name = path.with_name(f".{path.name}.part")  # one is enough: whoever writes it holds the lock
    try:
        with _writing(path):
            if path.exists() and not os.access(path, os.W_OK):
                raise OSError("read-only")
            with h5py.File(name, "w", libver="latest") as file:
                yield file
            if path.exists():
                os.chmod(name, path.stat().st_mode)
            os.replace(name, path)
    finally:
        name.unlink(missing_ok=True)


def _create(
    path: Path,
    surface: Surface,
    generator: Generator,
    seed: int,
    truth: dict[str, Any],
    stage: Stages,
) -> None:
    if not np.array_equal(generator.surface.vertices, surface.vertices):
        raise DatasetError(f"{path}: the generator is of another surface")
    # A first answer, before there is a file: is it one, and does this truth say which interfaces gave way?
    blows, _ = draw_blows(surface, 4, np.random.default_rng(0))
    told = checked(generator, blows, generator.thresholds(blows), generator.fracture(blows)).broken
    header = {
        "fracsim": version("fracsim"),
        "seed": seed,
        "truth": truth,
        "sampling": sampling_rules(),
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
            curves = CurveDistances(generator.parts, surface)
            distances, _ = interface_distances(curves, joints.pairs, stage.ticker("distances"))
            _put(group, "distances", distances.astype(np.float16))
        parts = len(generator.parts.volumes)
        interfaces = 0 if told is None else told.shape[1]
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
    """Write a block; only when all of it is handed to the system does it count."""
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
        bad = {block for block, _ in old.damage() if block >= 0}
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
    return {"truth": "own", "class": type(generator).__name__}


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
    if there.header["sampling"] != sampling_rules():
        made = there.header.get("fracsim")
        raise DatasetError(f"{there.path}: was drawn by the rules of fracsim {made}; name a new file")


def _put(group: h5py.Group, name: str, values: npt.NDArray[Any]) -> None:
    if values.size:
        group.create_dataset(name, data=values, chunks=True, compression="gzip", shuffle=True, fletcher32=True)
    else:
        group.create_dataset(name, data=values)


def _save_solid(group: h5py.Group, solid: Solid) -> None:
    for field in fields(Solid):
        values = getattr(solid, field.name)
        _put(group, field.name, values.astype(np.int32) if np.issubdtype(values.dtype, np.integer) else values)


def _load_solid(group: h5py.Group) -> Solid:
    values = {field.name: group[field.name][()] for field in fields(Solid)}
    return Solid(**{k: v.astype(np.int64) if np.issubdtype(v.dtype, np.integer) else v for k, v in values.items()})
