"""TODO learning.asset_figures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..common.impulse import Impulse
from ..data.samples import Samples
from ..fracture.asset import BreakableAsset
from ..fracture.predictor import field_of_labels
from ..geometry.sampling import SurfacePoints
from ..metrics import ACCEPTED, amae, ari, balanced_accuracy
from .body import BodyGeometry
from .nearest import Nearest, NearestOptions


def evaluate_asset(
    asset: BreakableAsset,
    body: BodyGeometry,
    samples: Samples,
    most: int,
    progress: Callable[[float], None] = lambda _: None,
) -> dict[str, float]:
    """Figures of the asset's default predictor on held-out impulses, beside the nearest training impulse.

    Of at most ``most`` test samples. ARI, acceptance and AMAE are means over the impulses that truly break;
    whether it breaks at all is scored apart, as balanced accuracy.
    """
    test = samples.of_split(2)
    count = min(most, len(test))
    nearest = Nearest.fit(body, samples, NearestOptions(), 0)[0].predict_labels(test.take(slice(count)).impacts)
    points = SurfacePoints(asset.vertices, asset.faces)
    unit = asset.mass * asset.material.breaking_velocity
    vertex_atom, pairs, distances = asset.arrays.vertex_atom, asset.arrays.pairs, asset.arrays.distances
    rows: list[tuple[float, ...]] = []
    broke = np.zeros((count, 3), dtype=bool)  # truly, predicted, nearest
    for k in range(count):
        there = np.flatnonzero(test.severities[k])
        where = points.at(test.faces[k, there], test.barycentric[k, there])
        impact = zip(where, test.directions[k, there], test.severities[k, there] * unit, strict=True)
        # The gate is made from the truth; a model is judged by its own answers.
        fracture = asset.fracture([Impulse(*values) for values in impact], skip_weak=False)
        broke[k] = test.labels[k].any(), fracture.broken, nearest[k].any()
        if broke[k, 0]:
            truth = test.labels[k][vertex_atom]
            truth_field = field_of_labels(test.labels[k], pairs, distances, asset.cap)
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

    return {
        "impulses": count,
        "breaking": len(rows),
        "ari": float(table[:, 0].mean()),
        "ari_nearest_impulse": float(table[:, 1].mean()),
        "ari_of_the_true_field": float(table[:, 3].mean()),
        "accepted": float((table[:, 0] >= ACCEPTED).mean()),
        "accepted_nearest_impulse": float((table[:, 1] >= ACCEPTED).mean()),
        "amae": float(table[:, 2].mean()),
        "balanced_accuracy": balanced_accuracy(broke[:, 0], broke[:, 1]),
        "balanced_accuracy_nearest_impulse": balanced_accuracy(broke[:, 0], broke[:, 2]),
        "ms_median": float(np.median(table[:, 4])),
        "ms_p99": float(np.quantile(table[:, 4], 0.99)),
    }
