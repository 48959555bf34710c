"""Baking, the offline flow on one page: a mesh becomes an asset that breaks in real time.

``bake`` calls the offline rooms in their order (solids, simulators, data, learning) and hands on what each makes.
Commands and users enter here; nothing that runs in a simulation does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import __version__
from .common.errors import BakeError, MissingExtraError
from .common.material import Material, as_material
from .common.progress import Stages
from .data.repeatability import repeatability_of
from .data.samples import Samples, sample
from .fracture.arrays import AssetArrays, SimulatorRecord
from .fracture.asset import BreakableAsset
from .learning.asset_figures import evaluate_asset
from .learning.atoms import Atoms, atoms_for, observe_fractures
from .learning.body import BodyGeometry
from .learning.field import FieldModel, FieldOptions
from .learning.trainer import Run
from .metrics import ari
from .simulators import SIMULATORS, simulator_class
from .simulators.base import ContactCompliance, Described, FractureSimulator, ImpactField
from .simulators.capabilities import default_samples, severity_kind_of
from .simulators.diffusion import GAUGE, impact_field
from .simulators.registry import SimulatorOptions, make_simulator, options_for, options_for_body
from .solids.convex import convex_arrays
from .solids.geodesics import CAP
from .solids.surface import Surface, read_surface, refine

if TYPE_CHECKING:
    import trimesh

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError("threadpoolctl", "bake") from error

TRAIN = 0  # the split that a model learns from; see ``Samples.split``
SINGLE_CONTACT = 0  # the kind of impact with one contact; see ``Samples.kind``
LEAST = {"samples": 500, "evaluated": 50, "workers": 1}  # below them there is nothing to learn from or to measure


@dataclass(frozen=True)
class BakeOptions:
    """How fine, from how much, and with which simulator and model to bake.

    What is None is chosen by the simulator, whose options have defaults of their own.

    Attributes
    ----------
    simulator : str
        A registered simulator: "modal", "structural", "sequential", "elastic", "radial", or one of your own.
    cells : int, optional
        About how many cells the body is cut into.
    modes : int, optional
        Fracture modes, for a simulator that has them.
    samples : int, optional
        Impacts to learn from and be tested on, at least 500; by default 250,000, or fewer where the simulator is slow
        and says so.
    min_piece_volume_fraction : float, optional
        Pieces of less than this fraction of the body's volume join a neighbour.
    evaluated : int
        Test impacts that the figures are taken over, at most; at least 50.
    workers : int
        Processes that draw samples.
    simulator_settings : mapping of str to object
        Other options of the simulator, by name.
    model : FieldOptions, optional
        The options of the field model; ``model_for`` the simulator by default.

    Raises
    ------
    BakeError
        If a value is out of range, or no simulator has that name.
    """

    simulator: str = "modal"
    cells: int | None = None
    modes: int | None = None
    samples: int | None = None
    min_piece_volume_fraction: float | None = None
    evaluated: int = 1500
    workers: int = 2
    simulator_settings: Mapping[str, Any] = field(default_factory=dict)
    model: FieldOptions | None = None

    def __post_init__(self) -> None:
        values = vars(self)
        for name, limit in LEAST.items():
            if values[name] is not None and values[name] < limit:
                raise BakeError(f"{name} must be at least {limit}, got {values[name]}")
        _ = self.simulator_options  # checks the rest

    @property
    def simulator_values(self) -> dict[str, Any]:
        """The options of the simulator that are set, by name."""
        values = {name: getattr(self, name) for name in ("cells", "modes", "min_piece_volume_fraction")}
        return {name: value for name, value in values.items() if value is not None} | dict(self.simulator_settings)

    @property
    def simulator_options(self) -> SimulatorOptions:
        """What the simulator is built with, but for what follows from the material and size of the body."""
        return options_for(self.simulator, **self.simulator_values)

    def simulator_options_for(self, material: Material, size: float) -> SimulatorOptions:
        """Make the options that the simulator of a body is built with.

        Parameters
        ----------
        material : Material
            What it is made of.
        size : float
            m, its largest extent.

        Returns
        -------
        SimulatorOptions
            Of the simulator's own type.
        """
        return options_for_body(self.simulator, material, size, **self.simulator_values)


def model_for(simulator: str) -> FieldOptions:
    """Choose the field model's options for a simulator.

    Parameters
    ----------
    simulator : str
        Its name. Of a simulator that is not registered, the name of its class.

    Returns
    -------
    FieldOptions
        With a response for every interface of its own, unless the simulator is driven by an impact field, which the
        asset carries.
    """
    return FieldOptions(response=not _driven_by_impact_field(simulator))


def _driven_by_impact_field(simulator: str) -> bool:
    """Say whether a simulator is registered, and driven by the impact field that the asset carries."""
    return simulator in SIMULATORS and simulator_class(simulator).driven_by_impact_field


def bake(
    source: str | Path | trimesh.Trimesh,
    material: str | Material = "ceramic",
    seed: int = 0,
    options: BakeOptions | None = None,
    progress: bool = False,
    simulator: str | Callable[[Surface], FractureSimulator] | None = None,
) -> BreakableAsset:
    """Make a breakable asset of a watertight surface of one component.

    Parameters
    ----------
    source : path or trimesh.Trimesh
        In metres; a path to any format that trimesh reads. Edges longer than 0.08 of the size are split first, so a
        coarse mesh comes out with more vertices.
    material : str or Material
        What it is made of.
    seed : int
        The same seed gives the same asset, bit by bit, with a simulator that repeats itself.
    options : BakeOptions, optional
        How to bake.
    progress : bool
        Whether to show a bar for each stage, on standard error.
    simulator : str or callable, optional
        A registered simulator instead of the one that ``options.simulator`` names; or what makes one of your own for
        the surface.

    Returns
    -------
    BreakableAsset
        Its ``metadata`` holds the seconds of each stage and the model's figures on held-out impacts.

    Raises
    ------
    MeshError
        If the surface cannot be baked.
    BakeError
        If a stage fails.
    """
    options = options or BakeOptions()
    if isinstance(simulator, str):
        options, simulator = replace(options, simulator=simulator), None
    chosen_material = as_material(material)
    with threadpool_limits(1), Stages(progress) as stage:  # sums in one order, whatever the machine
        stage("validate")
        surface = refine(read_surface(source))
        built_from: SimulatorOptions | None = None
        if simulator is None:
            name, built_from = options.simulator, options.simulator_options_for(chosen_material, surface.scale)
            made: FractureSimulator = make_simulator(surface, built_from, seed, stage)
        else:
            stage("simulator")
            made = simulator(surface)
            name = type(made).__name__
        options = _resolved(options, made, built_from)
        repeated = repeatability_of(made, built_from, seed, options.workers, progress=stage)
        stage("atoms")
        observed = observe_fractures(made, seed, options.workers)
        floor = (built_from or options.simulator_options).min_piece_volume_fraction
        atoms = atoms_for(made, observed, floor)
        stage("impact")
        if isinstance(made, ImpactField):
            impacts = made.impact_field
        else:
            impacts = impact_field(atoms.fine_cells, atoms.fine_to_atom, surface.vertices)
        body = BodyGeometry.of(surface, atoms, stage.ticker("distances"))
        draw = stage.ticker("samples")
        assert options.samples is not None  # resolved above
        samples = sample(made, options.samples, seed, draw, options.workers, transform=atoms.project, begun=observed)
        run = Run(progress=stage.ticker("training"))
        model, training = FieldModel.fit(body, samples, options.model or model_for(name), seed, run)
        whole, interfaces = (surface.vertices, surface.faces), atoms.interfaces
        arrays = AssetArrays(
            faces=surface.faces,
            points=atoms.solid.points,
            triangles=atoms.solid.triangles,
            sides=atoms.solid.sides,
            impact_field=impacts.astype(np.float32),
            pairs=interfaces.pairs,
            areas=interfaces.areas,
            normals=interfaces.normals,
            projected=interfaces.projected,
            distances=body.distances[:, : len(surface.vertices)].astype(np.float16),
            interface_vertices=body.interface_vertices,
            compliance=made.compliance if isinstance(made, ContactCompliance) else None,
            **convex_arrays(atoms.solid, whole, interfaces.pairs, interfaces.normals, stage.ticker),
        )
        record, size = _record(name, made, samples), (surface.scale, surface.offset)
        title = Path(surface.name).stem
        asset = BreakableAsset(title, chosen_material, *size, CAP, floor, arrays, model.net, {}, record)
        test = evaluate_asset(asset, body, samples, options.evaluated, stage.ticker("evaluation"))
        if not atoms.are_the_simulators:
            test["ari_of_the_atoms"] = _atoms_ari(made, atoms, observed[0])
    metadata: dict[str, Any] = {
        "fracsim": __version__,
        "seed": seed,
        "options": asdict(options),
        "simulator": name,
        "simulator_options": None if built_from is None else asdict(built_from),
        "repeatability": repeated,
        "seconds": {**stage.seconds, "total": sum(stage.seconds.values())},
        "counts": {
            "vertices": len(surface.vertices),
            "cells": len(atoms.fine_cells.volumes),
            "atoms": len(atoms.solid.volumes),
            "interfaces": len(interfaces),
            "hulls": len(arrays.hull_sizes),
            "body_hulls": len(arrays.body_sizes),
        },
        "training": training,
        "test": test,
        **(made.figures() if isinstance(made, Described) else {}),
    }
    asset.metadata.update(metadata)
    return asset


def remake_convex(asset: BreakableAsset) -> BreakableAsset:
    """Make an asset's convex parts again, as a bake would make them now.

    Parameters
    ----------
    asset : BreakableAsset
        Of any size and material.

    Returns
    -------
    BreakableAsset
        All else is as it was.
    """
    arrays = asset.arrays
    with threadpool_limits(1):
        whole = (arrays.points[: asset.vertex_count], arrays.faces)
        arrays = replace(arrays, **convex_arrays(arrays.complex, whole, arrays.pairs, arrays.normals))
    counts = {"hulls": len(arrays.hull_sizes), "body_hulls": len(arrays.body_sizes)}
    metadata = {**asset.metadata, "counts": {**asset.metadata["counts"], **counts}}
    return replace(asset, arrays=arrays, metadata=metadata)


def _resolved(options: BakeOptions, made: FractureSimulator, built_from: SimulatorOptions | None) -> BakeOptions:
    """Put what was chosen in the place of what was left open."""
    chosen: dict[str, Any] = {"samples": options.samples or default_samples(type(made))}
    if built_from is not None:
        for name in ("cells", "modes", "min_piece_volume_fraction"):
            chosen[name] = getattr(built_from, name)
    return replace(options, **chosen)


def _record(name: str, simulator: FractureSimulator, samples: Samples) -> SimulatorRecord:
    """Keep what the asset has to know of its simulator: how severe an impact must be to break anything."""
    train = samples.of_split(TRAIN)
    total = train.severities.sum(axis=1)
    broke = train.labels.any(axis=1)
    if not broke.any():
        raise BakeError("no training impact breaks the body, so there is nothing to learn; its simulator is too strong")
    single = train.kind == SINGLE_CONTACT
    typical = float(np.median((total / train.ratio)[single]))
    least, driven = 0.5 * float(total[broke].min()), _driven_by_impact_field(name)
    return SimulatorRecord(name, least, typical, driven, severity_kind_of(simulator), GAUGE)


def _atoms_ari(simulator: FractureSimulator, atoms: Atoms, block: Samples) -> float:
    """Score how well atoms can express the free pieces of a simulator: mean ARI at the vertices, held-out fractures."""
    held_out = block.take((block.split != TRAIN) & block.labels.any(axis=1))
    count = len(simulator.surface.vertices)
    vertex_cell, vertex_atom = simulator.cells.vertex_cells(count), atoms.solid.vertex_cells(count)
    rows = zip(held_out.labels[:, vertex_cell], atoms.project(held_out).labels[:, vertex_atom], strict=True)
    return float(np.mean([ari(free, merged) for free, merged in rows]))
