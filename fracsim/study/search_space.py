"""What a study of hyperparameters seeks: of which model, in which ranges, on which data. Tuning uses it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from ..common.errors import ModelError
from ..data.samples import FOLDS
from ..learning import model_class
from ..learning.options import with_training
from ..learning.search import Range


@dataclass(frozen=True)
class Search:
    """A search: what is held fixed, and what is sought.

    Attributes
    ----------
    kind : str
        The model's name in ``learning.MODELS``.
    options : options_type
        The model's options, for all that is not sought.
    ranges : dict of str to Range
        What is sought, by the names of the options or of their training's.
    folds : int
        How many of the dataset's folds are held out in turn.
    seed : int
        Of the fits and of the search.
    source : str
        A mark of the dataset, so that no study mixes two.

    Raises
    ------
    ModelError
        Where folds or seed are out of range, or the model has no such option.
    """

    kind: str
    options: Any
    ranges: dict[str, Range]
    folds: int = FOLDS
    seed: int = 0
    source: str = ""

    def __post_init__(self) -> None:
        if not 1 <= self.folds <= FOLDS:
            raise ModelError(f"there are {FOLDS} folds, of which 1 to {FOLDS} can be asked for, got {self.folds}")
        if self.seed < 0:
            raise ModelError(f"a seed must be at least 0, got {self.seed}")
        self.with_values({name: ends.low for name, ends in self.ranges.items()})

    def with_values(self, values: Mapping[str, Any]) -> Any:
        """Put values into the options.

        Parameters
        ----------
        values : mapping of str to object
            By the names of the model's options or of its training's.

        Returns
        -------
        options_type
            The options.

        Raises
        ------
        ModelError
            Where the model has no such option, or a value is out of range.
        """
        return with_training(self.options, values)

    def identity(self) -> dict[str, Any]:
        """Lay down all that a trial's figures depend on, except the values that it tries, as plain data."""
        return json.loads(json.dumps(asdict(self)))


def search_space(kind: str, narrowed: Mapping[str, str] | None = None) -> dict[str, Range]:
    """Find what is sought of a model.

    Parameters
    ----------
    kind : str
        The model's name.
    narrowed : mapping of str to str, optional
        Other ends for some of the ranges, as texts such as "32:128".

    Returns
    -------
    dict of str to Range
        The ranges of its class, narrowed.

    Raises
    ------
    ModelError
        Where the model is unknown or has nothing to seek, or a name or a text does not fit.
    """
    ranges = dict(model_class(kind).search_space)
    if not ranges:
        raise ModelError(f"model {kind!r} has no search space, so it cannot be tuned")
    for name, text in (narrowed or {}).items():
        if name not in ranges:
            raise ModelError(f"{name!r} is not sought; {kind} has {', '.join(ranges)}")
        ranges[name] = ranges[name].narrowed(name, text)
    return ranges
