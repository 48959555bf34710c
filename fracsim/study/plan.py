"""TODO study.plan."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..common.errors import ModelError
from ..learning import MODELS
from ..learning.options import with_training
from ..simulators.registry import SimulatorOptions

UNLEARNED = ("simulator", "precomputed")


@dataclass(frozen=True)
class MeshPlan:
    """One mesh. splits: how often each face is split in three at its centroid. samples: impulses drawn, training and
    test together. tested: held-out impulses that part the body; slow: how many of them for the thesis's models and
    segmentations; timed: for the NetworkX references."""

    name: str
    file: str
    splits: int = 0
    samples: int = 100_000
    tested: int = 400
    slow: int = 100
    timed: int = 5


@dataclass(frozen=True)
class ModelPlan:
    """One model. kind: of models.base.MODELS, or truth or modes. options: of its own. training: of the trainer.
    samples: that it learns from, at most. meshes: that it is tried on; all, where none is named. others: whether it
    learns from the other meshes' samples instead, and never sees the one it is tried on."""

    name: str
    kind: str
    options: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    samples: int | None = None
    meshes: tuple[str, ...] = ()
    others: bool = False


@dataclass(frozen=True)
class Plan:
    """A whole evaluation. published: rows of other people's to stand beside ours, as given. studies: trials.json files
    of ``fracsim tune``, to be drawn side by side."""

    meshes: tuple[MeshPlan, ...]
    models: tuple[ModelPlan, ...]
    simulator: SimulatorOptions
    seed: int
    published: tuple[dict[str, Any], ...]
    studies: tuple[str, ...] = ()


def read_plan(path: str | Path) -> Plan:
    """Read a plan. Raises ModelError, naming the file and the fault."""
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no such file")
    try:
        told = tomllib.loads(path.read_text(encoding="utf-8"))
        meshes = tuple(MeshPlan(**mesh) for mesh in told.pop("meshes"))
        models = tuple(ModelPlan(**{**m, "meshes": tuple(m.get("meshes", ()))}) for m in told.pop("models"))
        plan = Plan(
            tuple(replace(m, file=str((path.parent / m.file).resolve())) for m in meshes),
            models,
            SimulatorOptions(**told.pop("simulator", {})),
            int(told.pop("seed", 0)),
            tuple(told.pop("published", ())),
            tuple(str((path.parent / study).resolve()) for study in told.pop("studies", ())),
        )
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: not a plan ({error})") from error
    if told:
        raise ModelError(f"{path}: unknown entries {', '.join(told)}")
    for things, kind in ((plan.meshes, "mesh"), (plan.models, "model")):
        names = [thing.name for thing in things]
        if not names or len(set(names)) != len(names):
            raise ModelError(f"{path}: every {kind} needs a name of its own, and there must be one")
    for model in plan.models:
        if model.kind not in (*MODELS, *UNLEARNED):
            raise ModelError(f"{path}: {model.name}: unknown kind {model.kind!r}")
        for name in model.meshes:
            if name not in [mesh.name for mesh in plan.meshes]:
                raise ModelError(f"{path}: {model.name}: there is no mesh {name!r}")
    return plan


def options_of(options_type: type[Any], plan: ModelPlan) -> Any:
    """The options that a plan names; a budget among its training replaces the model's own."""
    options = {name: tuple(value) if isinstance(value, list) else value for name, value in plan.options.items()}
    try:
        return with_training(options_type(), {**options, **plan.training})
    except (ModelError, TypeError) as error:  # a plan's values may be of any type
        raise ModelError(f"{plan.name}: {error}") from error
