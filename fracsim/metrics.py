"""How good a predicted field or partition is: the thesis's measures, section 4.7."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from .common.arrays import FloatArray, IntArray
from .common.errors import FieldError, MissingExtraError

ALPHA = 10.0  # of AMAE, for fields in units of the largest extent
ACCEPTED = 0.7
CHUNK = 256  # groups whose distances are bounded together


def mse(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Mean squared error of a field."""
    y, x = _fields(truth, predicted)
    return float(np.mean((y - x) ** 2))


def amae(truth: npt.ArrayLike, predicted: npt.ArrayLike, alpha: float = ALPHA) -> float:
    """Adapted mean absolute error, |y - ŷ| / (1 + α|y|) in the mean over vertices (thesis, Eq. 4.5)."""
    y, x = _fields(truth, predicted)
    return float(np.mean(np.abs(y - x) / (1 + alpha * np.abs(y))))


def ari(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Adjusted Rand index of two labellings: 1 for the same partition, 0 for chance (Hubert and Arabie 1985).

    As scikit-learn's, without its checks, which take far longer than the sum itself; bakes ask thousands.
    """
    y, x = (np.unique(labels, return_inverse=True)[1] for labels in _labels(truth, predicted))
    both = np.unique(y * (int(x.max()) + 1) + x, return_counts=True)[1]
    together, one, other = ((n * (n - 1.0)).sum() for n in (both, np.bincount(y), np.bincount(x)))
    chance = one * other / max(len(y) * (len(y) - 1.0), 1.0)
    most = (one + other) / 2
    return 1.0 if most == chance else float((together - chance) / (most - chance))


def ami(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Adjusted mutual information of two labellings: 1 for the same partition, 0 for chance (thesis, Eq. 4.12)."""
    try:
        from sklearn.metrics import adjusted_mutual_info_score
    except ImportError as error:
        raise MissingExtraError("scikit-learn", "bake") from error
    return float(adjusted_mutual_info_score(*_labels(truth, predicted)))


def accepted(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> bool:
    """Whether a segmentation is good enough for real-time use: ARI of at least 0.7 (thesis, section 5.1.4)."""
    return ari(truth, predicted) >= ACCEPTED


def boundary_vertices(labels: npt.ArrayLike, edges: npt.ArrayLike) -> IntArray:
    """Vertices with a neighbour of another label (thesis, Eq. 4.2); labels (V,), edges (E, 2)."""
    label, ends = np.asarray(labels), np.asarray(edges)
    if label.ndim != 1 or ends.ndim != 2 or ends.shape[1] != 2:
        raise FieldError(f"labels must be (V,) and edges (E, 2), got {label.shape} and {ends.shape}")
    if ends.size and (ends.dtype.kind not in "iu" or ends.min() < 0 or ends.max() >= len(label)):
        raise FieldError(f"edges must be whole numbers from 0 to {len(label) - 1}, one for each label")
    ends = ends.astype(np.int64)
    return np.unique(ends[label[ends[:, 0]] != label[ends[:, 1]]])


def chamfer(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Half the mean distance from the points a (n, 3) to the nearest of b (m, 3), plus half that from b to a (thesis,
    Eqs. 4.7 and 4.8)."""
    points, others = _points(a), _points(b)
    if not len(points) or not len(others):
        raise FieldError("the Chamfer distance of no points is not defined; give at least one on either side")
    there, back = cKDTree(others).query(points)[0], cKDTree(points).query(others)[0]
    return float(there.mean() / 2 + back.mean() / 2)


def boundary_chamfer(
    vertices: npt.ArrayLike, edges: npt.ArrayLike, truth: npt.ArrayLike, predicted: npt.ArrayLike
) -> float:
    """Chamfer distance between the boundary vertices of two labellings, in the units of vertices (V, 3).

    The thesis does not say what it is where there is no boundary: here, 0 where neither has one, and the body's
    largest extent where one has and the other has not, so that a missed fracture counts.
    """
    points = _points(vertices)
    found = [points[boundary_vertices(labels, edges)] for labels in _labels(truth, predicted, len(points))]
    if not len(found[0]) or not len(found[1]):
        return 0.0 if len(found[0]) == len(found[1]) else float(np.ptp(points, axis=0).max())
    return chamfer(*found)


def region_chamfer(vertices: npt.ArrayLike, truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """The sum, over the true pieces, of the Chamfer distance to the predicted piece that is nearest by it (thesis,
    Eqs. 4.9 and 4.10), in the units of vertices (V, 3).

    Exact, but not every pair is worked out: a segmentation may leave thousands of crumbs, and of most of them their
    distance from the true piece already says that they are not the nearest.
    """
    points = _points(vertices)
    true, guess = (np.unique(labels, return_inverse=True)[1] for labels in _labels(truth, predicted, len(points)))
    sizes = np.bincount(guess)
    groups = np.split(points[np.argsort(guess, kind="stable")], np.cumsum(sizes)[:-1])
    centres = np.stack([np.bincount(guess, points[:, k]) for k in range(3)], axis=1) / sizes[:, None]
    radii = np.zeros(len(sizes))
    np.maximum.at(radii, guess, np.linalg.norm(points - centres[guess], axis=1))
    trees: dict[int, cKDTree] = {}

    def ahead(own: FloatArray, k: int) -> float:
        if k not in trees:
            trees[k] = cKDTree(groups[k])
        return float(trees[k].query(own)[0].mean())

    total = 0.0
    for piece in range(int(true.max()) + 1):
        own = points[true == piece]
        back = np.bincount(guess, cKDTree(own).query(points)[0]) / sizes
        # The one that shares most vertices is seldom far from the nearest, and rules out most of the others.
        first = int(np.bincount(guess[true == piece], minlength=len(sizes)).argmax())
        best = (ahead(own, first) + back[first]) / 2
        left = np.flatnonzero(back < 2 * best)
        left = left[left != first]
        # No point of a group is nearer than its centre, less its radius.
        floors = [
            np.maximum(cdist(own, centres[chunk]) - radii[chunk], 0.0).mean(axis=0)
            for chunk in np.split(left, range(CHUNK, len(left), CHUNK))
        ]
        bound = (np.concatenate(floors) + back[left]) / 2
        for at in np.argsort(bound, kind="stable"):
            if bound[at] >= best:
                break
            best = min(best, (ahead(own, int(left[at])) + back[left[at]]) / 2)
        total += best
    return float(total)


def partition_scores(
    vertices: npt.ArrayLike, edges: npt.ArrayLike, truth: npt.ArrayLike, predicted: npt.ArrayLike
) -> dict[str, float]:
    """All the thesis's measures of a segmentation (section 4.7.2): ari, ami, bc and rc."""
    return {
        "ari": ari(truth, predicted),
        "ami": ami(truth, predicted),
        "bc": boundary_chamfer(vertices, edges, truth, predicted),
        "rc": region_chamfer(vertices, truth, predicted),
    }


def balanced_accuracy(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """The mean of how often what breaks is said to break, and what does not is not; of booleans (N,).

    nan where the truth has one kind only.
    """
    y, x = np.asarray(truth), np.asarray(predicted)
    if y.shape != x.shape or y.dtype != bool or x.dtype != bool:
        raise FieldError(f"two lists of booleans of one length are needed, got {y.shape} and {x.shape}")
    if y.all() or not y.any():
        return float("nan")
    return float(((x == y)[y].mean() + (x == y)[~y].mean()) / 2)


def break_curve(ratio: npt.ArrayLike, predicted: npt.ArrayLike, bins: npt.ArrayLike) -> FloatArray:
    """(B - 1,) the share of impulses that are said to break the body, by severity over threshold; nan in an empty bin.

    ratio: (N,). predicted: (N,) booleans. bins: (B,) rising edges. The truth is a step from 0 to 1 at ratio 1.
    """
    where, broken, edges = np.asarray(ratio, dtype=float), np.asarray(predicted), np.asarray(bins, dtype=float)
    if where.ndim != 1 or where.shape != broken.shape or broken.dtype != bool:
        raise FieldError(f"ratio and booleans of one length are needed, got {where.shape} and {broken.shape}")
    if not np.isfinite(where).all():
        raise FieldError("ratios must be finite")
    if edges.ndim != 1 or len(edges) < 2 or not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
        raise FieldError("bins must be at least two finite edges that rise")
    counts, hits = np.histogram(where, edges)[0], np.histogram(where[broken], edges)[0]
    return np.asarray(np.divide(hits, counts, out=np.full(len(counts), np.nan), where=counts > 0))


def _fields(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    y, x = np.asarray(truth, dtype=np.float64), np.asarray(predicted, dtype=np.float64)
    if y.shape != x.shape or not y.size:
        raise FieldError(f"fields to compare must have one shape and not be empty, got {y.shape} and {x.shape}")
    if not (np.isfinite(y).all() and np.isfinite(x).all()):
        raise FieldError("fields to compare must be finite")
    return y, x


def _labels(truth: npt.ArrayLike, predicted: npt.ArrayLike, count: int | None = None) -> tuple[IntArray, IntArray]:
    y, x = np.asarray(truth), np.asarray(predicted)
    if y.ndim != 1 or y.shape != x.shape or not y.size:
        raise FieldError(f"labels to compare must be of one length and not be empty, got {y.shape} and {x.shape}")
    if y.dtype.kind not in "biu" or x.dtype.kind not in "biu":
        raise FieldError(f"labels must be whole numbers, got {y.dtype} and {x.dtype}")
    if count is not None and len(y) != count:
        raise FieldError(f"there must be a label for each of {count} vertices, got {len(y)}")
    return y, x


def _points(values: npt.ArrayLike) -> FloatArray:
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise FieldError(f"points must be finite and have shape (n, 3), got {points.shape}")
    return points
