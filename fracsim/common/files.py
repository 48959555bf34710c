"""TODO common.files."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import AssetError


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


def header_of(data: bytes, key: str) -> dict[str, Any]:
    """What is told under ``key`` in the metadata of a safetensors file that has been found to be one. Raises KeyError,
    ValueError or TypeError where there is nothing of the kind."""
    length = int.from_bytes(data[:8], "little")
    return json.loads(json.loads(data[8 : 8 + length])["__metadata__"][key])


def compact(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Integers in no more bits than they need; everything else as it is."""
    if values.dtype.kind == "i":
        for small in (np.int16, np.int32):
            if values.size == 0 or max(values.max(), -values.min()) <= np.iinfo(small).max:
                return np.ascontiguousarray(values, dtype=small)
    return np.ascontiguousarray(values)
