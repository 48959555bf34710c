"""Evaluation: every model, every segmentation and every mesh of a plan, measured side by side. Offline only.

A plan is a TOML file. What is measured of one model on one mesh is kept in the work folder as soon as it is there, so
an evaluation that was stopped goes on where it was, and several may share the folder, each with its own meshes.
"""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import metrics
from ..common.arrays import Float32Array, IntArray
from ..common.errors import ModelError
from ..common.files import write_beside
from ..common.progress import Stages
from ..data.dataset import Dataset
from ..data.samples import Samples
from ..data.writing import make_dataset
from ..learning import MODELS, model_class
from ..learning.body import BodyGeometry
from ..learning.model import Predictor, load_model, save_model
from ..learning.options import training_of
from ..learning.precomputed import PrecomputedModel
from ..learning.trainer import Run
from ..segmentation import METHODS, reference
from ..segmentation.graph import SurfaceGraph
from ..segmentation.midpoints import midpoint_segmentation
from ..simulators.base import FractureSimulator, Impacts, merge_small_pieces_each
from ..solids.surface import Surface, read_surface, refine, split_faces
from .plan import MeshPlan, ModelPlan, Plan, options_of

BINS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0)  # of severity over threshold
HEIGHTS = (0.002, 0.005, 0.01, 0.014, 0.02, 0.03, 0.05, 0.08)  # of passes between atoms, for validation to choose from
SLACKS = (0.0, 0.01, 0.02, 0.04, 0.06, 0.08)  # of the passes over midpoints, likewise
THRESHOLDS = (0.02, 0.03, 0.05, 0.08, 0.12, 0.2)  # of the vertex watershed, likewise
JUDGES = 60  # validation impulses that choose
SHOWN = 5  # impulses that are kept for pictures


def evaluate(
    plan: Plan, work: Path, only: tuple[str, ...] = (), progress: bool = False, again: bool = False
) -> dict[str, Any]:
    """Measure what is not measured yet, and gather all that the plan has measured so far.

    work: a folder for datasets, models and finished measurements. only: names of meshes, or all of them. again:
    whether to measure anew what is there, with the models that are there. Returns the rows and the plan, as plain data.
    """
    work.mkdir(parents=True, exist_ok=True)
    for name in only:
        if name not in [mesh.name for mesh in plan.meshes]:
            raise ModelError(f"the plan has no mesh {name!r}")
    for mesh in plan.meshes:
        if only and mesh.name not in only:
            continue
        missing = [m for m in _tried(plan, mesh) if again or not _result(plan, mesh, m, work).is_file()]
        if missing:
            with Stages(progress) as stage:
                bench = Bench(plan, mesh, work, stage)
                for model in missing:
                    found = bench.measure(model)
                    write_beside(_result(plan, mesh, model, work), (json.dumps(found, indent=1) + "\n").encode())
    rows, fits, missing_rows = [], [], []
    for mesh in plan.meshes:
        for model in _tried(plan, mesh):
            path = _result(plan, mesh, model, work)
            if path.is_file():
                found = json.loads(path.read_text())
                rows += found["rows"]
                fits.append(found["fit"])
            else:
                missing_rows.append(f"{model.name} on {mesh.name}")
    return {"rows": rows, "fits": fits, "missing": missing_rows, "plan": _plain(plan)}


def _tried(plan: Plan, mesh: MeshPlan) -> Iterator[ModelPlan]:
    return (model for model in plan.models if not model.meshes or mesh.name in model.meshes)


def _plain(plan: Plan) -> dict[str, Any]:
    told = asdict(plan)
    for mesh in told["meshes"]:
        mesh["file"] = Path(mesh["file"]).name
    told["studies"] = [Path(study).parent.name for study in told["studies"]]
    return told


def _stem(plan: Plan, mesh: MeshPlan, model: ModelPlan) -> str:
    """A file name that changes with whatever the model's weights depend on."""
    told = {name: value for name, value in asdict(model).items() if name != "meshes"}
    learned: dict[str, Any] = {"mesh": (mesh.name, mesh.splits, mesh.samples), "model": told, "seed": plan.seed}
    learned["simulator"] = asdict(plan.simulator)
    if model.others:
        learned["all"] = [(m.name, m.splits, m.samples) for m in plan.meshes]
    digest = hashlib.sha256(json.dumps(learned, sort_keys=True).encode()).hexdigest()[:12]
    return f"{mesh.name}-{model.kind}-{digest}"


def _result(plan: Plan, mesh: MeshPlan, model: ModelPlan, work: Path) -> Path:
    return work / f"{_stem(plan, mesh, model)}-{mesh.tested}-{mesh.slow}-{mesh.timed}.json"


