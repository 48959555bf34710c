"""The segmentations that an evaluation tries on the predictions of a model. ``MeshBench`` uses it.

A segmenter takes the number of a prediction to labels of the vertices. Parameters that the thesis does not fix are
chosen on the validation split.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import metrics
from ..common.arrays import AnyFloatArray, Float32Array, IntArray
from ..data.samples import Samples
from ..learning.body import BodyGeometry
from ..learning.model import Predictor
from ..segmentation import METHODS, reference
from ..segmentation.graph import SurfaceGraph
from ..segmentation.midpoints import midpoint_segmentation
from ..simulators.base import merge_small_pieces_each
from .timing import one_by_one

# Candidates for the parameters chosen on validation impulses, in units of the largest extent.
HEIGHTS = (0.002, 0.005, 0.01, 0.014, 0.02, 0.03, 0.05, 0.08)  # of passes between atoms
SLACKS = (0.0, 0.01, 0.02, 0.04, 0.06, 0.08)  # of midpoint segmentation
THRESHOLDS = (0.02, 0.03, 0.05, 0.08, 0.12, 0.2)  # of the vertex watershed

# Names of the rows that are not in METHODS.
CHOSEN_WATERSHED = "watershed; threshold from validation"
MIDPOINTS = "midpoints and links"
ATOMS = "atoms"
LABELS = "none (labels predicted)"


@dataclass(frozen=True)
class Segmenter:
    """A segmentation of the predictions of one model.

    Attributes
    ----------
    labels : callable
        Takes the number of an impulse to its labels, ndarray of int64, shape (V,).
    parameter : float or None
        The parameter of the segmentation, if it has one.
    slow : bool
        Whether it is measured on few impulses only.
    predict_ms : list of float or None
        How long each prediction took, in milliseconds, if the segmentation needs another one than the field at the
        vertices.
    """

    labels: Callable[[int], IntArray]
    parameter: float | None = None
    slow: bool = False
    predict_ms: list[float] | None = None


class SegmentationBench:
    """The segmentations of one body.

    Parameters
    ----------
    body : BodyGeometry
        The body.

    Attributes
    ----------
    body : BodyGeometry
        The body.
    graph : SurfaceGraph
        Its surface without links, for the methods in METHODS.
    linked_graph : SurfaceGraph
        Its surface with links, for midpoint segmentation.
    """

    def __init__(self, body: BodyGeometry) -> None:
        self.body = body
        self.graph = SurfaceGraph.of(body.surface)
        self.linked_graph = SurfaceGraph.of(body.surface, body.links)

    def segmenters(
        self,
        model: Predictor | None,
        breaking: Samples,
        fields: Float32Array,
        validation: Samples,
        validation_fields: Float32Array,
    ) -> dict[str, Segmenter]:
        """Build every segmenter for the predictions of a model.

        Parameters
        ----------
        model : Predictor or None
            The model; None for the simulator itself, whose fields are exact.
        breaking : Samples
            N test impulses that break the body.
        fields : ndarray of float32, shape (N, V)
            What the model predicts for them.
        validation : Samples
            M impulses that parameters are chosen on.
        validation_fields : ndarray of float32, shape (M, V)
            What the model predicts for them.

        Returns
        -------
        dict of str to Segmenter
            By the names of the rows in tables.
        """
        result = {
            name: Segmenter(partial(self._at_vertices, name, fields, method.default), method.default, slow=True)
            for name, method in METHODS.items()
        }

        def best(candidates: tuple[float, ...], segment: Callable[[Float32Array, float], IntArray]) -> float:
            return self.best_parameter(validation, validation_fields, candidates, segment)

        threshold = best(THRESHOLDS, lambda udf, t: METHODS["watershed"](self.graph, udf.astype(np.float64), t))
        labels = partial(self._at_vertices, "watershed", fields, threshold)
        result[CHOSEN_WATERSHED] = Segmenter(labels, threshold, slow=True)
        if model is None:
            result[MIDPOINTS] = self._at_midpoints(self.body.fields(breaking.labels, nodes=True), 0.0)
        elif model.predict_nodes is not None:
            nodes, predict_ms = one_by_one(model.predict_nodes, breaking)
            validation_nodes, _ = one_by_one(model.predict_nodes, validation)
            slack = self.best_parameter(
                validation, validation_nodes, SLACKS, lambda udf, s: midpoint_segmentation(self.linked_graph, udf, s)
            )
            result[MIDPOINTS] = self._at_midpoints(nodes, slack, predict_ms)
        height = best(HEIGHTS, self.atom_watershed)
        result[ATOMS] = Segmenter(lambda k: self.atom_watershed(fields[k], height), height)
        if model is not None and model.predict_labels is not None:
            pieces, predict_ms = one_by_one(model.predict_labels, breaking)
            result[LABELS] = Segmenter(lambda k: pieces[k][self.body.vertex_atom], predict_ms=predict_ms)
        return result

    def atom_watershed(self, udf: AnyFloatArray, height: float) -> IntArray:
        """Segment a field at the vertices by the watershed over atoms, and merge small pieces.

        Parameters
        ----------
        udf : ndarray of float, shape (V,)
            The field, in units of the largest extent.
        height : float
            Height of a pass from which two atoms join, in the same units.

        Returns
        -------
        ndarray of int64, shape (V,)
            Piece of each vertex.
        """
        body = self.body
        labels = body.atom_watershed.labels(udf.astype(np.float64), height)
        merged = merge_small_pieces_each(
            labels[None], body.volumes, body.interfaces, body.atoms.min_piece_volume_fraction
        )[0]
        return merged[body.vertex_atom]

    def best_parameter(
        self,
        samples: Samples,
        fields: npt.NDArray[Any],
        candidates: tuple[float, ...],
        segment: Callable[[Any, float], IntArray],
    ) -> float:
        """Choose the parameter with the highest mean ARI.

        Parameters
        ----------
        samples : Samples
            N impulses.
        fields : ndarray, shape (N, ...)
            What a model predicts for them.
        candidates : tuple of float
            The parameters to choose from.
        segment : callable
            ``segment(field, parameter)`` returns labels (V,).

        Returns
        -------
        float
            One of the candidates.
        """
        truth = samples.labels[:, self.body.vertex_atom]

        def mean_ari(parameter: float) -> float:
            scores = [metrics.ari(y, segment(udf, parameter)) for y, udf in zip(truth, fields, strict=True)]
            return float(np.mean(scores))

        return max(candidates, key=mean_ari)

    def reference_ms(self, name: str, fields: Float32Array) -> list[float]:
        """Time the NetworkX reference of a method in METHODS, at its default parameter.

        Parameters
        ----------
        name : str
            A name in ``reference.REFERENCES``.
        fields : ndarray of float32, shape (N, V)
            The fields.

        Returns
        -------
        list of float
            How long each field took, in milliseconds.
        """
        times = []
        for field in fields:
            graph = reference.prepare(self.graph, field.astype(np.float64))
            begin = time.perf_counter()
            reference.REFERENCES[name](graph, METHODS[name].default)
            times.append((time.perf_counter() - begin) * 1e3)
        return times

    def _at_vertices(self, name: str, fields: Float32Array, parameter: float, k: int) -> IntArray:
        """Segment field k by a method in METHODS."""
        return METHODS[name](self.graph, fields[k].astype(np.float64), parameter)

    def _at_midpoints(self, nodes: npt.NDArray[Any], slack: float, predict_ms: list[float] | None = None) -> Segmenter:
        """Build midpoint segmentation of fields (N, V + E)."""
        return Segmenter(
            lambda k: midpoint_segmentation(self.linked_graph, nodes[k], slack), slack, predict_ms=predict_ms
        )
