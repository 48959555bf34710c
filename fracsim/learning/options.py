"""TODO learning.options."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

from ..common.errors import MissingExtraError, ModelError

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
    """How a model is fitted.

    optimiser: adam or adamw. rate, decay: its learning rate and weight decay. schedule: of the rate, constant or
    cosine down to 0 over the budget. batch: rows a step, over all processes. epochs, steps, seconds: the budget,
    which ends with the first of those given; seconds spends what a machine allows, so a seed does not fix its
    result. validate: steps between validations, 0 for once an epoch. patience: validations without progress after
    which training stops; with it, the best weights are kept, else the last. precision: auto (bf16 or fp16 on a CUDA
    device, fp32 on a CPU), fp32, bf16 or fp16. device: auto, cpu, cuda or cuda:N. threads: of torch; more than one
    pays only on a machine that nothing else uses.
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
        for name, least in (
            ("batch", 1),
            ("epochs", 1),
            ("steps", 1),
            ("validate", 0),
            ("patience", 1),
            ("threads", 1),
        ):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, int) and value >= least):
                raise ModelError(f"{name} must be a whole number and at least {least}, got {value}")
        for name, open_ in (("rate", True), ("decay", False), ("seconds", True)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and (value > 0 if open_ else value >= 0)):
                raise ModelError(f"{name} must be finite and {'above' if open_ else 'at least'} 0, got {value}")
        if all(getattr(self, name) is None for name in BUDGETS):
            raise ModelError(f"training needs a budget; give one of {', '.join(BUDGETS)}")


def options_from(
    options_type: type[Options], settings: Mapping[str, str], training: Mapping[str, Any] | None = None
) -> Options:
    """Options of a model from texts such as {"width": "704"}; a name that is none of its own may be one of its
    ``training``. training: values for the latter; a budget among them replaces the model's own."""
    options: Any = options_type()
    inner = getattr(options, "training", None)
    own = {name: value for name, value in _types(options_type).items() if name != "training"}
    others = {} if inner is None else _types(type(inner))
    mine: dict[str, Any] = {}
    its: dict[str, Any] = dict(training or {})
    if its and inner is None:
        raise ModelError(f"{', '.join(its)} cannot be set: this model is not trained step by step")
    for name, text in settings.items():
        if name in own:
            mine[name] = _value(name, text, own[name])
        elif name in others:
            its[name] = _value(name, text, others[name])
        else:
            raise ModelError(f"unknown option {name!r}; there are {', '.join([*own, *others]) or 'none'}")
    if inner is not None and its:
        if any(its.get(name) is not None for name in BUDGETS):
            its = {**dict.fromkeys(BUDGETS), **its}
        mine["training"] = replace(inner, **its)
    return typing.cast(Options, replace(options, **mine))


def _types(options_type: type[Any]) -> dict[str, Any]:
    assert is_dataclass(options_type)
    hints = typing.get_type_hints(options_type)
    return {field.name: hints[field.name] for field in fields(options_type)}


def _value(name: str, text: str, kind: Any) -> Any:
    kinds = typing.get_args(kind) or (kind,)
    if type(None) in kinds and text.lower() == "none":
        return None
    if bool in kinds:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        raise ModelError(f"{name} must be true or false, got {text!r}")
    for convert in (int, float, str):
        if convert in kinds:
            try:
                return convert(text)
            except ValueError:
                continue
    expected = " or ".join("none" if k is type(None) else k.__name__ for k in kinds)
    raise ModelError(f"{name} must be of type {expected}, got {text!r}")
