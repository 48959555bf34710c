"""How good a predicted field or partition is: the thesis's measures, section 4.7."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .errors import MissingExtraError

ALPHA = 10.0  # of AMAE, for fields in units of the largest extent
ACCEPTED = 0.7


def mse(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Mean squared error of a field."""
    return float(np.mean((np.asarray(truth) - np.asarray(predicted)) ** 2))


def amae(truth: npt.ArrayLike, predicted: npt.ArrayLike, alpha: float = ALPHA) -> float:
    """Adapted mean absolute error, |y - ŷ| / (1 + α|y|) in the mean over vertices (thesis, Eq. 4.5)."""
    y = np.asarray(truth)
    return float(np.mean(np.abs(y - np.asarray(predicted)) / (1 + alpha * np.abs(y))))


def ari(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> float:
    """Adjusted Rand index of two labellings: 1 for the same partition, 0 for chance."""
    try:
        from sklearn.metrics import adjusted_rand_score
    except ImportError as error:
        raise MissingExtraError("scikit-learn", "bake") from error
    return float(adjusted_rand_score(np.asarray(truth), np.asarray(predicted)))


def accepted(truth: npt.ArrayLike, predicted: npt.ArrayLike) -> bool:
    """Whether a segmentation is good enough for real-time use: ARI of at least 0.7 (thesis, section 5.1.4)."""
    return ari(truth, predicted) >= ACCEPTED
