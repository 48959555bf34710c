"""One trainer for every model that torch fits, on one device or, under torchrun, on several. Offline only.

A model class in ``models`` has ``options_type``, a frozen dataclass, and
``fit(body, samples, options, seed, run) -> (model, figures)``, which learns from ``samples.part(0)`` and watches
``samples.part(1)``. One that uses this trainer wraps what it fits in a ``Learner`` and has a field
``training: TrainingOptions`` among its options.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import threading
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from ..common.errors import MissingExtraError, ModelError
from ..common.files import header_of, write_beside
from .options import BUDGETS, OPTIMISERS, PRECISIONS, TrainingOptions
from .shuffle import derived_seed, shuffled

try:
    import torch
    import torch.distributed as dist
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

FORMAT = 1
WINDOW = 20  # steps that a logged loss is the mean of


@dataclass(frozen=True)
class Run:
    """What goes on around a training.

    checkpoint: a file to keep all that is needed to go on, written at the end of every epoch, after ``every`` seconds,
    and on Ctrl-C. resume: whether to go on from it where it is there. label: says what is trained, so that a
    checkpoint of something else is not taken for it. log: a folder for TensorBoard. progress: called with the share
    of the budget that is spent.
    """

    checkpoint: Path | None = None
    resume: bool = False
    every: float = 60.0
    label: str = ""
    log: Path | None = None
    progress: Callable[[float], None] = lambda _: None


class Learner(Protocol):
    """What is fitted: ``count`` training rows, a loss on any of them, and a measure of success, less being better."""

    @property
    def module(self) -> torch.nn.Module: ...

    @property
    def count(self) -> int: ...

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """Parameter groups for the optimiser, where need be with rates and decays of their own."""
        ...

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """The mean loss over rows (B,) int64; whatever is drawn at random comes from the generator. Both are on the
        CPU."""
        ...

    def validate(self) -> float:
        """On held-out samples; called in evaluation mode, without gradients."""
        ...


def train(learner: Learner, options: TrainingOptions, seed: int, run: Run | None = None) -> dict[str, float]:
    """Fit ``learner.module`` in place; returns figures of the training.

    On a CPU, a seed and a budget of epochs or steps fix the weights to the bit, whether or not the training was
    interrupted and resumed between. Under torchrun every process takes a share of each batch and ends with the same
    weights; only the first writes. Raises ModelError when the loss stops being finite or the checkpoint is of
    another training.
    """
    run = run or Run()
    threads = torch.get_num_threads()
    torch.set_num_threads(options.threads)
    try:
        with _interrupts_held(run.checkpoint is not None) as interrupted, _processes(device_for(options)) as place:
            return _Training(learner, options, seed, run, place).go(interrupted)
    finally:
        torch.set_num_threads(threads)


def device_for(options: TrainingOptions) -> torch.device:
    """The device that training is on; under torchrun, the process's own."""
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
    """Of this process among those that torchrun started; 0 without it."""
    return int(os.environ.get("RANK", 0))


