"""Datasets on disk: one HDF5 file that says what made it, and can be made again from its own header. Offline only.

A file holds the surface, the simulator with all that it needs to answer again, and samples in chunks of one block,
compressed and with checksums. It is written block by block (``writing``) in HDF5's mode of one writer and many
readers, so another process may read it meanwhile, and whatever stops the writer, the finished blocks stay readable.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import IntArray
from ..common.errors import DatasetError, MissingExtraError
from ..fracture.predictor import field_of_labels
from ..fracture.rule import Interfaces
from ..simulators import SIMULATORS, simulator_class
from ..simulators.base import FractureSimulator
from ..simulators.capabilities import SEVERITY_KINDS
from ..solids.geodesics import CurveDistances
from ..solids.solid import solid_from_arrays
from ..solids.surface import Surface
from .hdf5 import UNREADABLE, Kept, get_arrays, open_dataset, reading
from .samples import Samples

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("h5py", "bake") from error


class Dataset:
    """A dataset file, open for reading. It is a context manager that closes the file.

    Another process may be writing it. A file that was being written when it was opened is seen to grow; otherwise
    open it anew to see more.

    Parameters
    ----------
    path : str or Path
        The file.

    Attributes
    ----------
    path : Path
        The file.
    header : dict
        What made it: version, seed, options of the simulator ("simulator"), rules of drawing ("sampling") and cap; and
        how well the simulator repeats itself ("repeatability"), which older files do not say.
    surface : Surface
        Of largest extent 1, with V vertices and E edges.
    cells : Solid
        The C cells that labels speak of.
    links : ndarray of int64, shape (L, 2)
        Vertices that face each other through a thin wall.
    block : int
        Samples a block.
    names : tuple of str
        The fields of ``Samples`` that are kept.

    Raises
    ------
    DatasetError
        Where it is missing, not a dataset, of another version or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.file = open_dataset(self.path)
        try:
            with reading(self.path):
                self.header: dict[str, Any] = json.loads(self.file.attrs["header"])
                self.block = int(self.header["sampling"]["block"])
                group = self.file["surface"]
                arrays = get_arrays(group)
                vertices, faces = arrays["vertices"], arrays["faces"]
                scale, offset = float(group.attrs["scale"]), np.array(group.attrs["offset"], dtype=np.float64)
                name = str(group.attrs["name"])
                self.links: IntArray = self.file["links"][()].astype(np.int64)
                self.cells = solid_from_arrays(get_arrays(self.file["cells"]))
                self.names = tuple(self.file["samples"])
            if set(self.names) != {field.name for field in fields(Samples)}:
                raise DatasetError(f"{self.path}: its samples are not of this version; make it again")
            self.surface = Surface(vertices, faces, scale, offset, name)
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
        """The seed that simulator and samples were made from."""
        return int(self.header["seed"])

    @property
    def severity_kind(self) -> str:
        """What severities are to its simulator: "impulse" or "force", see ``simulators.base.Impacts``."""
        return str(self.header.get("severity_kind", SEVERITY_KINDS[0]))

    @property
    def complete(self) -> IntArray:
        """Count the rows of each block, (B,), as the file says now; it may be growing."""
        with reading(self.path):
            blocks = self.file["complete"]
            blocks.id.refresh()
            return np.asarray(blocks[()], dtype=np.int64)

    @property
    def held(self) -> int:
        """Count the samples up to the last that is kept, missing blocks before it included."""
        complete = self.complete
        return max((block * self.block + int(count) for block, count in enumerate(complete) if count), default=0)

    @property
    def interfaces(self) -> Interfaces:
        """The interfaces between the cells."""
        with reading(self.path):
            group = self.file["interfaces"]
            areas, normals, projected = (group[name][()] for name in ("areas", "normals", "projected"))
            return Interfaces(group["pairs"][()].astype(np.int64), areas, normals, projected)

    @cached_property
    def simulator(self) -> FractureSimulator | None:
        """The simulator, which answers with the same bits; None where its class is not registered here."""
        name = self.header["simulator"]["name"]
        if name not in SIMULATORS:
            return None
        with reading(self.path):
            group = self.file["simulator"]
            arrays, numbers = get_arrays(group), json.loads(group.attrs["numbers"])
        interfaces = self.interfaces
        return simulator_class(name).restore(
            self.surface, self.cells, interfaces, Kept(self.path, arrays), Kept(self.path, numbers)
        )

    def samples(self, skip_damaged: bool = False) -> Samples:
        """Read all samples, in order.

        Parameters
        ----------
        skip_damaged : bool
            Whether to leave out blocks that hold a damaged chunk.

        Returns
        -------
        Samples
            The samples.

        Raises
        ------
        DatasetError
            Where a chunk is damaged; the message names it.
        """
        blocks = list(self.blocks(skip_damaged))
        return Samples.join(blocks) if blocks else self._rows(0, 0)

    def blocks(self, skip_damaged: bool = False) -> Iterator[Samples]:
        """Read the samples block by block, for files larger than memory.

        Parameters
        ----------
        skip_damaged : bool
            Whether to leave out blocks that hold a damaged chunk.

        Yields
        ------
        Samples
            A block.

        Raises
        ------
        DatasetError
            Where a chunk is damaged; the message names it.
        """
        for block, count in enumerate(self.complete.tolist()):
            if count:
                try:
                    yield self._rows(block * self.block, block * self.block + count)
                except DatasetError:
                    if not skip_damaged:
                        raise

    def fields(self, labels: IntArray) -> npt.NDArray[np.float32]:
        """Work out the distance fields of fractures.

        Where cracks are fixed, a field is the least of the stored distances to the interfaces between pieces. Else it
        is found by fast marching, some 10 ms each.

        Parameters
        ----------
        labels : ndarray of int64, shape (N, C)
            The piece of each cell.

        Returns
        -------
        ndarray of float32, shape (N, V + E)
            Geodesic distance from vertices and edge midpoints to the nearest crack, in units of the largest extent,
            capped.

        Raises
        ------
        DatasetError
            Where the stored distances are damaged.
        """
        with reading(self.path):
            group = self.file["interfaces"]
            pairs = group["pairs"][()]
            distances = group["distances"][()] if "distances" in group else None
        if distances is None:
            curves = CurveDistances(self.cells, self.surface)
            return np.array([curves.between(row) for row in labels], dtype=np.float32)
        cap = float(self.header["cap"])
        return np.array([field_of_labels(row, pairs, distances, cap) for row in labels], dtype=np.float32)

    def damage(self) -> list[tuple[int, str]]:
        """Look for what cannot be read.

        Returns
        -------
        list of (int, str)
            The block, and the name of the chunk in it. Block -1 is not of the samples, and cannot be mended.
        """
        damaged: list[tuple[int, str]] = []

        def look(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith(("samples/", "complete")):
                try:
                    item[()]
                except UNREADABLE:
                    damaged.append((-1, f"/{name}"))

        with reading(self.path):
            self.file.visititems(look)
        for block, count in enumerate(self.complete.tolist()):
            for name in self.names:
                start = block * self.block
                try:
                    data = self.file["samples"][name]
                    data.id.refresh()
                    data[start : start + count]
                except UNREADABLE:
                    damaged.append((block, f"/samples/{name}, rows {start} to {start + count - 1}"))
        return damaged

    def _rows(self, start: int, stop: int) -> Samples:
        values = {}
        for name in self.names:
            fault = f"the chunk of /samples/{name}, rows {start} to {stop - 1}, is damaged"
            with reading(self.path, fault, "the rest can be read with skip_damaged, and making it again mends it"):
                data = self.file["samples"][name]
                data.id.refresh()
                value = data[start:stop]
                if name == "broken":
                    value = np.unpackbits(value, axis=1, count=int(data.attrs["width"])).astype(bool)
            values[name] = value.astype(np.int64) if value.dtype.kind in "iu" else value
        return Samples(**values)
