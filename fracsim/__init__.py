"""fracsim: breakable objects for PyBullet and Gymnasium, in real time, on a CPU.

Importing it registers the Gymnasium environments and loads NumPy and Gymnasium, nothing heavier; every other name is
loaded when it is first used. Online, `load` gives a `BreakableAsset`, which answers impulses with fractures, and
`World` lets PyBullet bodies break by it. Offline, `Simulator` is what assets learn from, `make_dataset` writes its
fractures to a file, and `bake` makes an asset of a mesh. `register_simulator`, `register_model`,
`register_segmentation` and `register_environment` add one of your own.

Examples
--------
>>> import fracsim
>>> bunny = fracsim.load("bunny")
>>> fracture = bunny.fracture(bunny.sample_impulses(1, seed=1))
>>> len(fracture.pieces) == len(set(fracture.labels.tolist()))
True
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register as _register

from .common.errors import (
    AssetError,
    BakeError,
    DatasetError,
    FieldError,
    FracsimError,
    ImpulseError,
    MaterialError,
    MeshError,
    MissingExtraError,
    ModelError,
    PhysicsError,
    RenderError,
)
from .common.impulse import Impulse

if TYPE_CHECKING:
    from .baking import bake
    from .common.material import Material
    from .data.dataset import Dataset
    from .data.writing import make_dataset
    from .fracture.asset import BreakableAsset, load
    from .fracture.pieces import Piece
    from .fracture.result import Fracture
    from .learning import register_model
    from .physics.events import FractureEvent
    from .physics.world import World
    from .segmentation import register_segmentation, segment
    from .simulators import register_simulator
    from .simulators.api import Simulator
    from .simulators.simulated_fracture import SimulatedFracture

__version__ = "0.2.0"

_LAZY = {
    "bake": "baking",
    "BreakableAsset": "fracture.asset",
    "Dataset": "data.dataset",
    "Fracture": "fracture.result",
    "FractureEvent": "physics.events",
    "load": "fracture.asset",
    "make_dataset": "data.writing",
    "Material": "common.material",
    "Piece": "fracture.pieces",
    "register_environment": "envs",
    "register_model": "learning",
    "register_segmentation": "segmentation",
    "register_simulator": "simulators",
    "segment": "segmentation",
    "SimulatedFracture": "simulators.simulated_fracture",
    "Simulator": "simulators.api",
    "World": "physics.world",
}

__all__ = [
    "AssetError",
    "BakeError",
    "BreakableAsset",
    "Dataset",
    "DatasetError",
    "FieldError",
    "FracsimError",
    "Fracture",
    "FractureEvent",
    "Impulse",
    "ImpulseError",
    "Material",
    "MaterialError",
    "MeshError",
    "MissingExtraError",
    "ModelError",
    "PhysicsError",
    "Piece",
    "RenderError",
    "SimulatedFracture",
    "Simulator",
    "World",
    "bake",
    "load",
    "make_dataset",
    "register_environment",
    "register_model",
    "register_segmentation",
    "register_simulator",
    "segment",
]


_SUBMODULES = ("envs", "metrics")


def __getattr__(name: str) -> Any:
    """Load a name when it is first used."""
    if name in _SUBMODULES:
        return importlib.import_module(f".{name}", __name__)
    if name in _LAZY:
        value = getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the names, those not loaded yet included."""
    return sorted({*globals(), *_LAZY, *_SUBMODULES})


# The environments that ship, each with its class and the steps after which an episode is truncated: one line for one.
SHIPPED_ENVIRONMENTS = {
    "FractureDrop-v0": ("fracsim.envs.fracture_drop:FractureDropEnv", 300),
}

for _name, (_entry_point, _steps) in SHIPPED_ENVIRONMENTS.items():
    _register(id=_name, entry_point=_entry_point, max_episode_steps=_steps)
