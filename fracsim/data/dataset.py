"""Datasets on disk: one HDF5 file that says what made it, and can be made again from its own header. Offline only.

A file holds the surface, the simulator with everything it needs to answer again, and samples in chunks of one block,
compressed and checksummed. It is written block by block in HDF5's single-writer-multiple-readers mode, so another
process may read it meanwhile, and whatever stops the writer, the finished blocks stay readable.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import IntArray
from ..common.errors import DatasetError, MissingExtraError
from ..fracture.predictor import field_from_scores
from ..fracture.rule import Interfaces
from ..simulators import SIMULATORS
from ..simulators.base import FractureSimulator
from ..simulators.modal import ModalSimulator
from ..simulators.radial import RadialSimulator
from ..solids.geodesics import CurveDistances
from ..solids.solid import Solid
from ..solids.surface import Surface
from .samples import Samples

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("h5py", "bake") from error


FORMAT = "fracsim dataset"
VERSION = 2
SIGNATURE = b"\x89HDF\r\n\x1a\n"
UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)  # what h5py raises on damage


class Dataset:
    """A dataset file, open for reading, possibly while another process writes it (if it did when this was opened, the
    file may be seen to grow; otherwise open it anew to see more).

    header: what made it. surface, cells: what it is about. links: (L, 2) vertices that face each other through a thin
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
                self.cells = _load_solid(self.file["cells"])
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
    def simulator(self) -> FractureSimulator | None:
        """The simulator itself, or None where it was one of the user's own, which no file can hold."""
        made_by = self.header["simulator"]
        with _typed(self.path):
            if made_by["name"] not in SIMULATORS:
                return None
            floor = float(made_by["min_piece_volume_fraction"])
            if made_by["name"] == "radial":
                return RadialSimulator(self.surface, self.cells, floor)
            group, joints = self.file["modal"], self.file["interfaces"]
            fine_cells, fine_to_cell = _load_solid(group["fine_cells"]), group["fine_to_cell"][()].astype(np.int64)
            impact_field = group["impact_field"][()].astype(np.float64)
            interfaces = Interfaces(
                joints["pairs"][()].astype(np.int64), *(joints[name][()] for name in ("areas", "normals", "projected"))
            )
            if made_by["name"] == "elastic":
                from ..simulators.elastic import ElasticSimulator

                gauge = float(group.attrs["gauge"])
                return ElasticSimulator(
                    self.surface, self.cells, interfaces, impact_field, gauge, floor, fine_cells, fine_to_cell
                )
            energies = tuple(tuple(energies) for energies in json.loads(group.attrs["energies"]))
            return ModalSimulator(
                self.surface, fine_cells, fine_to_cell, self.cells, interfaces, impact_field, floor, energies
            )

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
        edge midpoints, capped, of fractures that leave the cells labels (N, P).

        Where cracks are fixed, the least of the stored distances to the interfaces that part pieces; else by fast
        marching, some 10 ms each."""
        with _typed(self.path):
            joints = self.file["interfaces"]
            pairs = joints["pairs"][()]
            distances = joints["distances"][()] if "distances" in joints else None
        if distances is None:
            curves = CurveDistances(self.cells, self.surface)
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


@contextmanager
def _typed(
    path: Path, where: str = "damaged or incomplete", way_out: str = "make it again, in a new file"
) -> Iterator[None]:
    """Whatever h5py raises on a damaged file, as a DatasetError."""
    try:
        yield
    except UNREADABLE as error:
        raise DatasetError(f"{path}: {where} ({error}); {way_out}") from error


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


def _load_solid(group: h5py.Group) -> Solid:
    values = {field.name: group[field.name][()] for field in fields(Solid)}
    return Solid(**{k: v.astype(np.int64) if np.issubdtype(v.dtype, np.integer) else v for k, v in values.items()})