@dataclass(frozen=True)
class Cut:
    """A segmentation: the row of a prediction to the labels of the vertices. parameter: its own. slow: whether it is
    tried on few impulses. predicted: the prediction's times, where they are not those of the field at the vertices.
    """

    labels: Callable[[int], IntArray]
    parameter: float | None = None
    slow: bool = False
    predicted: list[float] | None = None


class Bench:
    """One mesh: its body, its samples, and the held-out impulses that every row is judged on."""

    def __init__(self, plan: Plan, mesh: MeshPlan, work: Path, stage: Stages) -> None:
        self.plan, self.mesh, self.work, self.stage = plan, mesh, work, stage
        self.body, self.samples, self.simulator = dataset_of(plan, mesh, work, stage)
        test = self.samples.of_split(2)
        parts = test.labels.any(axis=1)
        self.breaking = test.take(np.flatnonzero(parts)[: mesh.tested])
        self.mixed = test.take(slice(mesh.tested))  # as they come, to be judged on whether they part it at all
        validation = self.samples.of_split(1)
        self.judges = validation.take(np.flatnonzero(validation.labels.any(axis=1))[:JUDGES])
        self.graph = SurfaceGraph.of(self.body.surface)
        self.linked = SurfaceGraph.of(self.body.surface, self.body.links)

    def measure(self, plan: ModelPlan) -> dict[str, Any]:
        """Train one model, where there is none of it yet, and judge it with every segmentation."""
        model, fit = self._model(plan)
        few = self.mesh.slow if plan.kind in MODELS and model_class(plan.kind).slow else self.mesh.tested
        breaking, mixed, judges = (s.take(slice(few)) for s in (self.breaking, self.mixed, self.judges))
        tick = self.stage.ticker(f"{self.mesh.name}: {plan.name}, prediction")
        fields, spent = self._predict(model, breaking, tick)
        held_out, _ = self._predict(model, judges)
        errors, per_impulse = self._errors(breaking, fields)
        rows, shown = [], {}
        for name, cut in self._segmenters(model, fields, held_out, breaking, judges).items():
            tick = self.stage.ticker(f"{self.mesh.name}: {plan.name}, {name}")
            tried = min(self.mesh.slow if cut.slow else few, len(breaking))
            found, labels = [], []
            for k in range(tried):
                begin = time.perf_counter()
                labels.append(cut.labels(k))
                found.append({"ms": (time.perf_counter() - begin) * 1e3, **self._scores(breaking, k, labels[k])})
                tick((k + 1) / tried)
            row: dict[str, Any] = {
                "mesh": self.mesh.name,
                "vertices": len(self.body.vertices),
                "model": plan.name,
                "kind": plan.kind,
                "segmentation": name,
                "parameter": cut.parameter,
                "impulses": tried,
                **errors,
                **_summary(found),
                "predict_ms": _times(spent if cut.predicted is None else cut.predicted),
                "breaks": self._breaks(model, mixed, name, cut.parameter),
            }
            if name == "watershed":
                row["amae_and_bc"] = [[a, f["bc"]] for a, f in zip(per_impulse, found, strict=False)]
                judged = [METHODS[name](self.graph, u.astype(np.float64)) for u in held_out]
                scores = [self._scores(judges, k, cut_up) for k, cut_up in enumerate(judged)]
                row["validation"] = {**self._errors(judges, held_out)[0], **_summary(scores)}
            if name in reference.REFERENCES:
                row["reference_ms"] = _times(self._reference(name, fields))
            rows.append(row)
            shown[name] = np.array(labels[:SHOWN])
        kept: dict[str, Any] = {"predicted": fields[:SHOWN], "true": self.body.fields(breaking.labels[:SHOWN]), **shown}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **kept, labels=self._truth(breaking)[:SHOWN])
        write_beside(_result(self.plan, self.mesh, plan, self.work).with_suffix(".npz"), buffer.getvalue())
        return {"rows": rows, "fit": {"mesh": self.mesh.name, "model": plan.name, **fit}}

    def _truth(self, samples: Samples) -> IntArray:
        return samples.labels[:, self.body.vertex_atom]

    def _errors(self, samples: Samples, fields: Float32Array) -> tuple[dict[str, float], list[float]]:
        true = self.body.fields(samples.labels)
        amae = [metrics.amae(y, x) for y, x in zip(true, fields, strict=True)]
        return {"amae": float(np.mean(amae)), "mse": metrics.mse(true, fields)}, amae

    def _scores(self, samples: Samples, k: int, labels: IntArray) -> dict[str, float]:
        truth = samples.labels[k][self.body.vertex_atom]
        return metrics.partition_scores(self.body.vertices, self.graph.edges, truth, labels)

    # Models

    def _model(self, plan: ModelPlan) -> tuple[Predictor | None, dict[str, Any]]:
        if plan.kind == "simulator":
            return None, {}
        if plan.kind == "precomputed":
            return PrecomputedModel.of(self.body, self.simulator), {}
        stem = _stem(self.plan, self.mesh, plan)
        path, checkpoint = self.work / f"{stem}.safetensors", self.work / f"{stem}.checkpoint"
        if not path.is_file():
            tick = self.stage.ticker(f"{self.mesh.name}: {plan.name}, training")
            kind = model_class(plan.kind)
            options = options_of(kind.options_type, plan)
            run = Run(
                checkpoint=checkpoint if training_of(options) is not None else None,
                resume=True,
                label=stem,
                progress=tick,
            )
            begin = time.perf_counter()
            if plan.others:
                others = [m for m in self.plan.meshes if m.file != self.mesh.file and m.splits == 0]
                bodies = [dataset_of(self.plan, mesh, self.work, self.stage)[:2] for mesh in others]
                learned = [(body, _first(samples, plan.samples)) for body, samples in bodies]
                model, figures = kind.fit_many(learned, options, self.plan.seed, run)
                model = model.on(self.body)
            else:
                model, figures = kind.fit(self.body, _first(self.samples, plan.samples), options, self.plan.seed, run)
            figures = {**figures, "fit_seconds": time.perf_counter() - begin}
            save_model(model, path, {"figures": figures})
            checkpoint.unlink(missing_ok=True)
        model, told = load_model(path, self.body)
        return model, told["figures"]

    def _predict(
        self, model: Predictor | None, samples: Samples, tick: Callable[[float], None] = lambda _: None
    ) -> tuple[Float32Array, list[float]]:
        """Fields (N, V), and the ms that each took, one impulse after the other as a simulation would ask."""
        if model is None:  # the simulator itself
            return self.body.fields(samples.labels), [0.0] * len(samples)
        return _one_by_one(model.predict, samples, tick)

    # Segmentations

    def _segmenters(
        self,
        model: Predictor | None,
        fields: Float32Array,
        held_out: Float32Array,
        breaking: Samples,
        judges: Samples,
    ) -> dict[str, Cut]:
        """Every segmentation of the fields; some ask the model for something else than those."""
        result = {n: Cut(partial(self._vertex_cut, n, fields, m.default), m.default, True) for n, m in METHODS.items()}
        threshold = self._chosen(
            judges, held_out, THRESHOLDS, lambda u, t: METHODS["watershed"](self.graph, u.astype(np.float64), t)
        )
        name = "watershed; threshold from validation"
        result[name] = Cut(partial(self._vertex_cut, "watershed", fields, threshold), threshold, True)
        if model is None:
            result["midpoints and links"] = self._passes_cut(self.body.fields(breaking.labels, nodes=True), 0.0)
        elif model.predict_nodes is not None:
            nodes, spent = _one_by_one(model.predict_nodes, breaking)
            seen = _one_by_one(model.predict_nodes, judges)[0]
            slack = self._chosen(judges, seen, SLACKS, lambda u, t: midpoint_segmentation(self.linked, u, t))
            result["midpoints and links"] = self._passes_cut(nodes, slack, spent)
        height = self._chosen(judges, held_out, HEIGHTS, self._atoms_cut)
        result["atoms"] = Cut(lambda k: self._atoms_cut(fields[k], height), height)
        if model is not None and model.predict_labels is not None:
            pieces, took = _one_by_one(model.predict_labels, breaking)
            result["none: labels"] = Cut(lambda k: pieces[k][self.body.vertex_atom], predicted=took)
        return result

    def _passes_cut(self, nodes: Float32Array, slack: float, spent: list[float] | None = None) -> Cut:
        return Cut(lambda k: midpoint_segmentation(self.linked, nodes[k], slack), slack, predicted=spent)

    def _vertex_cut(self, name: str, fields: Float32Array, parameter: float, k: int) -> IntArray:
        return METHODS[name](self.graph, fields[k].astype(np.float64), parameter)

    def _atoms_cut(self, udf: Float32Array, height: float) -> IntArray:
        body = self.body
        labels = body.basins.labels(udf.astype(np.float64), height)
        whole = merge_small_pieces_each(
            labels[None], body.volumes, body.interfaces, body.atoms.min_piece_volume_fraction
        )[0]
        return whole[body.vertex_atom]

    def _chosen(
        self,
        judges: Samples,
        fields: Float32Array,
        options: tuple[float, ...],
        cut: Callable[[Float32Array, float], IntArray],
    ) -> float:
        """The parameter with the best mean ARI on validation impulses."""
        truth = self._truth(judges)

        def score(option: float) -> float:
            return float(np.mean([metrics.ari(y, cut(u, option)) for y, u in zip(truth, fields, strict=True)]))

        return max(options, key=score)

    def _reference(self, name: str, fields: Float32Array) -> list[float]:
        spent = []
        for k in range(min(self.mesh.timed, len(fields))):
            udf = fields[k].astype(np.float64)
            graph = reference.prepare(self.graph, udf)
            begin = time.perf_counter()
            reference.REFERENCES[name](graph, METHODS[name].default)
            spent.append((time.perf_counter() - begin) * 1e3)
        return spent

    def _breaks(
        self, model: Predictor | None, mixed: Samples, segmentation: str, parameter: float | None
    ) -> dict[str, Any] | None:
        """Whether impulses as they come part the body at all, for the segmentations made for it."""
        if segmentation == "none: labels" and model is not None and model.predict_labels is not None:
            labels = model.predict_labels(mixed.impacts)
        elif segmentation == "atoms" and parameter is not None:
            fields, _ = self._predict(model, mixed)
            labels = np.array([self._atoms_cut(udf, parameter) for udf in fields])
        else:
            return None
        broken, truly = (labels != labels[:, :1]).any(axis=1), mixed.labels.any(axis=1)
        curve = metrics.break_curve(mixed.ratio, broken, BINS)
        return {
            "impulses": len(broken),
            "balanced_accuracy": metrics.balanced_accuracy(truly, broken),
            "bins": list(BINS),
            "curve": [None if np.isnan(share) else float(share) for share in curve],
        }


