"""One trainer for every model that torch fits, on one device or, under torchrun, on several. Offline only.

A model wraps what it fits in a ``Learner`` and has a field ``training: TrainingOptions`` among its options.
"""

from __future__ import annotations

import hashlib
import json
import math
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
from .checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from .devices import device_for, joined_processes, sum_gradients
from .options import BUDGETS, OPTIMISERS, PRECISIONS, TrainingOptions
from .shuffle import derived_seed, shuffled

try:
    import torch
    import torch.distributed as dist
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

LOSS_WINDOW = 20  # steps that a logged loss is the mean of
PROGRESS_INTERVAL = 0.2  # seconds between two reports of progress: more often than the eye follows costs time


@dataclass(frozen=True)
class Run:
    """What goes on around a training.

    Attributes
    ----------
    checkpoint : Path or None
        A file with all that is needed to go on. It is written at the end of every epoch, after ``every`` seconds, and
        on Ctrl-C.
    resume : bool
        Whether to go on from the checkpoint where the file exists.
    every : float
        Seconds between two checkpoints.
    label : str
        What is trained, so that a checkpoint of something else is not taken for it.
    log : Path or None
        A folder for TensorBoard.
    progress : callable
        Called with the share of the budget that is spent, 0 to 1.
    """

    checkpoint: Path | None = None
    resume: bool = False
    every: float = 60.0
    label: str = ""
    log: Path | None = None
    progress: Callable[[float], None] = lambda _: None


class Learner(Protocol):
    """What the trainer fits: training rows, a loss on any of them, and an error on held-out samples."""

    @property
    def module(self) -> torch.nn.Module:
        """The network."""
        ...

    @property
    def count(self) -> int:
        """How many training rows it has."""
        ...

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """Group the parameters for the optimiser.

        Parameters
        ----------
        rate : float
            The learning rate; a group may have a multiple of it.

        Returns
        -------
        list of dict
            Parameter groups as torch's optimisers take them.
        """
        ...

    def loss(self, rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Work out the mean loss of a batch.

        Parameters
        ----------
        rows : Tensor of int64, shape (B,)
            Training rows, on the CPU.
        generator : Generator
            The source of whatever is drawn at random, on the CPU.

        Returns
        -------
        Tensor, shape ()
            The loss.
        """
        ...

    def validate(self) -> float:
        """Work out the error on held-out samples; less is better.

        It is called in evaluation mode and without gradients.

        Returns
        -------
        float
            The error.
        """
        ...


def train(learner: Learner, options: TrainingOptions, seed: int, run: Run | None = None) -> dict[str, float]:
    """Fit ``learner.module`` in place.

    On a CPU, a seed and a budget of epochs or steps fix the weights to the bit, whether or not the training was
    interrupted and resumed. Under torchrun every process takes a share of each batch and ends with the same weights;
    only the first writes files.

    Parameters
    ----------
    learner : Learner
        What is fitted.
    options : TrainingOptions
        How.
    seed : int
        At least 0.
    run : Run, optional
        Checkpoint, log and progress.

    Returns
    -------
    dict of str to float
        Figures of the training: rows, steps, epochs, seconds, processes, training_loss, validation, best_step.

    Raises
    ------
    ModelError
        Where the loss stops being finite, or the checkpoint is of another training.
    """
    run = run or Run()
    threads = torch.get_num_threads()
    torch.set_num_threads(options.threads)
    try:
        with (
            _interrupts_held(run.checkpoint is not None) as interrupted,
            joined_processes(device_for(options)) as place,
        ):
            return _Training(learner, options, seed, run, place).go(interrupted)
    finally:
        torch.set_num_threads(threads)


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
                if self.step % LOSS_WINDOW == 0:
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
                if self.rank == 0 and now - shown > PROGRESS_INTERVAL:
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
            sum_gradients(self.module)
        self.scaler.step(self.optimiser)
        self.scaler.update()
        self.step += 1

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
        """Share of the budget that is spent; it may exceed 1."""
        by_steps = self.step / self.last if self.last is not None else 0.0
        return max(by_steps, self._seconds() / self.options.seconds if self.options.seconds is not None else 0.0)

    def _seconds(self) -> float:
        return self.before + time.monotonic() - self.begin

    def _check_loss(self) -> None:
        """Take the mean of the losses since the last call; what is not finite must not be kept."""
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
        """Mark what is trained and how, except for how long and where."""
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
        if self.rank:
            return
        checkpoint = Checkpoint(
            self.module.state_dict(),
            self.best_weights,
            self.optimiser.state_dict()["state"],
            self.step,
            self._seconds(),
            (self.best, self.best_step, self.stale),
            (self.validation, self.validated),
            self.loss,
            self.scaler.state_dict(),
        )
        save_checkpoint(path, self.identity, checkpoint)

    def _load(self, path: Path) -> None:
        checkpoint = load_checkpoint(path, self.identity)
        self.module.load_state_dict(checkpoint.weights)
        self.best_weights = {name: value.to(self.device) for name, value in checkpoint.best_weights.items()}
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": checkpoint.optimiser})
        self.step, self.before = checkpoint.step, checkpoint.seconds
        self.best, self.best_step, self.stale = checkpoint.best
        (self.validation, self.validated), self.loss = checkpoint.validation, checkpoint.loss
        if checkpoint.scaler:
            self.scaler.load_state_dict(checkpoint.scaler)


@contextmanager
def _interrupts_held(wanted: bool) -> Iterator[list[int]]:
    """Note Ctrl-C instead of raising it: in the middle of a step weights are half changed.

    A second Ctrl-C is raised at once.
    """
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
