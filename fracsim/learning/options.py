"""Hyperparameters of trainings, and options made of texts and of a plan's entries. Models and study use it."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from ..common.errors import MissingExtraError, ModelError
from ..common.options import option_from_text, option_types

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

Options = TypeVar("Options")

OPTIMISERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
SCHEDULES = ("constant", "cosine")
PRECISIONS = {"auto": None, "fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
BUDGETS = ("epochs", "steps", "seconds")


@dataclass(frozen=True)
class TrainingOptions:
    """How the common trainer fits a model.

    Attributes
    ----------
    optimiser : str
        "adam" or "adamw".
    rate, decay : float
        Learning rate and weight decay.
    schedule : str
        Of the rate over the budget: "constant", or "cosine" down to 0.
    batch : int
        Training rows a step, over all processes.
    epochs : int or None
        Budget in passes over the training rows. Training ends with the first of the budgets that are set.
    steps : int or None
        Budget in steps of the optimiser.
    seconds : float or None
        Budget in wall time. What it buys depends on the machine, so a seed does not fix its result.
    validate : int
        Steps between validations; 0 for once an epoch.
    patience : int or None
        Validations without progress after which training stops. With it the best weights are kept, else the last.
    precision : str
        "auto" (bf16 or fp16 on a CUDA device, fp32 on a CPU), "fp32", "bf16" or "fp16".
    device : str
        "auto", "cpu", "cuda" or "cuda:N".
    threads : int
        Of torch. More than one pays only on a machine that nothing else uses.

    Raises
    ------
    ModelError
        Where a value is out of range or no budget is set.
    """

    optimiser: str = "adam"
    rate: float = 1e-4
    decay: float = 0.0
    schedule: str = "constant"
    batch: int = 32
    epochs: int | None = None
    steps: int | None = None
    seconds: float | None = None
    validate: int = 0
    patience: int | None = None
    precision: str = "auto"
    device: str = "auto"
    threads: int = 1

    def __post_init__(self) -> None:
        for name, known in (("optimiser", OPTIMISERS), ("schedule", SCHEDULES), ("precision", PRECISIONS)):
            if getattr(self, name) not in known:
                raise ModelError(f"unknown {name} {getattr(self, name)!r}; use one of {', '.join(known)}")
        for name, minimum in (
            ("batch", 1),
            ("epochs", 1),
            ("steps", 1),
            ("validate", 0),
            ("patience", 1),
            ("threads", 1),
        ):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, int) and value >= minimum):
                raise ModelError(f"{name} must be a whole number and at least {minimum}, got {value}")
        for name, positive in (("rate", True), ("decay", False), ("seconds", True)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and (value > 0 if positive else value >= 0)):
                raise ModelError(f"{name} must be finite and {'above' if positive else 'at least'} 0, got {value}")
        if all(getattr(self, name) is None for name in BUDGETS):
            raise ModelError(f"training needs a budget; give one of {', '.join(BUDGETS)}")


def training_of(options: object) -> TrainingOptions | None:
    """Find how a model is trained among its options.

    Parameters
    ----------
    options : object
        A model's options.

    Returns
    -------
    TrainingOptions or None
        Its field ``training``; None where the model is not trained step by step.
    """
    return next((value for value in vars(options).values() if isinstance(value, TrainingOptions)), None)


def with_training(options: Options, values: Mapping[str, Any]) -> Options:
    """Change options of a model and of its training. This is the one place where the two are merged.

    Parameters
    ----------
    options : object
        A model's options, a dataclass.
    values : mapping of str to object
        New values by name. A name that is not a field of the options is one of their ``training``. A budget (epochs,
        steps or seconds) takes the place of the model's own.

    Returns
    -------
    object
        The options with these values.

    Raises
    ------
    ModelError
        Where a name is unknown or a value out of range.

    Examples
    --------
    >>> from fracsim.learning.mlp import MLPOptions
    >>> changed = with_training(MLPOptions(), {"width": 64, "steps": 100})
    >>> changed.width, changed.training.steps, changed.training.epochs
    (64, 100, None)
    """
    training = training_of(options)
    fields_of_its_own = [name for name in option_types(type(options)) if name != "training"]
    trained = list(option_types(TrainingOptions))
    outer = {name: value for name, value in values.items() if name in fields_of_its_own}
    inner = {name: value for name, value in values.items() if name not in fields_of_its_own}
    if training is None and (refused := [name for name in inner if name in trained]):
        raise ModelError(f"{', '.join(refused)} cannot be set: this model is not trained step by step")
    known = fields_of_its_own if training is None else [*fields_of_its_own, *trained]
    if unknown := [name for name in inner if name not in known]:
        raise ModelError(f"unknown option {unknown[0]!r}; there are {', '.join(known) or 'none'}")
    if inner and training is not None:
        if any(inner.get(name) is not None for name in BUDGETS):
            inner = {**dict.fromkeys(BUDGETS), **inner}
        outer["training"] = replace(training, **inner)
    return typing.cast(Options, replace(typing.cast(Any, options), **outer))


def options_from(
    options_type: type[Options], settings: Mapping[str, str], training: Mapping[str, Any] | None = None
) -> Options:
    """Make a model's options of texts, such as a command line holds.

    Parameters
    ----------
    options_type : type
        A dataclass whose fields all have defaults.
    settings : mapping of str to str
        Texts such as {"width": "704"}, for fields of the options or of their ``training``.
    training : mapping of str to object, optional
        Values for fields of their ``training``.

    Returns
    -------
    object
        The options.

    Raises
    ------
    ModelError
        Where a name is unknown, or a text is not of its field's type.
    """
    options = options_type()
    types = option_types(TrainingOptions) if training_of(options) is not None else {}
    types |= {name: value for name, value in option_types(options_type).items() if name != "training"}
    values = {
        name: option_from_text(name, text, types[name], ModelError) if name in types else text
        for name, text in settings.items()
    }
    return with_training(options, {**(training or {}), **values})
