"""Pictures of the benchmarks: a Matplotlib figure without a window, and its file.

The benchmarks' ``draw`` functions use it; without Matplotlib it says which extra is missing.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from ..common.errors import MissingExtraError
from ..common.files import write_beside

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS = 110  # an inch; as wide as a page of the docs is shown


def new_figure(width: float, height: float, constrained: bool = False) -> Figure:
    """Make an empty figure.

    Parameters
    ----------
    width, height : float
        Inches.
    constrained : bool
        Whether Matplotlib makes room for legends and colour bars outside the axes while it draws.

    Returns
    -------
    Figure
        An empty figure; it belongs to no window.

    Raises
    ------
    MissingExtraError
        If Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot") from error
    return Figure(figsize=(width, height), layout="constrained" if constrained else None)


def save_figure(figure: Figure, path: Path, dots: float = DOTS) -> None:
    """Write a figure as PNG: all of it, or nothing.

    Parameters
    ----------
    figure : Figure
        The figure.
    path : Path
        The file; one that is there is replaced.
    dots : float
        Dots an inch.
    """
    if figure.get_layout_engine() is None:
        figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dots)
    write_beside(path, buffer.getvalue())
