"""TODO data.writing."""

from __future__ import annotations

import fcntl
import json
import operator
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..common.errors import DatasetError, MissingExtraError
from ..common.progress import Stages
from ..geometry.sampling import CONE, SEVERITY
from ..simulators import SIMULATORS
from ..simulators.base import FractureSimulator, interfaces_between
from ..simulators.modal import ModalSimulator
from ..simulators.registry import SimulatorOptions, make_simulator
from ..solids.geodesics import CAP, CurveDistances, interface_distances
from ..solids.solid import Solid
from ..solids.surface import Surface
from ..solids.walls import facing_vertices
from .dataset import FORMAT, VERSION, Dataset, _flagged
from .impacts import CONTACTS, KINDS, POOL, RING, SEVERAL, TILT, draw_impacts
from .samples import BLOCK, FOLDS, TEST, VALIDATION, Samples, checked, sample_block
from .workers import check_workers, run_blocks

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("h5py", "bake") from error


def make_dataset(
    path: str | Path,
    surface: Surface,
    total: int,
    seed: int = 0,
    options: SimulatorOptions | None = None,
    simulator: FractureSimulator | None = None,
    workers: int = 1,
    backend: str = "joblib",
    progress: bool = False,
) -> dict[str, float]:
    """Make a dataset of ``total`` samples, or bring the one that is there to at least as many; what is there stays.

    options say which truth to build; simulator is one of the user's own instead, to be passed again to go on. An
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
    options = options or SimulatorOptions()
    with _alone(path), Stages(progress) as stage:
        if path.exists():
            stage("check")
            with Dataset(path) as there:
                made_by = there.header["simulator"]
                if simulator is None and made_by["name"] not in SIMULATORS:
                    raise DatasetError(
                        f"{path}: its truth was one of your own ({made_by.get('class')}); pass that simulator to go on"
                    )
                _same(there, surface, seed, asdict(options) if simulator is None else _named(simulator))
                if simulator is None:
                    simulator = there.simulator
                elif not np.array_equal(simulator.cells.volumes, there.cells.volumes):
                    raise DatasetError(f"{path}: was made by a simulator with other cells; name a new file")
                total = max(total, there.held)
                damage = there.damage()
            for block, name in damage:
                if block < 0:
                    raise DatasetError(f"{path}: {name} is damaged, which cannot be mended; name a new file")
            if damage or _flagged(path):
                _salvage(path)
        else:
            made_by = asdict(options) if simulator is None else _named(simulator)
            if simulator is None:
                simulator = make_simulator(surface, options, seed, stage)
            _create(path, surface, simulator, seed, made_by, stage)
        stage("samples")
        if simulator is None:
            raise DatasetError(f"{path}: holds no simulator to go on with")
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
            results = run_blocks(sample_block, simulator, seed, missing, workers, backend)
            for done, (block, samples) in enumerate(zip(missing, results, strict=True), 1):
                with _writing(path):
                    _append(file, block, samples.take(slice(int(wanted[block]))))
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
        kind = old.header["simulator"]["name"]
        if kind == "elastic":
            raise DatasetError(
                f"{source}: elastic stress is kept in the file but cannot be worked out again bit by bit"
            )
        if kind not in SIMULATORS:
            raise DatasetError(f"{source}: its truth was one of your own and cannot be made again from the file")
        _same(old, old.surface, old.seed, old.header["simulator"])
        surface, total, seed, made_by = old.surface, old.held, old.seed, old.header["simulator"]
    return make_dataset(path, surface, total, seed, SimulatorOptions(**made_by), None, workers, backend, progress)


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
    simulator: FractureSimulator,
    seed: int,
    made_by: dict[str, Any],
    stage: Stages,
) -> None:
    if not np.array_equal(simulator.surface.vertices, surface.vertices):
        raise DatasetError(f"{path}: the simulator is of another surface")
    # A first answer, before there is a file: is it one, and does this truth say which interfaces gave way?
    impacts, _ = draw_impacts(surface, 4, np.random.default_rng(0))
    told = checked(simulator, impacts, simulator.thresholds(impacts), simulator.fracture(impacts)).broken
    header = {
        "fracsim": __version__,
        "seed": seed,
        "simulator": made_by,
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
        _save_solid(file.create_group("cells"), simulator.cells)
        if made_by["name"] in ("modal", "elastic"):
            group = file.create_group("modal")
            given: Any = simulator
            _save_solid(group.create_group("fine_cells"), given.fine_cells)
            _put(group, "fine_to_cell", given.fine_to_cell.astype(np.int32))
            if isinstance(simulator, ModalSimulator):
                _put(group, "impact_field", simulator.impact_field)
                group.attrs["energies"] = json.dumps(simulator.energies)
            else:
                _put(group, "impact_field", given.unit_tractions.astype(np.float32))
                group.attrs["gauge"] = given.gauge
        joints = interfaces_between(simulator.cells)
        group = file.create_group("interfaces")
        _put(group, "pairs", joints.pairs.astype(np.int32))
        for name in ("areas", "normals", "projected"):
            _put(group, name, getattr(joints, name))
        if simulator.fixed_cracks:
            curves = CurveDistances(simulator.cells, surface)
            distances, _ = interface_distances(curves, joints.pairs, stage.ticker("distances"))
            _put(group, "distances", distances.astype(np.float16))
        cells = len(simulator.cells.volumes)
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
            "labels": ((cells,), np.uint8 if cells <= 256 else np.uint16 if cells <= 65536 else np.int64),
            "broken": ((-(-interfaces // 8),), np.uint8),
            "split": ((), np.int8),
            "fold": ((), np.int8),
        }
        for name, (shape, dtype) in shapes.items():
            if 0 in shape:  # a simulator that knows no interfaces
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


def _named(simulator: FractureSimulator) -> dict[str, Any]:
    """What a header can say of a simulator of the user's own."""
    return {"name": "own", "class": type(simulator).__name__}


def _same(there: Dataset, surface: Surface, seed: int, made_by: dict[str, Any]) -> None:
    wrong = []
    if not (
        np.array_equal(there.surface.vertices, surface.vertices) and np.array_equal(there.surface.faces, surface.faces)
    ):
        wrong.append("another surface")
    if there.seed != seed:
        wrong.append(f"seed {there.seed}")
    found = there.header["simulator"]
    wrong += [f"{key} {found[key]}" for key in found if found[key] != made_by.get(key)]
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
