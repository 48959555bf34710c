"""Stress matrix, what a world must never do in any scene: ``fracsim bench stability``.

Meshes, sizes, speeds, time steps and kinds of scene are combined. Only the command line uses this package.
"""

from .report import draw, table
from .run import measure

__all__ = ["draw", "measure", "table"]
