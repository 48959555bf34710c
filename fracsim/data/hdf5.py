"""How dataset files are opened, locked, replaced and filled with arrays, and what goes wrong as a DatasetError.

Only ``dataset`` and ``writing`` come in here. h5py raises many kinds of error on a damaged or full disk; the two
context managers below enclose calls of h5py and of nothing else, so that a fault of our own is never taken for damage.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.errors import DatasetError, MissingExtraError

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("h5py", "bake") from error

FORMAT = "fracsim dataset"
VERSION = 2
SIGNATURE = b"\x89HDF\r\n\x1a\n"
WRITER_FLAG = 11  # the byte of a superblock of version 3 that says whether a writer has the file open
UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)  # what h5py raises on damage
WAITS = (0.05, 0.2, 0.8, 0.0)  # seconds between tries to open a file that a writer has just begun


class Kept(dict[str, Any]):
    """What a file keeps, by name; to ask for what it does not hold raises DatasetError.

    Attributes
    ----------
    path : Path
        The file.
    """

    def __init__(self, path: Path, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.path = path

    def __missing__(self, name: str) -> Any:
        raise DatasetError(f"{self.path}: its simulator needs {name!r}, which the file does not hold; make it again")


@contextmanager
def reading(
    path: Path, fault: str = "damaged or incomplete", way_out: str = "make it again, in a new file"
) -> Iterator[None]:
    """Turn what h5py raises on a damaged file into a DatasetError.

    Parameters
    ----------
    path : Path
        The file.
    fault, way_out : str
        For the message.

    Raises
    ------
    DatasetError
        Where the code inside raises one of UNREADABLE.
    """
    try:
        yield
    except UNREADABLE as error:
        raise DatasetError(f"{path}: {fault} ({error}); {way_out}") from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what h5py raises when it cannot write into a DatasetError.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    DatasetError
        Where the code inside raises OSError or RuntimeError.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise DatasetError(f"{path}: cannot be written ({error}); is there space, and are you allowed to?") from error


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Keep other processes from making the same file meanwhile.

    HDF5's own locks would keep readers out as well, so a file beside it is locked instead.

    Parameters
    ----------
    path : Path
        The dataset.

    Raises
    ------
    DatasetError
        Where another process is writing it, or the folder cannot be written to.
    """
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
def replacing(path: Path) -> Iterator[h5py.File]:
    """Open a new file that takes the place of another once it is whole.

    Parameters
    ----------
    path : Path
        The file to be replaced or made.

    Yields
    ------
    h5py.File
        To be filled with calls of h5py only: whatever they raise is taken for a disk that cannot be written.

    Raises
    ------
    DatasetError
        Where it cannot be written.
    """
    name = path.with_name(f".{path.name}.part")  # one name is enough: whoever writes it holds the lock
    try:
        with writing(path):
            if path.exists() and not os.access(path, os.W_OK):
                raise OSError("read-only")
            with h5py.File(name, "w", libver="latest") as file:
                yield file
            if path.exists():
                os.chmod(name, path.stat().st_mode)
            os.replace(name, path)
    finally:
        name.unlink(missing_ok=True)


def left_open(path: Path) -> bool:
    """Tell whether a file says that a writer has it open, or never closed it.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    bool
        What its superblock says.
    """
    with path.open("rb") as raw:
        head = raw.read(WRITER_FLAG + 1)
    return len(head) > WRITER_FLAG and head.startswith(SIGNATURE) and head[8] >= 3 and head[WRITER_FLAG] != 0


def open_dataset(path: Path) -> h5py.File:
    """Open a dataset for reading, maybe while it is written.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    h5py.File
        Of this format and version.

    Raises
    ------
    DatasetError
        Where it is missing, not a dataset, of another version or damaged.
    """
    if path.is_dir():
        raise DatasetError(f"{path}: is a folder; name a file in it")
    if not path.is_file():
        raise DatasetError(f"{path}: no such file")
    try:
        with path.open("rb") as raw:
            head = raw.read(len(SIGNATURE))
        if head != SIGNATURE:
            raise OSError("no HDF5 signature")
        file = _open_patiently(path)
    except OSError as error:
        raise DatasetError(f"{path}: not an HDF5 file, or damaged beyond reading ({error})") from error
    try:
        with reading(path):
            kind = (file.attrs.get("format"), file.attrs.get("version"))
        if kind != (FORMAT, VERSION):
            raise DatasetError(
                f"{path}: is {kind[0]!r} version {kind[1]!r}, this version of fracsim reads {FORMAT!r} version "
                f"{VERSION}; make it again with: fracsim dataset make"
            )
    except BaseException:
        file.close()
        raise
    return file


def _open_patiently(path: Path) -> h5py.File:
    """Open a file, as one of many readers only where it has a writer, or had one that never closed it.

    HDF5 tries for minutes to read a damaged file as one of many readers. For a moment, a new writer lets no reader in.
    """
    for wait in WAITS:
        try:
            return h5py.File(path, "r", libver="latest", swmr=left_open(path), locking=False)
        except OSError:
            if not wait or not left_open(path):
                raise
            time.sleep(wait)
    raise AssertionError("the last wait is 0")


def put_array(group: h5py.Group, name: str, values: npt.NDArray[Any]) -> None:
    """Write an array, compressed and with checksums.

    Parameters
    ----------
    group : h5py.Group
        Where.
    name : str
        The array's name; a slash in it makes a group.
    values : ndarray
        Integers that fit are written with 32 bits, floats with the bits that they have.
    """
    if values.dtype.kind in "iu" and np.abs(values.astype(np.float64)).max(initial=0) <= np.iinfo(np.int32).max:
        values = values.astype(np.int32)
    if values.size:
        group.create_dataset(name, data=values, chunks=True, compression="gzip", shuffle=True, fletcher32=True)
    else:
        group.create_dataset(name, data=values)


def get_arrays(group: h5py.Group) -> dict[str, npt.NDArray[Any]]:
    """Read all arrays of a group.

    Parameters
    ----------
    group : h5py.Group
        The group.

    Returns
    -------
    dict of str to ndarray
        By name, with a slash where there are groups within. Integers are int64, floats as they were written.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            values = item[()]
            arrays[name] = values.astype(np.int64) if values.dtype.kind in "iu" else values

    group.visititems(take)
    return arrays
