"""Evaluation: every model and every segmentation of a plan, measured on every mesh side by side. Offline only.

The measurement of one model on one mesh is kept in the work folder as soon as it is finished. An evaluation that was
stopped goes on where it was, and several processes may share the folder if each has its own meshes.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..common.errors import ModelError
from ..common.progress import Stages
from ..segmentation import METHODS
from .mesh_bench import MeshBench
from .plan import Plan
from .work_folder import read_result, result_path, write_result


def evaluate(
    plan: Plan, work: Path, only: tuple[str, ...] = (), progress: bool = False, again: bool = False
) -> dict[str, Any]:
    """Measure what is not measured yet, and collect everything that is measured of a plan.

    Parameters
    ----------
    plan : Plan
        The plan.
    work : Path
        A folder for datasets, models and finished measurements; it is made if it is missing.
    only : tuple of str
        Names of the meshes to measure; empty for all.
    progress : bool
        Whether to show progress on standard error.
    again : bool
        Whether to repeat finished measurements, with the trained models that are there.

    Returns
    -------
    dict
        ``rows``, one for each mesh, model and segmentation; ``fits``, the figures of the trainings; ``missing``, what
        is not measured yet; ``plan``, the plan itself. Plain data, as in accuracy.json.

    Raises
    ------
    ModelError
        If the plan has no mesh of that name, or a model cannot be trained.
    """
    work.mkdir(parents=True, exist_ok=True)
    for name in only:
        if name not in [mesh.name for mesh in plan.meshes]:
            raise ModelError(f"the plan has no mesh {name!r}")
    for mesh in plan.meshes:
        if only and mesh.name not in only:
            continue
        pending = [
            model
            for model in plan.models_of(mesh)
            if again or not _is_complete(read_result(result_path(plan, mesh, model, work)))
        ]
        if pending:
            with Stages(progress) as stage:
                bench = MeshBench(plan, mesh, work, stage)
                for model in pending:
                    write_result(result_path(plan, mesh, model, work), bench.measure(model))
    rows, fits, missing = [], [], []
    for mesh in plan.meshes:
        for model in plan.models_of(mesh):
            result = read_result(result_path(plan, mesh, model, work))
            if result is None:
                missing.append(f"{model.name} on {mesh.name}")
            else:
                rows += result["rows"]
                fits.append(result["fit"])
    return {"rows": rows, "fits": fits, "missing": missing, "plan": _plain(plan)}


def _is_complete(result: dict[str, Any] | None) -> bool:
    """Tell whether a measurement is there and has a row for every segmentation, registered ones included."""
    return result is not None and {row["segmentation"] for row in result["rows"]} >= METHODS.keys()


def _plain(plan: Plan) -> dict[str, Any]:
    """Turn a plan into plain data, with file names instead of paths."""
    plain = asdict(plan)
    for mesh in plain["meshes"]:
        mesh["file"] = Path(mesh["file"]).name
    plain["studies"] = [Path(study).parent.name for study in plain["studies"]]
    return plain
