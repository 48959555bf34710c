"""The plan of an evaluation: which meshes, which models, and how much is measured of each.

``evaluate`` and ``write_report`` take a plan; ``read_plan`` reads one from a TOML file.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..common.errors import BakeError, MaterialError, ModelError
from ..common.material import as_material
from ..learning import MODELS
from ..learning.options import with_training
from ..simulators.registry import SimulatorOptions, options_for, options_for_body

UNLEARNED = ("simulator", "precomputed")  # kinds of rows that nothing is learned for


@dataclass(frozen=True)
class MeshPlan:
    """One mesh of a plan.

    Attributes
    ----------
    name : str
        Its name in tables and charts.
    file : str
        A file that ``read_surface`` reads.
    splits : int
        How many times each face is split in three at its centroid.
    samples : int
        Impulses drawn, for training, validation and test together.
    tested : int
        Test impulses that break the body and are measured.
    slow : int
        How many of these are measured for slow models, and for the segmentations of the thesis.
    timed : int
        How many of these the NetworkX references are timed on.
    """

    name: str
    file: str
    splits: int = 0
    samples: int = 100_000
    tested: int = 400
    slow: int = 100
    timed: int = 5


@dataclass(frozen=True)
class ModelPlan:
    """One model of a plan.

    Attributes
    ----------
    name : str
        Its name in tables and charts.
    kind : str
        A name in ``learning.MODELS``; or ``"simulator"``, the true fields; or ``"precomputed"``, the simulator with
        precomputed impact fields, as an asset uses it.
    options : dict of str to object
        Options of the model that differ from the defaults.
    training : dict of str to object
        Training options that differ from the defaults.
    samples : int or None
        The number of samples that it learns from; None for all.
    meshes : tuple of str
        Names of the meshes that it is measured on; empty for all.
    others : bool
        Whether it learns from the other meshes of the plan and never sees the one it is measured on.
    """

    name: str
    kind: str
    options: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    samples: int | None = None
    meshes: tuple[str, ...] = ()
    others: bool = False


@dataclass(frozen=True)
class Plan:
    """An evaluation.

    Attributes
    ----------
    meshes : tuple of MeshPlan
        The meshes.
    models : tuple of ModelPlan
        The models.
    simulator : SimulatorOptions
        The fracture simulator that samples come from.
    seed : int
        Seed of the samples and of the training.
    published : tuple of dict
        Rows that others published, shown beside ours as they are.
    studies : tuple of str
        Paths of ``trials.json`` files of ``fracsim tune``, whose Pareto fronts are drawn in one chart.
    material : str
        What the meshes are made of, for a simulator that depends on it.
    settings : dict, optional
        The options of the simulator that are set, by name; the others follow from material and size where the simulator
        depends on them. None: all are set.
    """

    meshes: tuple[MeshPlan, ...]
    models: tuple[ModelPlan, ...]
    simulator: SimulatorOptions
    seed: int
    published: tuple[dict[str, Any], ...]
    studies: tuple[str, ...] = ()
    material: str = "ceramic"
    settings: dict[str, Any] | None = None

    def simulator_of(self, size: float) -> SimulatorOptions:
        """Make the options of the simulator of a mesh.

        Parameters
        ----------
        size : float
            m, its largest extent.

        Returns
        -------
        SimulatorOptions
            The plan's, with what follows from the material and the size.
        """
        if self.settings is None:
            return self.simulator
        return options_for_body(self.simulator.name, as_material(self.material), size, **self.settings)

    def models_of(self, mesh: MeshPlan) -> list[ModelPlan]:
        """List the models that are measured on a mesh.

        Parameters
        ----------
        mesh : MeshPlan
            A mesh of this plan.

        Returns
        -------
        list of ModelPlan
            The models, in the order of the plan.
        """
        return [model for model in self.models if not model.meshes or mesh.name in model.meshes]


def read_plan(path: str | Path) -> Plan:
    """Read a plan.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``[[meshes]]``, ``[[models]]``, ``[simulator]``, ``material``, ``seed``, ``[[published]]`` and
        ``studies``. File names in it are relative to its folder.

    Returns
    -------
    Plan
        The plan, with absolute paths.

    Raises
    ------
    ModelError
        If the file is missing, is not TOML, or an entry is unknown or contradicts another; the message names both.
    """
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no such file")
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        meshes = tuple(MeshPlan(**mesh) for mesh in document.pop("meshes"))
        models = tuple(ModelPlan(**{**m, "meshes": tuple(m.get("meshes", ()))}) for m in document.pop("models"))
        simulator = dict(document.pop("simulator", {}))
        settings = {name: value for name, value in simulator.items() if name != "name"}
        plan = Plan(
            tuple(replace(m, file=str((path.parent / m.file).resolve())) for m in meshes),
            models,
            options_for(**simulator),
            int(document.pop("seed", 0)),
            tuple(document.pop("published", ())),
            tuple(str((path.parent / study).resolve()) for study in document.pop("studies", ())),
            as_material(document.pop("material", Plan.material)).name,
            settings,
        )
    except (BakeError, MaterialError) as error:
        raise ModelError(f"{path}: {error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: not a plan ({error})") from error
    if document:
        raise ModelError(f"{path}: unknown entries {', '.join(document)}")
    for entries, title in ((plan.meshes, "mesh"), (plan.models, "model")):
        names = [entry.name for entry in entries]
        if not names or len(set(names)) != len(names):
            raise ModelError(f"{path}: there must be at least one {title}, and every {title} needs a name of its own")
    for model in plan.models:
        if model.kind not in (*MODELS, *UNLEARNED):
            known = ", ".join((*MODELS, *UNLEARNED))
            raise ModelError(f"{path}: {model.name}: unknown kind {model.kind!r}; use one of {known}")
        for name in model.meshes:
            if name not in [mesh.name for mesh in plan.meshes]:
                raise ModelError(f"{path}: {model.name}: there is no mesh {name!r}")
    return plan


def options_of(options_type: type[Any], plan: ModelPlan) -> Any:
    """Build the options of a planned model.

    Parameters
    ----------
    options_type : type
        The class of the model's options.
    plan : ModelPlan
        The model. A budget among its training options replaces the model's own.

    Returns
    -------
    object
        An instance of ``options_type``.

    Raises
    ------
    ModelError
        If an option is unknown or has a wrong value; the message names the model.
    """
    options = {name: tuple(value) if isinstance(value, list) else value for name, value in plan.options.items()}
    try:
        return with_training(options_type(), {**options, **plan.training})
    except (ModelError, TypeError) as error:  # values from TOML may have any type
        raise ModelError(f"{plan.name}: {error}") from error
