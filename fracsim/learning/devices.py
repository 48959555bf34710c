"""Where a training runs: its device, and the processes that torchrun started. The trainer and its models use it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from ..common.errors import MissingExtraError, ModelError
from .options import TrainingOptions

try:
    import torch
    import torch.distributed as dist
except ImportError as error:
    raise MissingExtraError("torch", "train") from error


def device_for(options: TrainingOptions) -> torch.device:
    """Find the device of a training; under torchrun, the process's own.

    Parameters
    ----------
    options : TrainingOptions
        Device and precision.

    Returns
    -------
    device
        The device.

    Raises
    ------
    ModelError
        Where it is unknown or not there, or the precision is not for it.
    """
    name = options.device
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ModelError(f"unknown device {name!r}; use auto, cpu, cuda or cuda:N") from error
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise ModelError(f"device {name!r}: torch sees no CUDA device here; use cpu")
        if device.index is None:
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        if device.index >= torch.cuda.device_count():
            raise ModelError(f"device {device}: there are only {torch.cuda.device_count()}")
    elif options.precision in ("bf16", "fp16"):
        raise ModelError(f"precision {options.precision} is for CUDA devices; on {name} use auto or fp32")
    return device


def rank() -> int:
    """Tell which of torchrun's processes this is; 0 without torchrun.

    Returns
    -------
    int
        The rank.
    """
    return int(os.environ.get("RANK", 0))


@contextmanager
def joined_processes(device: torch.device) -> Iterator[tuple[int, int]]:
    """Join the processes that torchrun started.

    Parameters
    ----------
    device : device
        Of this process.

    Yields
    ------
    tuple of (int, int)
        This process's rank, and the number of processes.
    """
    world = int(os.environ.get("WORLD_SIZE", 1))
    if world == 1:
        yield 0, 1
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    yield dist.get_rank(), world
    dist.barrier()  # whoever is done first must not hang up on the others
    dist.destroy_process_group()


def sum_gradients(module: torch.nn.Module) -> None:
    """Add up the gradients of all processes, in place.

    Parameters
    ----------
    module : Module
        The same in every process.
    """
    parameters = [p for p in module.parameters() if p.requires_grad]
    flat = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters])
    dist.all_reduce(flat)
    for parameter, part in zip(parameters, torch.split(flat, [p.numel() for p in parameters]), strict=True):
        parameter.grad = part.view_as(parameter)
