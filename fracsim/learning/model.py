"""What all models share: the body they are about, the door that impacts come in by, and the file they are kept in.

A model is of one body. ``fit`` makes it from samples, ``predict`` answers impacts with distance fields, and what it
learned is a handful of arrays. Offline only, but for the field model, whose arrays an asset carries.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array
from ..common.errors import ModelError
from ..common.files import header_of, write_beside
from ..simulators.base import Impacts
from .body import BodyGeometry

FORMAT = 1
MODELS = {
    "mlp": "mlp:MLP",
    "deltaconv": "deltaconv:DeltaConv",
    "field": "field:FieldModel",
    "interfaces": "interfaces:InterfaceModel",
    "shared": "shared:SharedField",
    "nearest": "nearest:Nearest",
}


class Model(Protocol):
    """One architecture.

    kind: its name in MODELS. options_type: a frozen dataclass of its hyperparameters, all with defaults; where the
    common trainer fits it, one of them is ``training: TrainingOptions``. Beside what is below, a class has
    ``fit(body, samples, options, seed, run) -> (model, figures)``, which learns from ``samples.part(0)`` and watches
    ``samples.part(1)``. It may have ``predict_nodes(impacts) -> (N, V + E)``, fields at edge midpoints as well, and
    ``predict_labels(impacts) -> (N, A)``, pieces with no field between.
    """

    kind: ClassVar[str]
    options_type: ClassVar[type[Any]]

    def predict(self, impacts: Impacts) -> Float32Array:
        """(N, V) the distance fields of N impacts, in units of the largest extent, capped at CAP."""
        ...

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and plain numbers from which ``restore`` makes the model again, or raises ValueError where they are
        of another body."""
        ...

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: dict[str, npt.NDArray[Any]], numbers: dict[str, Any]) -> Self: ...


def model_class(kind: str) -> Any:
    """The class of a model by its name in MODELS; its module is imported now."""
    if kind not in MODELS:
        raise ModelError(f"unknown model {kind!r}; use one of {', '.join(MODELS)}")
    module, name = MODELS[kind].split(":")
    return getattr(importlib.import_module(f".{module}", __package__), name)


def save_model(model: Model, path: str | Path, metadata: dict[str, Any] | None = None) -> None:
    """Write a model's arrays and how it was made, as safetensors: all of it, or nothing."""
    from safetensors.numpy import save

    arrays, numbers = model.state()
    header = {"format": FORMAT, "kind": model.kind, "numbers": numbers, "metadata": metadata or {}}
    packed = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    write_beside(Path(path), save(packed, metadata={"fracsim_model": json.dumps(header, sort_keys=True)}))


def load_model(path: str | Path, body: BodyGeometry) -> tuple[Any, dict[str, Any]]:
    """Read a model of this body, and its metadata. Raises ModelError, naming the file and the fault."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no such file")
    data = path.read_bytes()
    try:
        arrays = load(data)
        header = header_of(data, "fracsim_model")
    except SafetensorError as error:
        raise ModelError(f"{path}: truncated or not a model ({error}); train it again with: fracsim train") from error
    except (KeyError, ValueError, TypeError) as error:
        raise ModelError(f"{path}: not a fracsim model (its header is missing)") from error
    if header.get("format") != FORMAT:
        raise ModelError(f"{path}: format {header.get('format')}, this version reads {FORMAT}; train it again")
    for name, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ModelError(f"{path}: {name} holds values that are not finite; train it again")
    try:
        return model_class(header["kind"]).restore(body, arrays, header["numbers"]), header["metadata"]
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: an entry is missing or does not fit this body ({error})") from error
