"""How good a predicted field or segmentation is: the measures of the thesis, section 4.7.

It imports numpy and scipy only, and scikit-learn when ``ami`` is called; the offline rooms may use it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from .common.arrays import FloatArray, IntArray
from .common.errors import FieldError, MissingExtraError

ALPHA = 10.0  # of AMAE, per largest extent (thesis, Eq. 4.5)
ACCEPTED = 0.7  # the ARI from which a segmentation is good enough (thesis, section 5.1.4)
CHUNK = 256  # pieces whose distances are bounded at once, which limits memory


def mse(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Compute the mean squared error of a field (thesis, section 4.7.1).

    Parameters
    ----------
    truth, predicted : array_like of float, the same shape
        The true and the predicted field, in units of the largest extent.

    Returns
    -------
    float
        The mean of (truth - predicted)², in squared units of the largest extent.

    Raises
    ------
    FieldError
        If the fields differ in shape, are empty, or hold values that are not finite.
    """
    y, x = _fields(truth, predicted)
    return float(np.mean((y - x) ** 2))


def amae(truth: npt.ArrayLike, predicted: npt.ArrayLike, alpha: float = ALPHA) -> float:
    """Compute the adapted mean absolute error of a field (thesis, Eq. 4.5).

    Parameters
    ----------
    truth, predicted : array_like of float, the same shape
        The true and the predicted field, in units of the largest extent.
    alpha : float
        How much less an error counts far from the cracks.

    Returns
    -------
    float
        The mean of |y - ŷ| / (1 + alpha |y|) over the vertices, where y is the truth and ŷ the prediction.

    Raises
    ------
    FieldError
        If the fields differ in shape, are empty, or hold values that are not finite.
    """
    y, x = _fields(truth, predicted)
    return float(np.mean(np.abs(y - x) / (1 + alpha * np.abs(y))))


