"""Making datasets: new files, existing files to extend, damaged files to mend, and files made again.

The command line, evaluation and users come in by ``make_dataset`` and ``regenerate``. What a simulator needs to answer
again is kept through its ``state`` and ``restore``; no simulator is known by its name here.
"""

from __future__ import annotations

import json
import operator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..common.errors import DatasetError, MissingExtraError
from ..common.progress import Stages
from ..simulators import SIMULATORS, UNREGISTERED, simulator_class
from ..simulators.base import FractureSimulator, RegisteredSimulator, interfaces_between
from ..simulators.capabilities import FirstCrack, reference_factors, severity_kind_of
from ..simulators.registry import SimulatorOptions, make_simulator, options_for
from ..solids.geodesics import CAP, CurveDistances, interface_distances
from ..solids.solid import solid_to_arrays
from ..solids.surface import Surface
from ..solids.walls import facing_vertices
from .dataset import Dataset
from .hdf5 import FORMAT, VERSION, alone, left_open, put_array, replacing, writing
from .impacts import CONTACTS, draw_impacts
from .repeatability import repeatability_of
from .samples import BLOCK, Samples, checked, sample_block, sampling_rules
from .workers import check_workers, run_blocks

try:
    import h5py
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError("h5py", "bake") from error

COMPRESSION = 4  # of gzip: higher levels take longer and gain nothing here
COUNTED = 1024  # blocks whose row counts share a chunk
UNITS = {  # of a header, by what severities are to the simulator
    "impulse": "lengths in units of the largest extent; severity = impulse / (mass * gauge * critical velocity)",
    "force": "lengths in units of the largest extent; severity = peak force / (strength * largest extent squared)",
}


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
    """Make a dataset, or bring one to at least as many samples; what it holds stays.

    An interrupted file is taken up where it was left, and damaged blocks are made again.

    Parameters
    ----------
    path : str or Path
        The file.
    surface : Surface
        The body.
    total : int
        Samples that the file shall hold.
    seed : int
        The same seed gives the same samples to the bit, however many workers make them in how many sittings.
    options : SimulatorOptions, optional
        The simulator to build, any that is registered; the modal one by default. ``options_for_body`` makes those of
        a simulator that depends on the material.
    simulator : FractureSimulator, optional
        Instead of ``options``, a simulator of your own whose class is not registered. Pass it again to go on.
    workers : int
        Processes.
    backend : str
        "joblib" or "ray", see ``run_blocks``.
    progress : bool
        Whether to show a bar for each stage, on standard error.

    Returns
    -------
    dict of str to float
        The seconds of each stage.

    Raises
    ------
    DatasetError
        Where the file is something else, was made of another surface, by another simulator or from another seed, or
        is being written by another process.
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
    if simulator is not None:
        options, made_by = None, {"name": UNREGISTERED, "class": type(simulator).__name__}
    else:
        options = options or SimulatorOptions()
        if not isinstance(options, simulator_class(options.name).options_type):
            options = options_for(**asdict(options))
        made_by = json.loads(json.dumps(asdict(options)))
    with alone(path), Stages(progress) as stage:
        if path.exists():
            stage("check")
            simulator, total = _gone_on_with(path, surface, seed, made_by, simulator, total)
        else:
            if simulator is None:
                assert options is not None
                simulator = make_simulator(surface, options, seed, stage)
            of_itself = repeatability_of(simulator, options, seed, workers, backend, stage)
            _create(path, surface, simulator, seed, made_by, of_itself, stage)
        stage("samples")
        with writing(path):  # no lock of HDF5's: ``alone`` has one, and readers must not keep a writer out
            file = h5py.File(path, "r+", libver="latest", locking=False)
        try:
            complete = file["complete"][:]
            blocks = -(-total // BLOCK)
            present = np.zeros(blocks, dtype=np.int64)
            present[: len(complete)] = complete[:blocks]
            wanted = np.minimum(BLOCK, total - BLOCK * np.arange(blocks))
            missing = np.flatnonzero(present < wanted).tolist()
            file.swmr_mode = True
            results = run_blocks(sample_block, simulator, seed, missing, workers, backend)
            for done, (block, samples) in enumerate(zip(missing, results, strict=True), 1):
                append_block(path, file, block, samples.take(slice(int(wanted[block]))))
                stage("samples", done / len(missing))
        finally:
            with writing(path):
                file.close()
    return stage.seconds


def regenerate(
    source: str | Path, path: str | Path, workers: int = 1, backend: str = "joblib", progress: bool = False
) -> dict[str, float]:
    """Make a dataset again from nothing but the header and surface of another one.

    Parameters
    ----------
    source : str or Path
        The dataset to make again.
    path : str or Path
        The new file.
    workers, backend, progress
        As of ``make_dataset``.

    Returns
    -------
    dict of str to float
        The seconds of each stage.

    Raises
    ------
    DatasetError
        Where the new file exists, or the simulator is not registered or not repeatable.
    """
    if Path(path).exists():
        raise DatasetError(f"{path}: exists already; name a new file")
    with Dataset(source) as old:
        name = old.header["simulator"]["name"]
        if name not in SIMULATORS:
            raise DatasetError(
                f"{source}: its simulator ({_class_of(old)}) is not registered, so it cannot be made again from the "
                "file; register it first"
            )
        if not simulator_class(name).repeatable:
            raise DatasetError(
                f"{source}: what the {name} simulator needs is kept in the file but cannot be worked out again bit "
                "by bit; go on with that file instead"
            )
        _check_same(old, old.surface, old.seed, old.header["simulator"])
        surface, total, seed, options = old.surface, old.held, old.seed, options_for(**old.header["simulator"])
    return make_dataset(path, surface, total, seed, options, None, workers, backend, progress)


def _gone_on_with(
    path: Path,
    surface: Surface,
    seed: int,
    made_by: dict[str, Any],
    simulator: FractureSimulator | None,
    total: int,
) -> tuple[FractureSimulator, int]:
    """Check and mend a file to extend; returns its simulator and the number of samples that it shall hold."""
    with Dataset(path) as there:
        if simulator is None and there.header["simulator"]["name"] == UNREGISTERED:
            raise DatasetError(
                f"{path}: its simulator was one of your own ({_class_of(there)}); pass that simulator to go on"
            )
        _check_same(there, surface, seed, made_by)
        if simulator is None:
            simulator = there.simulator
            assert simulator is not None  # the header names what ``made_by`` names, which is registered
        elif not np.array_equal(simulator.cells.volumes, there.cells.volumes):
            raise DatasetError(f"{path}: was made by a simulator with other cells; name a new file")
        total = max(total, there.held)
        damage = there.damage()
    for block, name in damage:
        if block < 0:
            raise DatasetError(f"{path}: {name} is damaged, which cannot be mended; name a new file")
    if damage or left_open(path):
        _salvage(path)
    return simulator, total


def _create(
    path: Path,
    surface: Surface,
    simulator: FractureSimulator,
    seed: int,
    made_by: dict[str, Any],
    of_itself: dict[str, float],
    stage: Stages,
) -> None:
    """Write a file without samples; all that is worked out is worked out before there is a file."""
    if not np.array_equal(simulator.surface.vertices, surface.vertices):
        raise DatasetError(f"{path}: the simulator is of another surface")
    # A first answer: is it one, and does this simulator say which interfaces break?
    impacts, _ = draw_impacts(surface, 4, np.random.default_rng(0))
    with threadpool_limits(1):  # what the simulator works out once and keeps must be the same here as in a worker
        reference = reference_factors(simulator, impacts)
        broken = checked(simulator, impacts, reference, simulator.fracture(impacts)).broken
    kind = severity_kind_of(simulator)
    header = {
        "fracsim": __version__,
        "seed": seed,
        "simulator": made_by,
        "sampling": sampling_rules(),
        "cap": CAP,
        "severity_kind": kind,
        "ratio_to": "first crack" if isinstance(simulator, FirstCrack) else "threshold",
        "units": UNITS[kind],
        "repeatability": of_itself,
    }
    stage("distances")
    interfaces = interfaces_between(simulator.cells)
    content: dict[str, npt.NDArray[Any]] = {
        "surface/vertices": surface.vertices,
        "surface/faces": surface.faces,
        "links": facing_vertices(surface),
        **solid_to_arrays(simulator.cells, "cells/"),
        **{f"interfaces/{name}": values for name, values in vars(interfaces).items()},
    }
    if simulator.fixed_cracks:
        curves = CurveDistances(simulator.cells, surface)
        distances, _ = interface_distances(curves, interfaces.pairs, stage.ticker("distances"))
        content["interfaces/distances"] = distances.astype(np.float16)
    numbers: str | None = None
    if made_by["name"] != UNREGISTERED:
        registered: RegisteredSimulator = simulator  # type: ignore[assignment]  # built by its registered class
        kept, plain = registered.state()
        content |= {f"simulator/{name}": values for name, values in kept.items()}
        numbers = json.dumps(plain)
    columns = _columns(len(simulator.cells.volumes), 0 if broken is None else broken.shape[1])
    with replacing(path) as file:
        file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
        file.attrs["header"] = json.dumps(header)
        for name, values in content.items():
            put_array(file, name, values)
        group = file["surface"]
        group.attrs["scale"], group.attrs["offset"], group.attrs["name"] = surface.scale, surface.offset, surface.name
        if numbers is not None:
            file.require_group("simulator").attrs["numbers"] = numbers
        group = file.create_group("samples")
        for name, column in columns.items():
            group.create_dataset(
                name,
                (0, *column.shape),
                column.dtype,
                maxshape=(None, *column.shape),
                chunks=(BLOCK, *column.shape),
                compression="gzip",
                compression_opts=COMPRESSION,
                shuffle=True,
                fletcher32=True,
            )
        group["broken"].attrs["width"] = 0 if broken is None else broken.shape[1]
        file.create_dataset("complete", (0,), np.int32, maxshape=(None,), chunks=(COUNTED,), fletcher32=True)


@dataclass(frozen=True)
class _Column:
    """How a field of Samples is kept: the shape and type of a row."""

    shape: tuple[int, ...]
    dtype: Any


def _columns(cells: int, interfaces: int) -> dict[str, _Column]:
    """Say how each field of Samples is kept."""
    labels = np.uint8 if cells <= 2**8 else np.uint16 if cells <= 2**16 else np.int64
    return {
        "faces": _Column((CONTACTS,), np.int32),
        "barycentric": _Column((CONTACTS, 3), np.float64),
        "directions": _Column((CONTACTS, 3), np.float64),
        "severities": _Column((CONTACTS,), np.float64),
        "ratio": _Column((), np.float64),
        "kind": _Column((), np.int8),
        "labels": _Column((cells,), labels),
        "broken": _Column((max(1, -(-interfaces // 8)),), np.uint8),  # bits; HDF5 has no rows of no width
        "split": _Column((), np.int8),
        "fold": _Column((), np.int8),
    }


def append_block(path: Path, file: h5py.File, block: int, samples: Samples) -> None:
    """Write a block; it counts only when all of it is handed to the system.

    Parameters
    ----------
    path : Path
        The file, for the message of an error.
    file : h5py.File
        The same, open for writing.
    block : int
        Which block.
    samples : Samples
        Its rows, at most BLOCK.

    Raises
    ------
    DatasetError
        Where it cannot be written.
    """
    start, stop = block * BLOCK, block * BLOCK + len(samples)
    values = {field.name: getattr(samples, field.name) for field in fields(Samples)}
    width = values["broken"].shape[1]
    values["broken"] = np.packbits(values["broken"], axis=1) if width else np.zeros((len(samples), 1), np.uint8)
    with writing(path):
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
    with Dataset(path) as old:
        bad = {block for block, _ in old.damage() if block >= 0}
        complete = old.complete
        complete[sorted(bad)] = 0
        good = [slice(block * BLOCK, block * BLOCK + int(complete[block])) for block in np.flatnonzero(complete)]
        with replacing(path) as file:
            for name, value in old.file.attrs.items():
                file.attrs[name] = value
            for name in old.file:
                if name not in ("samples", "complete"):
                    old.file.copy(name, file)
            group = file.create_group("samples")
            for name, data in old.file["samples"].items():
                rows = min(len(data), len(complete) * BLOCK)
                copy = group.create_dataset_like(name, data, shape=(rows, *data.shape[1:]))
                for key, value in data.attrs.items():
                    copy.attrs[key] = value
                for rows_of_block in good:
                    copy[rows_of_block] = data[rows_of_block]
            new = file.create_dataset_like("complete", old.file["complete"], shape=complete.shape)
            new[:] = complete


def _class_of(dataset: Dataset) -> str:
    """Name the simulator of a dataset as well as its header can."""
    made_by = dataset.header["simulator"]
    return str(made_by.get("class", made_by["name"]))


def _check_same(there: Dataset, surface: Surface, seed: int, made_by: dict[str, Any]) -> None:
    """Refuse to go on with a file that was made of something else, or by other rules."""
    differences = []
    if not (
        np.array_equal(there.surface.vertices, surface.vertices) and np.array_equal(there.surface.faces, surface.faces)
    ):
        differences.append("another surface")
    if there.seed != seed:
        differences.append(f"seed {there.seed}")
    before = there.header["simulator"]
    differences += [f"{key} {before[key]}" for key in before if before[key] != made_by.get(key)]
    if differences:
        raise DatasetError(
            f"{there.path}: was made from {', '.join(differences)}; ask for the same, or name a new file"
        )
    if there.header["sampling"] != sampling_rules():
        version = there.header.get("fracsim")
        raise DatasetError(f"{there.path}: was drawn by the rules of fracsim {version}; name a new file")