def surface_of(mesh: MeshPlan) -> Surface:
    surface = refine(read_surface(mesh.file))
    for _ in range(mesh.splits):
        surface = split_faces(surface)
    return surface


def kept_of(plan: Plan, mesh: MeshPlan, model: ModelPlan, work: Path) -> dict[str, npt.NDArray[Any]] | None:
    """Fields and pieces of the first impulses, as measuring kept them, or None where that was not done."""
    path = _result(plan, mesh, model, work).with_suffix(".npz")
    if not path.is_file():
        return None
    with np.load(path) as kept:
        return {name: kept[name] for name in kept.files}


def dataset_of(
    plan: Plan, mesh: MeshPlan, work: Path, stage: Stages
) -> tuple[BodyGeometry, Samples, FractureSimulator]:
    """The body and samples of a mesh, made if they are not there yet."""
    told = json.dumps([asdict(plan.simulator), mesh.splits, plan.seed], sort_keys=True)
    path = work / f"{mesh.name}-{hashlib.sha256(told.encode()).hexdigest()[:12]}.h5"
    stage(f"{mesh.name}: samples")
    if not (path.is_file() and _holds(path, mesh.samples)):  # or another worker may be reading what it made
        make_dataset(path, surface_of(mesh), mesh.samples, plan.seed, plan.simulator)
    with Dataset(path) as dataset:
        body, samples = BodyGeometry.read(dataset, stage.ticker(f"{mesh.name}: distances"))
        simulator = dataset.simulator
    assert simulator is not None  # Body.read has refused a dataset without one
    return body, samples.take(slice(mesh.samples)), simulator


