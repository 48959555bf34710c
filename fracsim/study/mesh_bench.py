"""One mesh of an evaluation: models are trained on it and measured with every segmentation. ``evaluate`` uses it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .. import metrics
from ..common.arrays import Float32Array, IntArray
from ..common.progress import Stages
from ..data.samples import Samples
from ..learning import MODELS, model_class
from ..learning.model import Predictor, load_model, save_model
from ..learning.options import training_of
from ..learning.precomputed import PrecomputedModel
from ..learning.trainer import Run
from ..segmentation import METHODS, reference
from .plan import MeshPlan, ModelPlan, Plan, options_of
from .segmenters import ATOMS, LABELS, SegmentationBench, Segmenter
from .timing import one_by_one, time_summary
from .work_folder import dataset_of, model_stem, result_path, write_pictured

BINS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0)  # of severity divided by threshold
VALIDATED = 60  # validation impulses that parameters are chosen on; more hardly change the choice
PICTURED = 5  # impulses whose fields and pieces are kept for pictures

Row = dict[str, Any]


class MeshBench:
    """One mesh of a plan: its body, its samples, and the impulses that every model is measured on.

    Parameters
    ----------
    plan : Plan
        The plan.
    mesh : MeshPlan
        The mesh.
    work : Path
        The work folder; the dataset of the mesh is made there if it is missing.
    stage : Stages
        Where progress is shown.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    samples : Samples
        All samples.
    simulator : FractureSimulator
        The simulator that they come from.
    breaking : Samples
        Test impulses that break the body.
    mixed : Samples
        Test impulses as they were drawn, some of which do not break it.
    validation : Samples
        Validation impulses that break it.
    segmentations : SegmentationBench
        The segmentations of the body.
    """

    def __init__(self, plan: Plan, mesh: MeshPlan, work: Path, stage: Stages) -> None:
        self.plan, self.mesh, self.work, self.stage = plan, mesh, work, stage
        self.body, self.samples, self.simulator = dataset_of(plan, mesh, work, stage)
        test, validation = self.samples.of_split(2), self.samples.of_split(1)
        self.breaking = test.take(np.flatnonzero(test.labels.any(axis=1))[: mesh.tested])
        self.mixed = test.take(slice(mesh.tested))
        self.validation = validation.take(np.flatnonzero(validation.labels.any(axis=1))[:VALIDATED])
        self.segmentations = SegmentationBench(self.body)

    def measure(self, plan: ModelPlan) -> dict[str, Any]:
        """Train a model if there is none yet, and measure it with every segmentation.

        Parameters
        ----------
        plan : ModelPlan
            The model.

        Returns
        -------
        dict
            ``rows``, one for each segmentation, and ``fit``, the figures of the training; plain data. Fields and pieces
            for pictures are written to the work folder.
        """
        model, fit = self._model(plan)
        slow = plan.kind in MODELS and model_class(plan.kind).slow
        count = self.mesh.slow if slow else self.mesh.tested
        breaking, mixed, validation = (s.take(slice(count)) for s in (self.breaking, self.mixed, self.validation))
        progress = self.stage.ticker(f"{self.mesh.name}: {plan.name}, prediction")
        fields, predict_ms = self._predict(model, breaking, progress)
        validation_fields, _ = self._predict(model, validation)
        segmenters = self.segmentations.segmenters(model, breaking, fields, validation, validation_fields)
        errors, amae_each = self._errors(breaking, fields)
        rows, pictured = [], {}
        for name, segmenter in segmenters.items():
            labels, scores = self._segmented(plan, name, segmenter, breaking, count)
            row: Row = {
                "mesh": self.mesh.name,
                "vertices": len(self.body.vertices),
                "model": plan.name,
                "kind": plan.kind,
                "segmentation": name,
                "parameter": segmenter.parameter,
                "impulses": len(labels),
                **errors,
                **_summary(scores),
                "predict_ms": time_summary(predict_ms if segmenter.predict_ms is None else segmenter.predict_ms),
                "breaks": self._breaks(model, mixed, name, segmenter.parameter),
            }
            if name == "watershed":
                row["amae_and_bc"] = [[a, score["bc"]] for a, score in zip(amae_each, scores, strict=False)]
                row["validation"] = self._validated(validation, validation_fields)
            if name in reference.REFERENCES:
                row["reference_ms"] = time_summary(self.segmentations.reference_ms(name, fields[: self.mesh.timed]))
            rows.append(row)
            pictured[name] = np.array(labels[:PICTURED])
        path = result_path(self.plan, self.mesh, plan, self.work)
        true = self.body.fields(breaking.labels[:PICTURED])
        truth = breaking.labels[:PICTURED][:, self.body.vertex_atom]
        write_pictured(path, {"predicted": fields[:PICTURED], "true": true, **pictured, "labels": truth})
        return {"rows": rows, "fit": {"mesh": self.mesh.name, "model": plan.name, **fit}}

    def _segmented(
        self, plan: ModelPlan, name: str, segmenter: Segmenter, samples: Samples, count: int
    ) -> tuple[list[IntArray], list[dict[str, float]]]:
        """Segment the first predictions; returns labels, and scores with times."""
        progress = self.stage.ticker(f"{self.mesh.name}: {plan.name}, {name}")
        tried = min(self.mesh.slow if segmenter.slow else count, len(samples))
        labels: list[IntArray] = []
        scores = []
        for k in range(tried):
            begin = time.perf_counter()
            labels.append(segmenter.labels(k))
            spent = (time.perf_counter() - begin) * 1e3
            scores.append({"ms": spent, **self._scores(samples, k, labels[k])})
            progress((k + 1) / tried)
        return labels, scores

    def _validated(self, validation: Samples, fields: Float32Array) -> Row:
        """Measure the watershed on validation impulses."""
        graph, watershed = self.segmentations.graph, METHODS["watershed"]
        labels = [watershed(graph, udf.astype(np.float64)) for udf in fields]
        scores = [self._scores(validation, k, pieces) for k, pieces in enumerate(labels)]
        return {**self._errors(validation, fields)[0], **_summary(scores)}

    def _errors(self, samples: Samples, fields: Float32Array) -> tuple[dict[str, float], list[float]]:
        """Compute mean errors of fields, and the AMAE of each."""
        true = self.body.fields(samples.labels)
        amae = [metrics.amae(y, x) for y, x in zip(true, fields, strict=True)]
        return {"amae": float(np.mean(amae)), "mse": metrics.mse(true, fields)}, amae

    def _scores(self, samples: Samples, k: int, labels: IntArray) -> dict[str, float]:
        """Score the labels of one impulse."""
        truth = samples.labels[k][self.body.vertex_atom]
        return metrics.partition_scores(self.body.vertices, self.segmentations.graph.edges, truth, labels)

    def _model(self, plan: ModelPlan) -> tuple[Predictor | None, dict[str, Any]]:
        """Load a model, after training it if it is not there yet, and the figures of its training."""
        if plan.kind == "simulator":
            return None, {}
        if plan.kind == "precomputed":
            return PrecomputedModel.of(self.body, self.simulator), {}
        path = self.work / f"{model_stem(self.plan, self.mesh, plan)}.safetensors"
        if not path.is_file():
            self._train(plan, path)
        model, metadata = load_model(path, self.body)
        return model, metadata["figures"]

    def _train(self, plan: ModelPlan, path: Path) -> None:
        """Train a model and write it. A training that was interrupted goes on at its checkpoint."""
        kind = model_class(plan.kind)
        options = options_of(kind.options_type, plan)
        checkpoint = path.with_suffix(".checkpoint")
        run = Run(
            checkpoint=checkpoint if training_of(options) is not None else None,
            resume=True,
            label=path.stem,
            progress=self.stage.ticker(f"{self.mesh.name}: {plan.name}, training"),
        )
        begin = time.perf_counter()
        if plan.others:
            others = [mesh for mesh in self.plan.meshes if mesh.file != self.mesh.file and mesh.splits == 0]
            datasets = [dataset_of(self.plan, mesh, self.work, self.stage)[:2] for mesh in others]
            learned = [(body, _first(samples, plan.samples)) for body, samples in datasets]
            model, figures = kind.fit_many(learned, options, self.plan.seed, run)
            model = model.on(self.body)
        else:
            model, figures = kind.fit(self.body, _first(self.samples, plan.samples), options, self.plan.seed, run)
        figures = {**figures, "fit_seconds": time.perf_counter() - begin}
        save_model(model, path, {"figures": figures})
        checkpoint.unlink(missing_ok=True)

    def _predict(
        self, model: Predictor | None, samples: Samples, progress: Callable[[float], None] = lambda _: None
    ) -> tuple[Float32Array, list[float]]:
        """Predict fields (N, V), and the ms that each took; the simulator's own are exact and cost nothing."""
        if model is None:
            return self.body.fields(samples.labels), [0.0] * len(samples)
        return one_by_one(model.predict, samples, progress)

    def _breaks(
        self, model: Predictor | None, mixed: Samples, segmentation: str, parameter: float | None
    ) -> dict[str, Any] | None:
        """Measure whether an impulse breaks the body at all, for the segmentations made for that."""
        if segmentation == LABELS and model is not None and model.predict_labels is not None:
            labels = model.predict_labels(mixed.impacts)
        elif segmentation == ATOMS and parameter is not None:
            fields, _ = self._predict(model, mixed)
            labels = np.array([self.segmentations.atom_watershed(udf, parameter) for udf in fields])
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


def _first(samples: Samples, count: int | None) -> Samples:
    """Take the first samples of all splits, as if no more had been drawn."""
    return samples if count is None else samples.take(slice(count))


def _summary(scores: list[dict[str, float]]) -> Row:
    """Summarise scores, and their times where they have any."""
    column = {name: np.array([score[name] for score in scores]) for name in scores[0]}
    result: Row = {"segment_ms": time_summary(column["ms"].tolist())} if "ms" in column else {}
    for name in ("ari", "ami", "bc", "rc"):
        values = column[name][np.isfinite(column[name])]
        result[name] = float(values.mean()) if len(values) else None
        result[f"{name}_std"] = float(values.std()) if len(values) else None
    result["accepted"] = float((column["ari"] >= metrics.ACCEPTED).mean())
    return result
