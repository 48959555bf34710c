"""Files that are written whole or not at all, and the headers of safetensors files; for every room that saves."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import FracsimError

READABLE_BY_ALL = 0o644  # as an ordinary new file; temporary files are their owner's alone


def write_beside(path: Path, data: bytes, error: type[FracsimError] = FracsimError) -> None:
    """Write a file under another name in the same folder, then rename it, so that no half of it is ever seen.

    Parameters
    ----------
    path : Path
        Where the file shall be; one that is there is replaced.
    data : bytes
        Its content.
    error : type of FracsimError
        What to raise.

    Raises
    ------
    FracsimError
        Of the type ``error``, if the folder does not exist or the file cannot be written there.
    """
    if not path.parent.is_dir():
        raise error(f"{path}: the folder {path.parent} does not exist")
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.chmod(temporary, READABLE_BY_ALL)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as fault:
        raise error(f"{path}: cannot be written ({fault.strerror})") from fault


def header_of(data: bytes, key: str) -> dict[str, Any]:
    """Read fracsim's own header out of a safetensors file that could be loaded.

    Parameters
    ----------
    data : bytes
        The whole file.
    key : str
        The entry of the file's metadata that holds the header, as JSON.

    Returns
    -------
    dict
        The header.

    Raises
    ------
    KeyError
        If there is no such entry.
    ValueError
        If the entry is no JSON object.
    """
    length = int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][key])
    if not isinstance(header, dict):
        raise ValueError(f"{key} holds no JSON object")
    return header


def compact(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Give integers the smallest of 16, 32 or 64 bits that holds them all; leave other arrays as they are.

    Parameters
    ----------
    values : ndarray
        Of any shape and dtype.

    Returns
    -------
    ndarray
        The same values, contiguous.
    """
    if values.dtype.kind == "i":
        for small in (np.int16, np.int32):
            if values.size == 0 or max(values.max(), -values.min()) <= np.iinfo(small).max:
                return np.ascontiguousarray(values, dtype=small)
    return np.ascontiguousarray(values)
