"""Every error that fracsim raises on purpose; any room may raise them, and nothing else lives here.

A message names the file or argument, the fault, and the way out.
"""

from __future__ import annotations

from .installation import install_command


class FracsimError(Exception):
    """Base of all errors raised by fracsim."""


class MeshError(FracsimError):
    """A surface that cannot be baked: missing, empty, open, in several parts, not finite."""


class AssetError(FracsimError):
    """A baked asset that cannot be read: missing, truncated, of another format or version."""


class DatasetError(FracsimError):
    """A dataset file that cannot be read, is damaged, or does not belong to what is asked of it."""


class BakeError(FracsimError):
    """A baking stage failed on a valid surface."""


class ImpulseError(FracsimError, ValueError):
    """An impulse with the wrong shape, a zero direction or a value that is not finite."""


class FieldError(FracsimError, ValueError):
    """A distance field of the wrong shape or dtype, or with values that are not finite."""


class ModelError(FracsimError):
    """A model file that is missing, truncated, or of another body, or training that went wrong."""


class MaterialError(FracsimError, ValueError):
    """An unknown material name or a property outside its range."""


class PhysicsError(FracsimError):
    """A physics client or body that is not there, or one that the engine rejected."""


class RenderError(FracsimError):
    """A render mode that cannot work here, such as a window without a display."""


class MissingExtraError(FracsimError, ImportError):
    """An optional dependency is not installed; the message holds the command that installs it.

    Parameters
    ----------
    module : str
        The module that could not be imported.
    extra : str
        The extra of fracsim that brings it.

    Attributes
    ----------
    module : str
        The module that could not be imported.
    extra : str
        The extra of fracsim that brings it.
    """

    def __init__(self, module: str, extra: str) -> None:
        super().__init__(f"{module} is not installed; it comes with: {install_command(extra)}")
        self.module = module
        self.extra = extra

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        """Pickle by the two names, so that a worker's error reaches its parent."""
        return type(self), (self.module, self.extra)