class _Training:
    """One training under way: what a checkpoint holds, and the loop that changes it."""

    def __init__(self, learner: Learner, options: TrainingOptions, seed: int, run: Run, place: tuple[int, int]) -> None:
        if seed < 0:
            raise ModelError(f"a seed must be at least 0, got {seed}")
        if learner.count < 1:
            raise ModelError("there is nothing to train on; make more samples with: fracsim dataset make")
        if run.checkpoint is not None and not run.checkpoint.absolute().parent.is_dir():
            raise ModelError(f"{run.checkpoint}: the folder does not exist; create it first")
        self.learner, self.module, self.options, self.seed, self.run = learner, learner.module, options, seed, run
        self.device = device_for(options)
        self.rank, self.world = place
        self.optimiser = OPTIMISERS[options.optimiser](
            learner.groups(options.rate), lr=options.rate, weight_decay=options.decay
        )
        self.rates = [float(group["lr"]) for group in self.optimiser.param_groups]
        self.precision = self._precision()
        self.scaler = torch.amp.GradScaler("cuda", enabled=self.precision == torch.float16)
        self.batch = min(options.batch, learner.count)
        self.epoch = -(-learner.count // self.batch)  # steps
        ends = (options.steps, options.epochs and options.epochs * self.epoch)
        self.last = min((end for end in ends if end is not None), default=None)
        self.every = options.validate or self.epoch
        self.identity = self._identity()
        # What changes:
        self.step, self.before = 0, 0.0  # before: seconds spent in earlier sittings
        self.best, self.best_step, self.validation, self.validated, self.stale = math.inf, 0, math.nan, 0, 0
        self.best_weights: dict[str, torch.Tensor] = {}
        self.loss = math.nan
        self.sum, self.summed = torch.zeros((), device=self.device), 0
        if run.resume and run.checkpoint is not None and run.checkpoint.exists():
            self._load(run.checkpoint)
        self._share_weights()
        self.begin = time.monotonic()

    def go(self, interrupted: list[int]) -> dict[str, float]:
        run = self.run
        saved = shown = time.monotonic()
        self.module.train()
        with _log(run.log if self.rank == 0 else None, self.step) as log:
            while not self._done():
                epoch, place = divmod(self.step, self.epoch)
                ends = place * self.batch, min((place + 1) * self.batch, self.learner.count)
                self._step(torch.from_numpy(shuffled(*ends, self.learner.count, derived_seed(self.seed, 0, epoch))))
                now = time.monotonic()
                if self.step % WINDOW == 0:
                    self._check_loss()
                    log("training/loss", self.loss, self.step)
                    log("training/rate", self.optimiser.param_groups[0]["lr"], self.step)
                if self.step % self.every == 0:
                    self._check_loss()
                    self._validate(log)
                if run.checkpoint is not None and (
                    interrupted or self.step % self.epoch == 0 or now - saved >= run.every
                ):
                    self._check_loss()
                    self._save(run.checkpoint)
                    saved = time.monotonic()
                if interrupted:
                    raise KeyboardInterrupt
                if self.rank == 0 and now - shown > 0.2:
                    run.progress(min(1.0, self._share()))
                    shown = now
            self._check_loss()
            if self.validated != self.step:
                self._validate(log)
        if run.checkpoint is not None:
            self._save(run.checkpoint)
        if self.best_weights:
            self.module.load_state_dict(self.best_weights)
        self.module.eval()
        run.progress(1.0)
        return {
            "rows": float(self.learner.count),
            "steps": float(self.step),
            "epochs": self.step / self.epoch,
            "seconds": self._seconds(),
            "processes": float(self.world),
            "training_loss": self.loss,
            "validation": self.best if self.best_weights else self.validation,
            "best_step": float(self.best_step),
        }

    def _step(self, rows: torch.Tensor) -> None:
        options = self.options
        factor = 0.5 + 0.5 * math.cos(math.pi * min(1.0, self._share())) if options.schedule == "cosine" else 1.0
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        # Each step draws from a seed of its own, so a checkpoint need not hold the state of any generator.
        drawn = derived_seed(self.seed, 1, self.step, self.rank)
        torch.manual_seed(drawn)
        mine = rows[self.rank :: self.world]
        self.optimiser.zero_grad()
        if len(mine):
            with torch.autocast(self.device.type, self.precision, enabled=self.precision != torch.float32):
                loss = self.learner.loss(mine, torch.Generator().manual_seed(drawn))
            self.scaler.scale(loss * (len(mine) / len(rows))).backward()  # type: ignore[no-untyped-call]
            self.sum += loss.detach()
            self.summed += 1
        if self.world > 1:
            self._sum_gradients()
        self.scaler.step(self.optimiser)
        self.scaler.update()
        self.step += 1

    def _sum_gradients(self) -> None:
        parameters = [p for p in self.module.parameters() if p.requires_grad]
        flat = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters])
        dist.all_reduce(flat)
        for parameter, part in zip(parameters, torch.split(flat, [p.numel() for p in parameters]), strict=True):
            parameter.grad = part.view_as(parameter)

    def _validate(self, log: Callable[[str, float, int], None]) -> None:
        value = torch.zeros(1, dtype=torch.float64, device=self.device)
        if self.rank == 0:
            self.module.eval()
            with torch.no_grad():
                value[0] = self.learner.validate()
            self.module.train()
        if self.world > 1:
            dist.broadcast(value, 0)
        self.validation, self.validated = float(value), self.step
        log("validation", self.validation, self.step)
        if self.validation < self.best:
            self.best, self.best_step, self.stale = self.validation, self.step, 0
            if self.options.patience is not None:
                self.best_weights = {k: v.detach().clone() for k, v in self.module.state_dict().items()}
        else:
            self.stale += 1

    def _done(self) -> bool:
        patience = self.options.patience
        done = (patience is not None and self.stale >= patience) or self._share() >= 1.0
        if self.world > 1 and self.options.seconds is not None:  # clocks differ: the first process decides
            flag = torch.tensor([float(done)], device=self.device)
            dist.broadcast(flag, 0)
            done = bool(flag)
        return done

    def _share(self) -> float:
        """Of the budget, spent; may exceed 1."""
        by_steps = self.step / self.last if self.last is not None else 0.0
        return max(by_steps, self._seconds() / self.options.seconds if self.options.seconds is not None else 0.0)

    def _seconds(self) -> float:
        return self.before + time.monotonic() - self.begin

    def _check_loss(self) -> None:
        """Takes the mean of the losses since the last call. A checkpoint or a model of what is not finite is none."""
        if self.summed:
            self.loss = float(self.sum) / self.summed
            self.sum.zero_()
            self.summed = 0
            if not math.isfinite(self.loss):
                raise ModelError("training diverged: the loss is not finite; lower the rate")

    def _precision(self) -> torch.dtype:
        chosen = PRECISIONS[self.options.precision]
        if chosen is None:
            if self.device.type != "cuda":
                return torch.float32
            return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
        return chosen

    def _identity(self) -> str:
        """Of what is trained and how, but for how long and where."""
        free = {*BUDGETS, "validate", "patience", "device", "threads"}
        how = {name: value for name, value in asdict(self.options).items() if name not in free}
        shapes = [(name, list(value.shape)) for name, value in self.module.state_dict().items()]
        what = json.dumps([shapes, self.learner.count, how, self.seed, self.run.label], sort_keys=True)
        return hashlib.sha256(what.encode()).hexdigest()

    def _share_weights(self) -> None:
        if self.world > 1:
            for value in self.module.state_dict().values():
                dist.broadcast(value, 0)

    def _save(self, path: Path) -> None:
        from safetensors.torch import save

        if self.rank:
            return
        tensors = {f"weights.{name}": value for name, value in self.module.state_dict().items()}
        tensors |= {f"best.{name}": value for name, value in self.best_weights.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{name}": value for name, value in state.items()}
        header = {
            "format": FORMAT,
            "identity": self.identity,
            "step": self.step,
            "seconds": self._seconds(),
            "best": [self.best, self.best_step, self.stale],
            "validation": [self.validation, self.validated],
            "loss": self.loss,
            "scaler": self.scaler.state_dict(),
        }
        packed = {name: value.detach().contiguous() for name, value in tensors.items()}
        write_beside(path, save(packed, metadata={"fracsim_checkpoint": json.dumps(header)}))

    def _load(self, path: Path) -> None:
        from safetensors import SafetensorError
        from safetensors.torch import load

        data = path.read_bytes()
        try:
            tensors = load(data)
            header = header_of(data, "fracsim_checkpoint")
        except (SafetensorError, KeyError, ValueError, TypeError) as error:
            raise ModelError(f"{path}: not a checkpoint of fracsim; name another file or remove it") from error
        if header.get("format") != FORMAT or header.get("identity") != self.identity:
            raise ModelError(
                f"{path}: the checkpoint of another training (its data, options or seed differ); "
                "name another file, or remove it to begin anew"
            )

        def part(prefix: str) -> dict[str, torch.Tensor]:
            return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}

        self.module.load_state_dict(part("weights."))
        self.best_weights = {name: value.to(self.device) for name, value in part("best.").items()}
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, value in part("optimiser.").items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": state})
        self.step, self.before = int(header["step"]), float(header["seconds"])
        self.best, self.best_step, self.stale = header["best"]
        (self.validation, self.validated), self.loss = header["validation"], header["loss"]
        if header["scaler"]:
            self.scaler.load_state_dict(header["scaler"])


@contextmanager
def _processes(device: torch.device) -> Iterator[tuple[int, int]]:
    """(rank, number of processes), joined with those that torchrun started."""
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


@contextmanager
def _interrupts_held(wanted: bool) -> Iterator[list[int]]:
    """Ctrl-C is only noted, for it may come in the middle of a step, whose weights are worth nothing; a second one
    is raised at once."""
    noted: list[int] = []
    if not wanted or threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, _: types.FrameType | None) -> None:
        if noted:
            raise KeyboardInterrupt
        noted.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _log(folder: Path | None, step: int) -> Iterator[Callable[[str, float, int], None]]:
    if folder is None:
        yield lambda name, value, step: None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise MissingExtraError("tensorboard", "train") from error
    writer = SummaryWriter(str(folder), purge_step=step)  # type: ignore[no-untyped-call]
    try:
        yield writer.add_scalar
    finally:
        writer.close()  # type: ignore[no-untyped-call]