def _holds(path: Path, count: int) -> bool:
    with Dataset(path) as dataset:
        return len(dataset) >= count


def _first(samples: Samples, count: int | None) -> Samples:
    """As if only so many had been drawn; the test rows among them are of no use to training."""
    return samples if count is None else samples.take(slice(count))


def _one_by_one(
    predict: Callable[[Impacts], Any], samples: Samples, tick: Callable[[float], None] = lambda _: None
) -> tuple[npt.NDArray[Any], list[float]]:
    """What a model says of each impulse, and the ms each took, asked for one after the other as a simulation would."""
    answers, spent = [], []
    for k in range(len(samples)):
        impact = samples.take(slice(k, k + 1)).impacts
        begin = time.perf_counter()
        answers.append(predict(impact)[0])
        spent.append((time.perf_counter() - begin) * 1e3)
        tick((k + 1) / len(samples))
    return np.array(answers), spent


def _summary(found: list[dict[str, float]]) -> dict[str, Any]:
    column = {name: np.array([row[name] for row in found]) for name in found[0]}
    result: dict[str, Any] = {"segment_ms": _times(column["ms"].tolist())} if "ms" in column else {}
    for name in ("ari", "ami", "bc", "rc"):
        values = column[name][np.isfinite(column[name])]
        result[name] = float(values.mean()) if len(values) else None
        result[f"{name}_std"] = float(values.std()) if len(values) else None
    result["accepted"] = float((column["ari"] >= metrics.ACCEPTED).mean())
    return result


def _times(spent: list[float]) -> dict[str, float]:
    return {
        "median": float(np.median(spent)),
        "mean": float(np.mean(spent)),
        "std": float(np.std(spent)),
        "p99": float(np.quantile(spent, 0.99)),
    }
