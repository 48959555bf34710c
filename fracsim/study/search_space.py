"""TODO study.search_space."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from ..common.errors import MissingExtraError, ModelError
from ..data.samples import FOLDS

try:
    import optuna
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error


@dataclass(frozen=True)
class Range:
    """Where an option is sought: whole numbers where both ends are. log: evenly by its logarithm."""

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ModelError(f"a range must be two finite numbers that do not fall, got {self.low} to {self.high}")
        if self.log and self.low <= 0:
            raise ModelError(f"a logarithmic range must be above 0, got {self.low}")

    def suggest(self, trial: optuna.Trial, name: str) -> float:
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    def narrowed(self, name: str, text: str) -> Range:
        """The same with the ends that a text such as "32:128" says, or the single value of one such as "64"."""
        low, _, high = text.partition(":")
        whole = isinstance(self.low, int)
        try:
            first, last = (int(end) if whole else float(end) for end in (low, high or low))
        except ValueError as error:
            kind = "whole numbers" if whole else "numbers"
            raise ModelError(f"--range {name} takes LOW:HIGH, {kind}, got {text!r}") from error
        return Range(first, last, self.log)


# Options by their names in a model's options or in its training's. MLP: thesis, section 5.2.1. DeltaConv: Table 5.5.
_SCORES = {
    "width": Range(32, 512, log=True),
    "eigenfunctions": Range(24, 192, log=True),
    "rate": Range(3e-4, 1e-2, log=True),
}
SPACES: dict[str, dict[str, Range]] = {
    "mlp": {"width": Range(32, 1024), "layers": Range(1, 20)},
    "deltaconv": {
        "layers": Range(1, 6),
        "width": Range(64, 1024),
        "depth": Range(1, 3),
        "embedding": Range(64, 2048),
        "neighbours": Range(2, 30),
        "kernel": Range(1.0, 3.0),
    },
    "field": _SCORES,
    "interfaces": _SCORES,
    "shared": {
        "knots": Range(4, 32),
        "eigenfunctions": Range(24, 192, log=True),
        "rate": Range(3e-3, 1e-1, log=True),
    },
    "nearest": {"position": Range(0.5, 30.0, log=True), "severity": Range(0.05, 5.0, log=True)},
}


@dataclass(frozen=True)
class Search:
    """What is sought. kind: of model. options: its own, for all that is not sought. ranges: of what is. folds: how
    many of the dataset's folds are held out in turn. seed: of the fits and of the search. source: the dataset's mark.
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

    def with_values(self, values: dict[str, Any]) -> Any:
        """The options with these instead; those that are none of the model's own are its training's."""
        names = {field.name for field in fields(self.options)}
        own = {name: value for name, value in values.items() if name in names}
        rest = {name: value for name, value in values.items() if name not in names}
        if rest:
            if "training" not in names:
                raise ModelError(f"{self.kind} has no option {', '.join(rest)}")
            own["training"] = replace(self.options.training, **rest)
        return replace(self.options, **own)

    def identity(self) -> dict[str, Any]:
        """All that the figures of a trial depend on, beside the values that it tries."""
        return json.loads(json.dumps(asdict(self)))


def search_space(kind: str, narrowed: dict[str, str] | None = None) -> dict[str, Range]:
    """The ranges of a kind of model, some of them narrowed by texts such as "32:128"."""
    if kind not in SPACES:
        raise ModelError(f"nothing of model {kind!r} can be tuned; use one of {', '.join(SPACES)}")
    ranges = dict(SPACES[kind])
    for name, text in (narrowed or {}).items():
        if name not in ranges:
            raise ModelError(f"{name!r} is not sought; {kind} has {', '.join(ranges)}")
        ranges[name] = ranges[name].narrowed(name, text)
    return ranges
