"""Gymnasium environments with breakable objects, imported as ``fracsim.envs``.

`ENVIRONMENTS` is the registry: ``import fracsim`` fills Gymnasium's own from it, so that `gymnasium.make` knows the
environments that ship, and `register_environment` adds a user's own to both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gymnasium.envs.registration import EnvSpec, register, registry

from fracsim import SHIPPED_ENVIRONMENTS, FracsimError

if TYPE_CHECKING:
    from .fracture_drop import FractureDropEnv

__all__ = ["ENVIRONMENTS", "FractureDropEnv", "register_environment"]

ENVIRONMENTS: dict[str, EnvSpec] = {name: registry[name] for name in SHIPPED_ENVIRONMENTS}


def register_environment(name: str, entry_point: str, max_episode_steps: int | None = None) -> None:
    """Make an environment known to `gymnasium.make` and to fracsim.

    Parameters
    ----------
    name : str
        Id with a version, such as "Shake-v0".
    entry_point : str
        "module:Class"; the module is imported when the first environment is made.
    max_episode_steps : int, optional
        Steps after which an episode is truncated. Without it no episode is.

    Raises
    ------
    FracsimError
        Where the name is taken.

    Examples
    --------
    >>> import fracsim
    >>> fracsim.envs.ENVIRONMENTS["FractureDrop-v0"].max_episode_steps
    300
    >>> fracsim.register_environment("FractureDrop-v0", "my_package.drop:DropEnv")
    Traceback (most recent call last):
    fracsim.common.errors.FracsimError: the environment 'FractureDrop-v0' is registered already; choose another name
    """
    if name in registry:
        raise FracsimError(f"the environment {name!r} is registered already; choose another name")
    register(id=name, entry_point=entry_point, max_episode_steps=max_episode_steps)
    ENVIRONMENTS[name] = registry[name]


def __getattr__(name: str) -> object:
    """Import the classes of the environments that ship when they are first asked for."""
    for entry_point, _ in SHIPPED_ENVIRONMENTS.values():
        module, class_name = entry_point.split(":")
        if class_name == name:
            import importlib

            return vars(importlib.import_module(module))[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
