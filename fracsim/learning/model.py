"""The interface of all models, and the file that a model is kept in. Offline only, but for the field model's arrays.

A model is of one body. ``fit`` makes it from samples, ``predict`` answers impacts with distance fields, and what it
learned is a few arrays. Training, tuning and evaluation use models through this interface alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

from ..common.arrays import Float32Array, IntArray
from ..common.errors import ModelError
from ..common.files import header_of, write_beside
from ..simulators.base import Impacts
from . import model_class
from .search import Cost, Range

if TYPE_CHECKING:
    from ..data.samples import Samples
    from .body import BodyGeometry
    from .trainer import Run

FORMAT = 1

Value = TypeVar("Value")


class Predictor(Protocol):
    """Whatever answers impacts with fields: a model, or a simulator whose answers are precomputed."""

    def predict(self, impacts: Impacts) -> Float32Array:
        """Answer impacts with distance fields.

        Parameters
        ----------
        impacts : Impacts
            N impacts on the body.

        Returns
        -------
        ndarray of float32, shape (N, V)
            Distance from each vertex to the nearest crack, in units of the largest extent, capped at CAP.
        """
        ...

    @property
    def predict_nodes(self) -> Callable[[Impacts], Float32Array] | None:
        """As ``predict``, at the edge midpoints as well, (N, V + E); None where the model cannot."""
        return None

    @property
    def predict_labels(self) -> Callable[[Impacts], IntArray] | None:
        """The piece of each atom, (N, A), with no field between; None where the model cannot."""
        return None


class Model(Predictor, Protocol):
    """One architecture. A class that inherits from it gets the defaults below.

    Attributes
    ----------
    kind : str
        Its name in ``learning.MODELS``.
    options_type : type
        A frozen dataclass of its hyperparameters, all with defaults. Where the common trainer fits the model, one of
        them is ``training: TrainingOptions``.
    search_space : mapping of str to Range
        Where ``fracsim tune`` seeks its options and those of its training, by their names.
    cost : Cost
        How tuning weighs its error against its time.
    slow : bool
        Whether an evaluation asks it about fewer impulses, because an answer takes long.
    """

    kind: ClassVar[str]
    options_type: ClassVar[type[Any]]
    search_space: ClassVar[Mapping[str, Range]] = {}
    cost: ClassVar[Cost] = Cost()
    slow: ClassVar[bool] = False

    @classmethod
    def fit(
        cls, body: BodyGeometry, samples: Samples, options: Any, seed: int, run: Run | None = None
    ) -> tuple[Self, dict[str, float]]:
        """Learn from the training split, and watch the validation split.

        Parameters
        ----------
        body : BodyGeometry
            The body.
        samples : Samples
            Its fractures, in terms of its atoms.
        options : options_type
            Hyperparameters.
        seed : int
            On a CPU, the same seed gives the same model to the bit.
        run : Run, optional
            Progress, checkpoint and log.

        Returns
        -------
        tuple
            The model, and figures of the training.

        Raises
        ------
        ModelError
            Where a split is empty or the training diverges.
        """
        ...

    @classmethod
    def fit_many(
        cls, bodies: Sequence[tuple[BodyGeometry, Samples]], options: Any, seed: int, run: Run | None = None
    ) -> tuple[Self, dict[str, float]]:
        """Learn from several bodies at once; the model returned is of the first. Few models can."""
        raise ModelError(f"{cls.__name__}: learns from one body only")

    def on(self, body: BodyGeometry) -> Self:
        """Take the same model to another body. A model that has ``fit_many`` can."""
        raise ModelError(f"{type(self).__name__}: is of one body only")

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Lay the model down.

        Returns
        -------
        tuple
            Arrays by name, and numbers that JSON can hold, from which ``restore`` makes the model again.
        """
        ...

    @classmethod
    def restore(cls, body: BodyGeometry, arrays: Mapping[str, npt.NDArray[Any]], numbers: Mapping[str, Any]) -> Self:
        """Make the model again from its ``state``.

        Parameters
        ----------
        body : BodyGeometry
            The body that it is of.
        arrays, numbers : mapping
            As ``state`` gave them. From a file they are ``Entries``: an entry that is missing is a ModelError.

        Returns
        -------
        Model
            It answers with the same bits.

        Raises
        ------
        ModelError
            Where they are of another body.
        """
        ...


class Entries(dict[str, Value]):
    """What a file holds, by name; to ask for an entry that is missing raises ModelError."""

    def __missing__(self, name: str) -> Value:
        raise ModelError(f"there is no entry {name!r}")


def save_model(model: Model, path: str | Path, metadata: dict[str, Any] | None = None) -> None:
    """Write a model, as safetensors: all of it, or nothing.

    Parameters
    ----------
    model : Model
        The model.
    path : str or Path
        The file; one that is there is replaced.
    metadata : dict, optional
        How the model was made, as JSON can hold it.
    """
    from safetensors.numpy import save

    arrays, numbers = model.state()
    header = {"format": FORMAT, "kind": model.kind, "numbers": numbers, "metadata": metadata or {}}
    packed = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    write_beside(Path(path), save(packed, metadata={"fracsim_model": json.dumps(header, sort_keys=True)}), ModelError)


def load_model(path: str | Path, body: BodyGeometry) -> tuple[Model, dict[str, Any]]:
    """Read a model.

    Parameters
    ----------
    path : str or Path
        A file of ``save_model``.
    body : BodyGeometry
        The body that the model is of.

    Returns
    -------
    tuple
        The model, and the metadata that it was written with.

    Raises
    ------
    ModelError
        Where the file is missing, damaged, of another format or of another body.
    """
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
    if not isinstance(header.get("numbers"), dict) or not isinstance(header.get("metadata"), dict):
        raise ModelError(f"{path}: its header lacks the model's numbers; train it again")
    for name, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ModelError(f"{path}: {name} holds values that are not finite; train it again")
    try:
        cls = model_class(str(header.get("kind")))
        return cls.restore(body, Entries(arrays), Entries(header["numbers"])), header["metadata"]
    except ModelError as error:
        raise ModelError(f"{path}: an entry is missing or does not fit this body ({error})") from error


def read_numbers(cls: type[Value], numbers: Any) -> Value:
    """Make a dataclass of a file's numbers.

    Parameters
    ----------
    cls : type
        A dataclass.
    numbers : object
        What the file holds for it: a mapping of its fields' names to their values.

    Returns
    -------
    object
        The dataclass.

    Raises
    ------
    ModelError
        Where the names are not those of its fields.
    """
    names = {field.name for field in fields(cls)}  # type: ignore[arg-type]
    if not isinstance(numbers, Mapping) or set(numbers) != names:
        raise ModelError(f"{cls.__name__} needs {', '.join(sorted(names))}")
    return cls(**numbers)
