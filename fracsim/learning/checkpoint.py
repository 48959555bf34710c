"""The file from which an interrupted training goes on: weights, state of the optimiser and where it stood.

Only the trainer writes and reads it. Random numbers need no place in it: each step draws from a seed of its own.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..common.errors import MissingExtraError, ModelError
from ..common.files import header_of, write_beside

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

FORMAT = 1
WEIGHTS, BEST, OPTIMISER = "weights.", "best.", "optimiser."  # what the names of tensors begin with

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Checkpoint:
    """A training as it stood after a step.

    Attributes
    ----------
    weights : dict of str to Tensor
        Of the module.
    best_weights : dict of str to Tensor
        Of the validation with the least error; empty where they are not kept.
    optimiser : dict of int to dict of str to Tensor
        The optimiser's state by the number of the parameter.
    step : int
        Steps done.
    seconds : float
        Wall time spent.
    best : tuple of (float, int, int)
        The least validation error, its step, and the validations since then.
    validation : tuple of (float, int)
        The last validation error and its step.
    loss : float
        The last mean loss.
    scaler : dict
        State of the gradient scaler; empty where the precision needs none.
    """

    weights: Tensors
    best_weights: Tensors
    optimiser: dict[int, Tensors]
    step: int
    seconds: float
    best: tuple[float, int, int]
    validation: tuple[float, int]
    loss: float
    scaler: dict[str, Any]


def save_checkpoint(path: Path, identity: str, checkpoint: Checkpoint) -> None:
    """Write a checkpoint: all of it, or nothing.

    Parameters
    ----------
    path : Path
        The file; one that is there is replaced.
    identity : str
        A mark of what is trained and how.
    checkpoint : Checkpoint
        The training.
    """
    from safetensors.torch import save

    tensors = {WEIGHTS + name: value for name, value in checkpoint.weights.items()}
    tensors |= {BEST + name: value for name, value in checkpoint.best_weights.items()}
    for index, state in checkpoint.optimiser.items():
        tensors |= {f"{OPTIMISER}{index}.{name}": value for name, value in state.items()}
    header = {
        "format": FORMAT,
        "identity": identity,
        "step": checkpoint.step,
        "seconds": checkpoint.seconds,
        "best": checkpoint.best,
        "validation": checkpoint.validation,
        "loss": checkpoint.loss,
        "scaler": checkpoint.scaler,
    }
    packed = {name: value.detach().contiguous() for name, value in tensors.items()}
    write_beside(path, save(packed, metadata={"fracsim_checkpoint": json.dumps(header)}), ModelError)


def load_checkpoint(path: Path, identity: str) -> Checkpoint:
    """Read a checkpoint.

    Parameters
    ----------
    path : Path
        The file.
    identity : str
        The mark that it must bear.

    Returns
    -------
    Checkpoint
        The training, with tensors on the CPU.

    Raises
    ------
    ModelError
        Where the file is no checkpoint, or one of another training.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    data = path.read_bytes()
    try:
        tensors = load(data)
        header = header_of(data, "fracsim_checkpoint")
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise ModelError(f"{path}: not a checkpoint of fracsim; name another file or remove it") from error
    if header.get("format") != FORMAT or header.get("identity") != identity:
        raise ModelError(
            f"{path}: the checkpoint of another training (its data, options or seed differ); "
            "name another file, or remove it to begin anew"
        )

    def under(prefix: str) -> Tensors:
        return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

    optimiser: dict[int, Tensors] = {}
    for name, value in under(OPTIMISER).items():
        index, key = name.split(".", 1)
        optimiser.setdefault(int(index), {})[key] = value
    best, validation = header["best"], header["validation"]
    return Checkpoint(
        under(WEIGHTS),
        under(BEST),
        optimiser,
        int(header["step"]),
        float(header["seconds"]),
        (float(best[0]), int(best[1]), int(best[2])),
        (float(validation[0]), int(validation[1])),
        float(header["loss"]),
        dict(header["scaler"]),
    )
