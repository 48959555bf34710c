"""How good an asset's model is on test impulses it never saw. Baking writes these figures into the asset's metadata."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..data.samples import TEST_SPLIT, Samples
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
    max_impulses: int,
    progress: Callable[[float], None] = lambda _: None,
) -> dict[str, float]:
    """Measure an asset's default predictor on test impulses, beside what the nearest training impulse did.

    ARI, acceptance and AMAE are means over the impulses that break the body in truth. Whether an impulse breaks it at
    all is scored apart, as balanced accuracy.

    Parameters
    ----------
    asset : BreakableAsset
        The asset.
    body : BodyGeometry
        Its body.
    samples : Samples
        Its fractures; the nearest impulse is sought in the training split.
    max_impulses : int
        How many of the test split are looked at.
    progress : callable
        Called with the share that is done.

    Returns
    -------
    dict of str to float
        The figures. ``ari_of_the_true_field`` is what the segmentation makes of exact fields; ``ms_median`` and
        ``ms_p99`` are times of a query in ms.
    """
    test = samples.of_split(TEST_SPLIT)
    count = min(max_impulses, len(test))
    nearest = Nearest.fit(body, samples, NearestOptions(), 0)[0].predict_labels(test.take(slice(count)).impacts)
    points = SurfacePoints(asset.vertices, asset.faces)
    vertex_atom, pairs, distances = asset.arrays.vertex_atom, asset.arrays.pairs, asset.arrays.distances
    rows: list[tuple[float, ...]] = []
    broke = np.zeros((count, 3), dtype=bool)  # in truth, by the asset, by the nearest impulse
    for k in range(count):
        active = np.flatnonzero(test.severities[k])
        contacts = zip(
            test.severities[k, active].tolist(),
            points.at(test.faces[k, active], test.barycentric[k, active]),
            test.directions[k, active],
            strict=True,
        )
        # What skips weak impulses follows from the simulator; a model is judged by its own answers.
        fracture = asset.fracture([asset.impulse_of(*contact) for contact in contacts], skip_weak=False)
        broke[k] = test.labels[k].any(), fracture.broken, nearest[k].any()
        if broke[k, 0]:
            truth = test.labels[k][vertex_atom]
            true_field = field_of_labels(test.labels[k], pairs, distances, asset.cap)
            rows.append(
                (
                    ari(truth, fracture.labels),
                    ari(truth, nearest[k][vertex_atom]),
                    amae(true_field, fracture.udf / asset.scale),
                    ari(truth, asset.fracture_from_field(true_field * asset.scale).labels),
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
