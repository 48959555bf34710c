"""What the commands write: figures on standard output, and files that are checked before the work begins.

Used by the commands only.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from ..common.errors import AssetError
from ..common.files import write_beside

# Groups of the figures that are printed, in this order.
GROUPS = ("counts", "splits", "kinds", "pieces", "repeatability", "seconds", "test")


def print_figures(figures: dict[str, Any]) -> None:
    """Print the groups of figures that people read, a line a figure.

    Parameters
    ----------
    figures : dict
        What a command found. Groups beside ``GROUPS`` go to the JSON file only.
    """
    for group in GROUPS:
        if group in figures:
            print(f"  {group}")
        for key, value in figures.get(group, {}).items():
            print(f"    {key:<36}{value:>12.5g}" if isinstance(value, float) else f"    {key:<36}{value:>12}")


def write_json(path: Path, figures: dict[str, Any]) -> None:
    """Write a command's figures to a file: all of it, or nothing.

    Parameters
    ----------
    path : Path
        The file; one that is there is replaced.
    figures : dict
        Plain data.
    """
    write_beside(path, (json.dumps(figures, indent=2) + "\n").encode())


def require_file(path: Path) -> Path:
    """Check, before the work, that a file can be written.

    Parameters
    ----------
    path : Path
        The file that a command will write.

    Returns
    -------
    Path
        The same path.

    Raises
    ------
    AssetError
        If the path is a folder, or its folder is missing or cannot be written to.
    """
    _require_parent(path)
    if path.is_dir():
        raise AssetError(f"{path}: is a folder; name a file in it")
    return path


def require_folder(path: Path) -> Path:
    """Check, before the work, that a folder can be written to, or can be made.

    Parameters
    ----------
    path : Path
        The folder that a command will write to. It is not made here.

    Returns
    -------
    Path
        The same path.

    Raises
    ------
    AssetError
        If the path is a file, or the folder that it lies in is missing, or one of them cannot be written to.
    """
    if path.is_dir():
        _try_writing(path, path)
    elif path.exists():
        raise AssetError(f"{path}: is a file; name a folder")
    else:
        _require_parent(path)
    return path


def _require_parent(path: Path) -> None:
    """Check that the folder a path lies in exists and can be written to."""
    parent = path.absolute().parent
    if not parent.is_dir():
        raise AssetError(f"{path}: the folder {path.parent} does not exist; create it first")
    _try_writing(parent, path)


def _try_writing(folder: Path, path: Path) -> None:
    """Make a nameless file in a folder and let it go; the rights on a folder do not tell of a read-only disk."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise AssetError(f"{path}: cannot be written ({error.strerror})") from error