def ari(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Compute the adjusted Rand index of two labellings (Hubert and Arabie 1985; thesis, section 4.7.2).

    It gives the same value as scikit-learn, without its checks, which take far longer than the sum itself. A bake calls
    this thousands of times.

    Parameters
    ----------
    truth, predicted : array_like of int, shape (V,)
        The true and the predicted label of each vertex. Only which vertices share a label matters.

    Returns
    -------
    float
        1 for the same partition, about 0 for labels drawn by chance.

    Raises
    ------
    FieldError
        If the labels differ in number, are none, or are not whole numbers.

    Examples
    --------
    >>> from fracsim import metrics
    >>> metrics.ari([0, 0, 1, 1], [7, 7, 3, 3])
    1.0
    """
    y, x = (np.unique(labels, return_inverse=True)[1] for labels in _labels(truth, predicted))
    both = np.unique(y * (int(x.max()) + 1) + x, return_counts=True)[1]
    # Ordered pairs of vertices that share a label: in both labellings, in the true one, in the predicted one.
    shared, in_truth, in_predicted = ((n * (n - 1.0)).sum() for n in (both, np.bincount(y), np.bincount(x)))
    chance = in_truth * in_predicted / max(len(y) * (len(y) - 1.0), 1.0)
    maximum = (in_truth + in_predicted) / 2
    return 1.0 if maximum == chance else float((shared - chance) / (maximum - chance))


def volume_ari(truth: npt.ArrayLike, predicted: npt.ArrayLike, volumes: npt.ArrayLike) -> float:
    """Compute the adjusted Rand index of two divisions of a solid, each part of it counted by its volume.

    Vertices see the skin of a body only; two pieces that meet on a short crack line may share a large cut inside.

    Parameters
    ----------
    truth, predicted : array_like of int, shape (C,)
        The true and the predicted piece of each cell. Only which cells share a piece matters.
    volumes : array_like of float, shape (C,)
        Of the cells, in any unit; at least 0, and not all of them 0.

    Returns
    -------
    float
        1 for the same partition, about 0 for pieces drawn by chance: the limit of `ari` for ever more points that are
        spread evenly over the volume.

    Raises
    ------
    FieldError
        If the labels differ in number, are none, or are not whole numbers, or the volumes do not fit them.

    Examples
    --------
    >>> from fracsim import metrics
    >>> metrics.volume_ari([0, 0, 1, 1], [0, 1, 2, 2], [1.0, 0.0, 1.0, 1.0])
    1.0
    """
    y, x = (np.unique(labels, return_inverse=True)[1] for labels in _labels(truth, predicted))
    weight = np.asarray(volumes, dtype=float)
    if weight.shape != y.shape or not (np.isfinite(weight).all() and weight.min() >= 0.0 and weight.max() > 0.0):
        raise FieldError("each label needs a volume, finite and at least 0, and they cannot all be 0")
    weight = weight / weight.sum()
    width = int(x.max()) + 1
    both = np.bincount(y * width + x, weight, minlength=width * (int(y.max()) + 1))
    # The chance that two points share a piece: in both divisions, in the true one, in the predicted one.
    shared, in_truth, in_predicted = ((n**2).sum() for n in (both, np.bincount(y, weight), np.bincount(x, weight)))
    chance, maximum = in_truth * in_predicted, (in_truth + in_predicted) / 2
    # Where each division is one piece there is nothing to tell apart, up to rounding.
    return 1.0 if maximum - chance < 1e-12 else float((shared - chance) / (maximum - chance))


def ami(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Compute the adjusted mutual information of two labellings (thesis, Eq. 4.12).

    Parameters
    ----------
    truth, predicted : array_like of int, shape (V,)
        The true and the predicted label of each vertex. Only which vertices share a label matters.

    Returns
    -------
    float
        1 for the same partition, about 0 for labels drawn by chance.

    Raises
    ------
    FieldError
        If the labels differ in number, are none, or are not whole numbers.
    MissingExtraError
        If scikit-learn is not installed.
    """
    try:
        from sklearn.metrics import adjusted_mutual_info_score
    except ImportError as error:
        raise MissingExtraError("scikit-learn", "bake") from error
    return float(adjusted_mutual_info_score(*_labels(truth, predicted)))


def accepted(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> bool:
    """Tell whether a segmentation is good enough for real-time use (thesis, section 5.1.4).

    Parameters
    ----------
    truth, predicted : array_like of int, shape (V,)
        The true and the predicted label of each vertex. Only which vertices share a label matters.

    Returns
    -------
    bool
        Whether the ARI is at least 0.7.

    Raises
    ------
    FieldError
        If the labels differ in number, are none, or are not whole numbers.
    """
    return ari(truth, predicted) >= ACCEPTED


def boundary_vertices(labels: npt.ArrayLike, edges: npt.ArrayLike) -> IntArray:
    """Find the vertices that have a neighbour with another label (thesis, Eq. 4.2).

    Parameters
    ----------
    labels : array_like of int, shape (V,)
        Label of each vertex.
    edges : array_like of int, shape (E, 2)
        Vertices of each edge.

    Returns
    -------
    ndarray of int64, shape (B,)
        Indices of the vertices, rising.

    Raises
    ------
    FieldError
        If an array has a wrong shape, or an edge names a vertex without a label.

    Examples
    --------
    >>> from fracsim import metrics
    >>> metrics.boundary_vertices([0, 0, 1], [[0, 1], [1, 2]]).tolist()
    [1, 2]
    """
    label, ends = np.asarray(labels), np.asarray(edges)
    if label.ndim != 1 or ends.ndim != 2 or ends.shape[1] != 2:
        raise FieldError(f"labels must be (V,) and edges (E, 2), got {label.shape} and {ends.shape}")
    if ends.size and (ends.dtype.kind not in "iu" or ends.min() < 0 or ends.max() >= len(label)):
        raise FieldError(f"edges must be whole numbers from 0 to {len(label) - 1}, one for each label")
    ends = ends.astype(np.int64)
    return np.unique(ends[label[ends[:, 0]] != label[ends[:, 1]]])


def chamfer(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Compute the Chamfer distance of two sets of points (thesis, Eqs. 4.7 and 4.8).

    Parameters
    ----------
    a : array_like of float, shape (N, 3)
        The points of the one set.
    b : array_like of float, shape (M, 3)
        The points of the other set.

    Returns
    -------
    float
        Half the mean distance from the points of ``a`` to the nearest of ``b``, plus half the mean distance from the
        points of ``b`` to the nearest of ``a``.

    Raises
    ------
    FieldError
        If a set is empty, has a wrong shape, or holds values that are not finite.
    """
    points, others = _points(a), _points(b)
    if not len(points) or not len(others):
        raise FieldError("the Chamfer distance of no points is not defined; give at least one point in each set")
    to_others, to_points = cKDTree(others).query(points)[0], cKDTree(points).query(others)[0]
    return float(to_others.mean() / 2 + to_points.mean() / 2)


def boundary_chamfer(
    vertices: npt.ArrayLike, edges: npt.ArrayLike, truth: npt.ArrayLike, predicted: npt.ArrayLike
) -> float:
    """Compute the Chamfer distance between the boundary vertices of two labellings (thesis, Eqs. 4.2, 4.7 and 4.8).

    The thesis does not say what the value is if there is no boundary. Here it is 0 if neither labelling has one, and
    the largest extent of the vertices if only one of them has, so that a missed fracture counts.

    Parameters
    ----------
    vertices : array_like of float, shape (V, 3)
        Positions of the vertices.
    edges : array_like of int, shape (E, 2)
        Vertices of each edge.
    truth, predicted : array_like of int, shape (V,)
        The true and the predicted label of each vertex. Only which vertices share a label matters.

    Returns
    -------
    float
        The distance, in the units of the vertices.

    Raises
    ------
    FieldError
        If an array has a wrong shape or dtype, or holds values that are not finite.
    """
    points = _points(vertices)
    true, guess = (points[boundary_vertices(labels, edges)] for labels in _labels(truth, predicted, len(points)))
    if not len(true) or not len(guess):
        return 0.0 if len(true) == len(guess) else float(np.ptp(points, axis=0).max())
    return chamfer(true, guess)


def region_chamfer(vertices: npt.ArrayLike, truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Compute the region Chamfer distance of two labellings (thesis, Eqs. 4.9 and 4.10).

    It is the sum, over the true pieces, of the Chamfer distance to the predicted piece that is nearest by that
    distance. The value is exact, but not every pair of pieces is computed. A segmentation may give thousands of small
    pieces; for most of them a lower bound of their distance already shows that they are not the nearest.

    Parameters
    ----------
    vertices : array_like of float, shape (V, 3)
        Positions of the vertices.
    truth, predicted : array_like of int, shape (V,)
        The true and the predicted label of each vertex. Only which vertices share a label matters.

    Returns
    -------
    float
        The sum, in the units of the vertices.

    Raises
    ------
    FieldError
        If an array has a wrong shape or dtype, or holds values that are not finite.
    """
    points = _points(vertices)
    true, guess = (np.unique(labels, return_inverse=True)[1] for labels in _labels(truth, predicted, len(points)))
    sizes = np.bincount(guess)
    groups = np.split(points[np.argsort(guess, kind="stable")], np.cumsum(sizes)[:-1])
    centres = np.stack([np.bincount(guess, points[:, k]) for k in range(3)], axis=1) / sizes[:, None]
    radii = np.zeros(len(sizes))
    np.maximum.at(radii, guess, np.linalg.norm(points - centres[guess], axis=1))
    trees: dict[int, cKDTree] = {}

    def mean_distance(piece_points: FloatArray, k: int) -> float:
        """Mean distance from the points of a true piece to the nearest of predicted piece k."""
        if k not in trees:
            trees[k] = cKDTree(groups[k])
        return float(trees[k].query(piece_points)[0].mean())

    total = 0.0
    for piece in range(int(true.max()) + 1):
        piece_points = points[true == piece]
        back = np.bincount(guess, cKDTree(piece_points).query(points)[0]) / sizes  # from each predicted piece
        # The predicted piece that shares most vertices is usually close to the nearest, and rules out most others.
        first = int(np.bincount(guess[true == piece], minlength=len(sizes)).argmax())
        best = (mean_distance(piece_points, first) + back[first]) / 2
        candidates = np.flatnonzero(back < 2 * best)
        candidates = candidates[candidates != first]
        # No point of a predicted piece is nearer than the piece's centre minus its radius.
        bounds = [
            np.maximum(cdist(piece_points, centres[chunk]) - radii[chunk], 0.0).mean(axis=0)
            for chunk in np.split(candidates, range(CHUNK, len(candidates), CHUNK))
        ]
        bound = (np.concatenate(bounds) + back[candidates]) / 2
        for k in np.argsort(bound, kind="stable"):
            if bound[k] >= best:
                break
            best = min(best, (mean_distance(piece_points, int(candidates[k])) + back[candidates[k]]) / 2)
        total += best
    return float(total)


def partition_scores(
    vertices: npt.ArrayLike, edges: npt.ArrayLike, truth: npt.ArrayLike, predicted: npt.ArrayLike
) -> dict[str, float]:
    """Compute all measures of a segmentation (thesis, section 4.7.2).

    Parameters
    ----------
    vertices : array_like of float, shape (V, 3)
        Positions of the vertices.
    edges : array_like of int, shape (E, 2)
        Vertices of each edge.
    truth, predicted : array_like of int, shape (V,)
        The true and the predicted label of each vertex. Only which vertices share a label matters.

    Returns
    -------
    dict of str to float
        ``ari`` and ``ami``; ``bc``, the boundary Chamfer distance, and ``rc``, the region Chamfer distance, in the
        units of the vertices.

    Raises
    ------
    FieldError
        If an array has a wrong shape or dtype, or holds values that are not finite.
    """
    return {
        "ari": ari(truth, predicted),
        "ami": ami(truth, predicted),
        "bc": boundary_chamfer(vertices, edges, truth, predicted),
        "rc": region_chamfer(vertices, truth, predicted),
    }


def balanced_accuracy(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Compute the balanced accuracy of yes-or-no predictions, such as whether an impulse breaks a body.

    Parameters
    ----------
    truth, predicted : ndarray of bool, shape (N,)
        What is true, and what is predicted.

    Returns
    -------
    float
        The mean of two shares: of true cases predicted as true, and of false cases predicted as false; nan if the truth
        has only one kind of case.

    Raises
    ------
    FieldError
        If the arrays are not booleans of the same shape.

    Examples
    --------
    >>> import numpy as np
    >>> from fracsim import metrics
    >>> metrics.balanced_accuracy(np.array([True, True, False]), np.array([True, False, False]))
    0.75
    """
    y, x = np.asarray(truth), np.asarray(predicted)
    if y.shape != x.shape or y.dtype != bool or x.dtype != bool:
        raise FieldError(f"two lists of booleans of one length are needed, got {y.shape} and {x.shape}")
    if y.all() or not y.any():
        return float("nan")
    return float(((x == y)[y].mean() + (x == y)[~y].mean()) / 2)


def break_curve(ratio: npt.ArrayLike, predicted: npt.ArrayLike, bins: npt.ArrayLike) -> FloatArray:
    """Compute the share of impulses that are predicted to break a body, by their severity.

    The true curve is a step from 0 to 1 at a ratio of 1.

    Parameters
    ----------
    ratio : array_like of float, shape (N,)
        Severity of each impulse divided by its threshold.
    predicted : ndarray of bool, shape (N,)
        Whether the impulse is predicted to break the body.
    bins : array_like of float, shape (B,)
        Rising edges of the bins of ratios.

    Returns
    -------
    ndarray of float64, shape (B - 1,)
        The share in each bin; nan in an empty bin.

    Raises
    ------
    FieldError
        If an array has a wrong shape or dtype, a ratio is not finite, or the edges do not rise.
    """
    ratios, broken, edges = np.asarray(ratio, dtype=float), np.asarray(predicted), np.asarray(bins, dtype=float)
    if ratios.ndim != 1 or ratios.shape != broken.shape or broken.dtype != bool:
        raise FieldError(f"ratio and booleans of one length are needed, got {ratios.shape} and {broken.shape}")
    if not np.isfinite(ratios).all():
        raise FieldError("ratios must be finite")
    if edges.ndim != 1 or len(edges) < 2 or not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
        raise FieldError("bins must be at least two finite edges that rise")
    counts, hits = np.histogram(ratios, edges)[0], np.histogram(ratios[broken], edges)[0]
    return np.asarray(np.divide(hits, counts, out=np.full(len(counts), np.nan), where=counts > 0))


def _fields(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Check two fields that are to be compared."""
    y, x = np.asarray(truth, dtype=np.float64), np.asarray(predicted, dtype=np.float64)
    if y.shape != x.shape or not y.size:
        raise FieldError(f"fields to compare must have one shape and not be empty, got {y.shape} and {x.shape}")
    if not (np.isfinite(y).all() and np.isfinite(x).all()):
        raise FieldError("fields to compare must be finite")
    return y, x


def _labels(truth: npt.ArrayLike, predicted: npt.ArrayLike, count: int | None = None) -> tuple[IntArray, IntArray]:
    """Check two labellings that are to be compared."""
    y, x = np.asarray(truth), np.asarray(predicted)
    if y.ndim != 1 or y.shape != x.shape or not y.size:
        raise FieldError(f"labels to compare must be of one length and not be empty, got {y.shape} and {x.shape}")
    if y.dtype.kind not in "biu" or x.dtype.kind not in "biu":
        raise FieldError(f"labels must be whole numbers, got {y.dtype} and {x.dtype}")
    if count is not None and len(y) != count:
        raise FieldError(f"there must be a label for each of {count} vertices, got {len(y)}")
    return y, x


def _points(values: npt.ArrayLike) -> FloatArray:
    """Check an array of points."""
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise FieldError(f"points must be finite and have shape (n, 3), got {points.shape}")
    return points
