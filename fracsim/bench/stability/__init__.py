"""Stress matrix: what a world must never do, over meshes, sizes, speeds, time steps and kinds of scene."""

from .report import draw, table
from .run import measure

__all__ = ["draw", "measure", "table"]
