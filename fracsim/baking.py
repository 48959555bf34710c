"""Baking: a mesh to an asset, stage by stage. Offline only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import __version__
from .common.errors import BakeError, MissingExtraError
from .common.material import Material, as_material
from .common.progress import Stages
from .data.samples import Samples, sample
from .fracture.arrays import AssetArrays, SimulatorRecord
from .fracture.asset import BreakableAsset
from .geometry.complex import CellComplex
from .learning.asset_figures import evaluate_asset
from .learning.atoms import Atoms, atoms_for, observe_fractures
from .learning.body import BodyGeometry
from .learning.field import FieldModel, FieldOptions
from .learning.trainer import Run
from .metrics import ari
from .simulators.base import FractureSimulator
from .simulators.diffusion import impact_field
from .simulators.modal import ModalSimulator
from .simulators.registry import SimulatorOptions, make_simulator
from .solids.convex import convex_arrays
from .solids.geodesics import CAP
from .solids.solid import surface_cells
from .solids.surface import Surface, read_surface, refine

if TYPE_CHECKING:
    import trimesh

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError("threadpoolctl", "bake") from error


@dataclass(frozen=True)
class BakeOptions:
    """truth: "modal", or another of ``simulator.TRUTHS``. cells: of the solid. modes: fracture modes.
    samples: impulses to learn from and be tested on. min_piece_volume_fraction: of the volume; smaller pieces join a neighbour.
    evaluated: test impulses that the figures are taken over, at most. workers: processes. model: the options of the
    field model; without, ``model_for`` the truth.
    """

    simulator: str = "modal"
    cells: int = 5000
    modes: int = 20
    samples: int = 250000
    min_piece_volume_fraction: float = 1e-3
    evaluated: int = 1500
    workers: int = 2
    model: FieldOptions | None = None

    def __post_init__(self) -> None:
        least = {"cells": 50, "modes": 0, "samples": 500, "evaluated": 50, "workers": 1}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise BakeError(f"{name} must be at least {value}, got {getattr(self, name)}")
        _ = self.simulator_options  # checks the truth's name

    @property
    def simulator_options(self) -> SimulatorOptions:
        return SimulatorOptions(self.simulator, self.cells, self.modes, self.min_piece_volume_fraction)


def model_for(truth: str) -> FieldOptions:
    """The field model's options for a truth: any but the modal needs a response of every interface's own."""
    return FieldOptions(response=truth != "modal")


def bake(
    source: str | Path | trimesh.Trimesh,
    material: str | Material = "ceramic",
    seed: int = 0,
    options: BakeOptions | None = None,
    progress: bool = False,
    simulator: Callable[[Surface], FractureSimulator] | None = None,
) -> BreakableAsset:
    """Make a breakable asset of a watertight surface of one component, in metres.

    source: a path to any format trimesh reads, or a Trimesh. progress: a bar a stage, on standard error.
    Edges longer than 0.08 of the size are split first, so a coarse mesh comes out with more vertices.
    simulator: makes a truth of one's own for the surface; else ``options.truth`` names it.
    The asset's ``metadata`` holds the stages' times and the model's figures on held-out impulses. Raises
    MeshError for a surface that cannot be baked and BakeError when a stage fails.
    """
    options = options or BakeOptions()
    chosen = as_material(material)
    with threadpool_limits(1), Stages(progress) as stage:  # sums in one order, whatever the machine
        stage("validate")
        surface = refine(read_surface(source))
        if simulator is None:
            kind = options.simulator
            truth = make_simulator(surface, options.simulator_options, seed, stage)
        else:
            stage("simulator")
            truth = simulator(surface)
            kind = type(truth).__name__
        stage("atoms")
        watched = observe_fractures(truth, seed)
        atoms = atoms_for(truth, watched, options.min_piece_volume_fraction)
        cells, solid, interfaces = atoms.fine_cells, atoms.solid, atoms.interfaces
        stage("impact")
        rows = (
            truth.impact_field
            if isinstance(truth, ModalSimulator)
            else impact_field(cells, atoms.fine_to_atom, surface.vertices)
        )
        body = BodyGeometry.of(surface, atoms, stage.ticker("distances"))
        tick = stage.ticker("samples")
        samples = sample(truth, options.samples, seed, tick, options.workers, transform=atoms.project, begun=watched)
        tick = stage.ticker("training")
        model, figures = FieldModel.fit(body, samples, options.model or model_for(kind), seed, Run(progress=tick))
        complex_ = CellComplex(solid.points, solid.triangles, solid.sides)
        convex = convex_arrays(
            complex_, (surface.vertices, surface.faces), interfaces.pairs, interfaces.normals, stage.ticker
        )
        arrays = AssetArrays(
            faces=surface.faces,
            points=solid.points,
            triangles=solid.triangles,
            sides=solid.sides,
            impact_field=rows.astype(np.float32),
            pairs=interfaces.pairs,
            areas=interfaces.areas,
            normals=interfaces.normals,
            projected=interfaces.projected,
            distances=body.distances[:, : len(surface.vertices)].astype(np.float16),
            interface_vertices=body.interface_vertices,
            **convex,
        )
        given = _truth(kind, samples)
        name = Path(surface.name).stem
        floor = options.min_piece_volume_fraction
        asset = BreakableAsset(name, chosen, surface.scale, surface.offset, CAP, floor, arrays, model.net, {}, given)
        test = evaluate_asset(asset, body, samples, options.evaluated, stage.ticker("evaluation"))
        if not atoms.are_the_simulators:
            test["ari_of_the_atoms"] = _atoms_ari(truth, atoms, watched[0])
    asset.metadata.update(
        {
            "fracsim": __version__,
            "seed": seed,
            "options": asdict(options),
            "simulator": kind,
            "seconds": {**stage.seconds, "total": sum(stage.seconds.values())},
            "counts": {
                "vertices": len(surface.vertices),
                "cells": len(cells.volumes),
                "atoms": len(solid.volumes),
                "interfaces": len(interfaces),
                "hulls": len(arrays.hull_sizes),
                "body_hulls": len(arrays.body_sizes),
            },
            "training": figures,
            "test": test,
        }
    )
    if isinstance(truth, ModalSimulator):
        asset.metadata["mode_energies"] = [history[-1] for history in truth.energies]
    return asset


def remake_convex(asset: BreakableAsset) -> BreakableAsset:
    """The same asset with the convex parts that a bake would give it now; all else is as it was."""
    arrays = asset.arrays
    with threadpool_limits(1):
        whole = (arrays.points[: asset.vertex_count], arrays.faces)
        arrays = replace(arrays, **convex_arrays(arrays.complex, whole, arrays.pairs, arrays.normals))
    counts = {"hulls": len(arrays.hull_sizes), "body_hulls": len(arrays.body_sizes)}
    metadata = {**asset.metadata, "counts": {**asset.metadata["counts"], **counts}}
    return replace(asset, arrays=arrays, metadata=metadata)


def _truth(kind: str, samples: Samples) -> SimulatorRecord:
    train = samples.of_split(0)
    total = train.severities.sum(axis=1)
    broke = train.labels.any(axis=1)
    if not broke.any():
        raise BakeError("no training impulse breaks the body; its truth has nothing to teach")
    single = train.kind == 0
    return SimulatorRecord(kind, 0.5 * float(total[broke].min()), float(np.median((total / train.ratio)[single])))


def _atoms_ari(truth: FractureSimulator, atoms: Atoms, block: Samples) -> float:
    """How well atoms can say what a truth that cuts freely does: mean ARI at the vertices over a block's held-out
    fractures."""
    held_out = block.take((block.split != 0) & block.labels.any(axis=1))
    count = len(truth.surface.vertices)
    vertex_cell, vertex_atom = surface_cells(truth.cells, count), surface_cells(atoms.solid, count)
    rows = zip(held_out.labels[:, vertex_cell], atoms.project(held_out).labels[:, vertex_atom], strict=True)
    return float(np.mean([ari(free, built) for free, built in rows]))
