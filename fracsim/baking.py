"""Baking: a mesh to an asset, stage by stage. Offline only."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from .asset import AssetArrays, BreakableAsset
from .breaking import Interfaces
from .convex import clip_apart, decompose, pack
from .dataset import Generator, Samples, sample
from .errors import BakeError, MissingExtraError
from .fracture_modes import atoms, fracture_modes, impact_field
from .impulse import Impulse
from .material import Material, as_material
from .mesh import read_surface, refine
from .metrics import ACCEPTED, amae, ari
from .models.field import field_from_scores
from .pieces import AtomComplex
from .sampling import SurfacePoints
from .solid import coarsen, cut_lattice, relabel, shared_faces
from .spectrum import spectrum
from .train import TrainingOptions, train_field
from .udf import CAP, interface_distances

try:
    from tqdm import tqdm
except ImportError as error:
    raise MissingExtraError("tqdm", "bake") from error

if TYPE_CHECKING:
    import trimesh

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class BakeOptions:
    """cells: of the solid. modes: fracture modes. samples: impulses to learn from and be tested on.
    eigenfunctions: of the solid, in which the model sees it. crumb_floor: of the volume; smaller pieces
    join a neighbour. evaluated: test impulses that the figures are taken over, at most.
    """

    cells: int = 5000
    modes: int = 20
    samples: int = 50000
    eigenfunctions: int = 96
    crumb_floor: float = 1e-3
    evaluated: int = 1500
    workers: int = 2
    training: TrainingOptions = field(default_factory=TrainingOptions)

    def __post_init__(self) -> None:
        least = {"cells": 50, "modes": 0, "samples": 500, "eigenfunctions": 1, "evaluated": 50, "workers": 1}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise BakeError(f"{name} must be at least {value}, got {getattr(self, name)}")
        if self.training.steps < 1:
            raise BakeError(f"training steps must be at least 1, got {self.training.steps}")


def bake(
    source: str | Path | trimesh.Trimesh,
    material: str | Material = "ceramic",
    seed: int = 0,
    options: BakeOptions | None = None,
    progress: bool = False,
) -> BreakableAsset:
    """Make a breakable asset of a watertight surface of one component, in metres.

    source: a path to any format trimesh reads, or a Trimesh. progress: a bar a stage, on standard error.
    Edges longer than 0.08 of the size are split first, so a coarse mesh comes out with more vertices.
    The asset's ``metadata`` holds the stages' times and the model's figures on held-out impulses. Raises
    MeshError for a surface that cannot be baked and BakeError when a stage fails.
    """
    options = options or BakeOptions()
    chosen = as_material(material)
    stages = _Stages(progress)
    with stages("validate"):
        surface = refine(read_surface(source))
    rngs = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(2)]
    with stages("solid"):
        cells = cut_lattice(surface, options.cells, rngs[0])
    with stages("modes") as tick:
        modes = fracture_modes(cells, options.modes, tick)
    with stages("atoms"):
        atom = atoms(cells, modes)
        solid = coarsen(relabel(cells, atom), surface)
        pairs, areas, vectors = shared_faces(solid.triangles, solid.sides, solid.points)
        if len(pairs) == 0:
            raise BakeError(f"{surface.name}: no fracture mode parts it; raise the number of modes or cells")
        projected = np.linalg.norm(vectors, axis=1)
        interfaces = Interfaces(pairs, areas, vectors / projected[:, None], projected)
    with stages("impact"):
        rows = impact_field(cells, atom, surface.vertices)
    with stages("distances") as tick:
        distances, shores = interface_distances(solid, surface, pairs, tick)
        distances = distances[:, : len(surface.vertices)]
    with stages("samples") as tick:
        generator = Generator(surface, rows, interfaces, solid.volumes, options.crumb_floor)
        samples = sample(generator, options.samples, rngs[1], tick)
    with stages("training") as tick:
        geometry = spectrum(cells, atom, surface, options.eigenfunctions)
        model, figures = train_field(samples, geometry, surface.faces, interfaces, seed, options.training, tick)
    with stages("convex") as tick:
        complex_ = AtomComplex(solid.points, solid.triangles, solid.sides)
        one = np.eye(complex_.count, dtype=bool)
        shells = [complex_.surface(row)[:2] for row in one]
        whole = (surface.vertices, surface.faces)
        *parts, body = decompose([*shells, whole], options.workers, tick)
    with stages("clipping") as tick:
        parts = clip_apart(parts, pairs, interfaces.normals, progress=tick)
    hulls, whole_hulls = pack([points for some in parts for points in some]), pack(body)
    arrays = AssetArrays(
        faces=surface.faces,
        points=solid.points,
        triangles=solid.triangles,
        sides=solid.sides,
        rows=rows.astype(np.float32),
        pairs=pairs,
        areas=areas,
        normals=interfaces.normals,
        projected=projected,
        distances=distances.astype(np.float16),
        shores=shores,
        hull_points=hulls[0],
        hull_faces=hulls[1],
        hull_sizes=hulls[2],
        hull_atoms=np.repeat(np.arange(len(parts)), [len(some) for some in parts]),
        body_points=whole_hulls[0],
        body_faces=whole_hulls[1],
        body_sizes=whole_hulls[2],
    )
    name = Path(surface.name).stem
    asset = BreakableAsset(name, chosen, surface.scale, surface.offset, CAP, options.crumb_floor, arrays, model, {})
    with stages("evaluation") as tick:
        test = evaluate_asset(asset, samples, options.evaluated, tick)
    asset.metadata.update(
        {
            "fracsim": version("fracsim"),
            "seed": seed,
            "options": asdict(options),
            "seconds": {**stages.seconds, "total": sum(stages.seconds.values())},
            "counts": {
                "vertices": len(surface.vertices),
                "cells": len(cells.volumes),
                "atoms": len(solid.volumes),
                "interfaces": len(pairs),
                "hulls": len(arrays.hull_sizes),
                "body_hulls": len(arrays.body_sizes),
            },
            "mode_energies": [history[-1] for history in modes.objectives],
            "training": figures,
            "test": test,
        }
    )
    return asset


class _Stages:
    """A progress bar and a clock for each stage."""

    def __init__(self, visible: bool) -> None:
        self.visible = visible
        self.seconds: dict[str, float] = {}

    def __call__(self, name: str) -> _Stage:
        return _Stage(self, name)


class _Stage:
    def __init__(self, stages: _Stages, name: str) -> None:
        self.stages, self.name = stages, name

    def __enter__(self) -> Callable[[float], None]:
        self.begin = time.perf_counter()
        self.bar = tqdm(
            total=100,
            desc=f"{self.name:<10}",
            disable=not self.stages.visible,
            bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}",
        )
        return self._tick

    def _tick(self, share: float) -> None:
        self.bar.update(round(100 * share) - self.bar.n)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._tick(1.0)
        self.bar.close()
        self.stages.seconds[self.name] = time.perf_counter() - self.begin


def evaluate_asset(
    asset: BreakableAsset, samples: Samples, most: int, progress: Callable[[float], None] = lambda _: None
) -> dict[str, float]:
    """Figures of the asset's default predictor on held-out impulses, beside the nearest training impulse.

    Of at most ``most`` test samples. ARI, acceptance and AMAE are means over the impulses that truly break;
    whether it breaks at all is scored apart, as balanced accuracy.
    """
    train, validation, test = (samples.part(k) for k in range(3))
    weights = _nearest_weights(train, validation, asset)
    nearest = _Nearest(train, asset, weights).labels(test)
    points = SurfacePoints(asset.vertices, asset.faces)
    unit = asset.mass * asset.material.breaking_velocity
    vertex_atom, pairs, distances = asset.arrays.vertex_atom, asset.arrays.pairs, asset.arrays.distances
    count = min(most, len(test))
    rows: list[tuple[float, ...]] = []
    broke = np.zeros((count, 3), dtype=bool)  # truly, predicted, nearest
    for k in range(count):
        there = np.flatnonzero(test.severities[k])
        where = points.at(test.faces[k, there], test.barycentric[k, there])
        blow = zip(where, test.directions[k, there], test.severities[k, there] * unit, strict=True)
        fracture = asset.fracture([Impulse(*values) for values in blow])
        broke[k] = test.labels[k].any(), fracture.broken, nearest[k].any()
        if broke[k, 0]:
            truth = test.labels[k][vertex_atom]
            parted = (test.labels[k][pairs[:, 0]] != test.labels[k][pairs[:, 1]]).astype(np.float64)
            truth_field = field_from_scores(parted, distances, asset.cap)
            rows.append(
                (
                    ari(truth, fracture.labels),
                    ari(truth, nearest[k][vertex_atom]),
                    amae(truth_field, fracture.udf / asset.scale),
                    ari(truth, asset.fracture_from_field(truth_field * asset.scale).labels),
                    float(sum(fracture.timings.values())),
                )
            )
        progress((k + 1) / count)
    table = np.array(rows)

    def balanced(column: int) -> float:
        right = broke[:, column] == broke[:, 0]
        return float(0.5 * (right[broke[:, 0]].mean() + right[~broke[:, 0]].mean()))

    return {
        "impulses": count,
        "breaking": len(rows),
        "ari": float(table[:, 0].mean()),
        "ari_nearest_impulse": float(table[:, 1].mean()),
        "ari_of_the_true_field": float(table[:, 3].mean()),
        "accepted": float((table[:, 0] >= ACCEPTED).mean()),
        "accepted_nearest_impulse": float((table[:, 1] >= ACCEPTED).mean()),
        "amae": float(table[:, 2].mean()),
        "balanced_accuracy": balanced(1),
        "balanced_accuracy_nearest_impulse": balanced(2),
        "ms_median": float(np.median(table[:, 4])),
        "ms_p99": float(np.quantile(table[:, 4], 0.99)),
    }


class _Nearest:
    """The baseline without learning: the fracture of the most similar training impulse.

    Impulses are compared by where they act and which way, both in the mean over contacts, and by the
    logarithm of their severity.
    """

    def __init__(self, train: Samples, asset: BreakableAsset, weights: tuple[float, float]) -> None:
        self.points = SurfacePoints(asset.arrays.points[: asset.vertex_count], asset.faces)
        self.weights = weights
        self.train = train
        self.tree = cKDTree(self.key(train))

    def key(self, samples: Samples) -> FloatArray:
        total = samples.severities.sum(axis=1, keepdims=True)
        share = (samples.severities / total)[:, :, None]
        where = self.points.at(samples.faces.ravel(), samples.barycentric.reshape(-1, 3))
        mean = (share * where.reshape(*samples.faces.shape, 3)).sum(axis=1)
        way = (share * samples.directions).sum(axis=1)
        return np.hstack([self.weights[0] * mean, way, self.weights[1] * np.log(total)])

    def labels(self, samples: Samples) -> IntArray:
        return self.train.labels[self.tree.query(self.key(samples))[1]]


def _nearest_weights(train: Samples, validation: Samples, asset: BreakableAsset) -> tuple[float, float]:
    """The baseline deserves its best: position and severity weights chosen on validation impulses."""
    rows = np.flatnonzero(validation.labels.any(axis=1))[:300]
    truth = validation.labels[rows][:, asset.arrays.vertex_atom]
    best, score = (1.0, 1.0), -np.inf
    for weights in itertools.product((2.0, 4.0, 8.0), (0.3, 0.7, 1.5)):
        guess = _Nearest(train, asset, weights).labels(validation)[rows][:, asset.arrays.vertex_atom]
        mean = float(np.mean([ari(a, b) for a, b in zip(truth, guess, strict=True)]))
        if mean > score:
            best, score = weights, mean
    return best
