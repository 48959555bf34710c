"""The work folder of an evaluation: its datasets, trained models and finished measurements, by file name.

``evaluate``, ``MeshBench`` and ``write_report`` use it. A file name changes with everything that its content depends
on, so that nothing outdated is read.
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.files import write_beside
from ..common.progress import Stages
from ..data.dataset import Dataset
from ..data.samples import Samples
from ..data.writing import make_dataset
from ..learning.body import BodyGeometry
from ..simulators import simulator_class
from ..simulators.base import FractureSimulator, MaterialDependent
from ..solids.surface import Surface, read_surface, refine, split_faces
from .plan import MeshPlan, ModelPlan, Plan


def surface_of(mesh: MeshPlan) -> Surface:
    """Read the surface of a planned mesh.

    Parameters
    ----------
    mesh : MeshPlan
        The mesh.

    Returns
    -------
    Surface
        The surface, refined as for a bake, and then with its faces split as often as planned.
    """
    surface = refine(read_surface(mesh.file))
    for _ in range(mesh.splits):
        surface = split_faces(surface)
    return surface


def dataset_of(
    plan: Plan, mesh: MeshPlan, work: Path, stage: Stages
) -> tuple[BodyGeometry, Samples, FractureSimulator]:
    """Read the dataset of a planned mesh, and make it first if it is missing or too small.

    Parameters
    ----------
    plan : Plan
        The plan, for its simulator and seed.
    mesh : MeshPlan
        The mesh.
    work : Path
        The work folder.
    stage : Stages
        Where progress is shown.

    Returns
    -------
    body : BodyGeometry
        The body.
    samples : Samples
        As many as planned.
    simulator : FractureSimulator
        The simulator that they come from.
    """
    surface = surface_of(mesh)
    options = plan.simulator_of(surface.scale)
    inputs = json.dumps([asdict(options), mesh.splits, plan.seed], sort_keys=True)
    path = work / f"{mesh.name}-{hashlib.sha256(inputs.encode()).hexdigest()[:12]}.h5"
    stage(f"{mesh.name}: samples")
    if not (path.is_file() and _has_samples(path, mesh.samples)):  # or another process may be reading what it made
        make_dataset(path, surface, mesh.samples, plan.seed, options)
    with Dataset(path) as dataset:
        body, samples = BodyGeometry.read(dataset, stage.ticker(f"{mesh.name}: distances"))
        simulator = dataset.simulator
    assert simulator is not None  # BodyGeometry.read refuses a dataset without one
    return body, samples.take(slice(mesh.samples)), simulator


def model_stem(plan: Plan, mesh: MeshPlan, model: ModelPlan) -> str:
    """Name the files of a model on a mesh.

    Parameters
    ----------
    plan : Plan
        The plan.
    mesh : MeshPlan
        The mesh.
    model : ModelPlan
        The model.

    Returns
    -------
    str
        A file name without an ending, which changes with everything that the model's weights depend on.
    """
    described = {name: value for name, value in asdict(model).items() if name != "meshes"}
    inputs: dict[str, Any] = {"mesh": (mesh.name, mesh.splits, mesh.samples), "model": described, "seed": plan.seed}
    inputs["simulator"] = asdict(plan.simulator)
    if isinstance(simulator_class(plan.simulator.name), MaterialDependent):
        inputs["material"] = plan.material
    if model.others:
        inputs["all"] = [(m.name, m.splits, m.samples) for m in plan.meshes]
    digest = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    return f"{mesh.name}-{model.kind}-{digest}"


def result_path(plan: Plan, mesh: MeshPlan, model: ModelPlan, work: Path) -> Path:
    """Name the file of a finished measurement.

    Parameters
    ----------
    plan : Plan
        The plan.
    mesh : MeshPlan
        The mesh.
    model : ModelPlan
        The model.
    work : Path
        The work folder.

    Returns
    -------
    Path
        A JSON file. The fields and pieces for pictures are beside it, ending in ``.npz``.
    """
    return work / f"{model_stem(plan, mesh, model)}-{mesh.tested}-{mesh.slow}-{mesh.timed}.json"


def read_result(path: Path) -> dict[str, Any] | None:
    """Read a finished measurement.

    Parameters
    ----------
    path : Path
        What ``result_path`` returns.

    Returns
    -------
    dict or None
        What ``MeshBench.measure`` returned, or None if there is no such file.
    """
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def write_result(path: Path, result: dict[str, Any]) -> None:
    """Keep a finished measurement.

    Parameters
    ----------
    path : Path
        What ``result_path`` returns.
    result : dict
        What ``MeshBench.measure`` returned.
    """
    write_beside(path, (json.dumps(result, indent=1) + "\n").encode())


def write_pictured(path: Path, arrays: dict[str, npt.NDArray[Any]]) -> None:
    """Keep the fields and pieces that pictures are drawn from.

    Parameters
    ----------
    path : Path
        What ``result_path`` returns.
    arrays : dict of str to ndarray
        Arrays whose first dimension is the impulse.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_beside(path.with_suffix(".npz"), buffer.getvalue())


def read_pictured(path: Path) -> dict[str, npt.NDArray[Any]] | None:
    """Read the fields and pieces that pictures are drawn from.

    Parameters
    ----------
    path : Path
        What ``result_path`` returns.

    Returns
    -------
    dict of str to ndarray, or None
        What ``write_pictured`` kept, or None if there is no such file.
    """
    path = path.with_suffix(".npz")
    if not path.is_file():
        return None
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _has_samples(path: Path, count: int) -> bool:
    """Tell whether a dataset holds at least so many samples."""
    with Dataset(path) as dataset:
        return len(dataset) >= count
