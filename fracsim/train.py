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
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from .asset import header_of, write_beside
from .breaking import separated
from .errors import MissingExtraError, ModelError
from .metrics import ALPHA
from .models.base import Body
from .udf import CAP

try:
    import torch
    import torch.distributed as dist
except ImportError as error:
    raise MissingExtraError("torch", "train") from error

IntArray = npt.NDArray[np.int64]
Options = TypeVar("Options")

OPTIMISERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
SCHEDULES = ("constant", "cosine")
PRECISIONS = {"auto": None, "fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
BUDGETS = ("epochs", "steps", "seconds")
FORMAT = 1
WINDOW = 20  # steps that a logged loss is the mean of
NEAR = 0.02  # of the largest extent: how far a crack's neighbourhood reaches, in ``amae_loss``


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


def amae_loss(predicted: torch.Tensor, truth: torch.Tensor, filled: float = 0.0) -> torch.Tensor:
    """The mean of |y - ŷ| / (1 + α|y|) (thesis, Eq. 4.5, α = 10).

    filled: how many times more an error counts that fills in a crack, where y is near 0 and ŷ above it: a crack with
    a gap parts nothing, while one that is too wide still does.
    """
    error = (predicted.float() - truth).abs() / (1.0 + ALPHA * truth)
    if filled:
        error = error * (1.0 + filled * torch.exp(-truth / NEAR) * (predicted > truth))
    return error.mean()


class Targets:
    """True fields, made as they are asked for: for each row the least distance to the interfaces that part pieces."""

    def __init__(self, body: Body, labels: IntArray, device: torch.device, nodes: bool = False) -> None:
        """labels: (N, A). nodes: whether edge midpoints can be asked for, too."""
        distances = body.distances if nodes else body.distances[:, : len(body.vertices)]
        self.distances = torch.as_tensor(np.ascontiguousarray(distances), device=device)  # (I, V or V + E)
        row, interface = np.nonzero(separated(labels, body.interfaces.pairs))
        count = np.bincount(row, minlength=len(labels))
        self.interface = torch.as_tensor(interface, device=device)
        self.count = torch.as_tensor(count, device=device)
        self.start = torch.as_tensor(np.cumsum(count) - count, device=device)

    def __call__(self, rows: torch.Tensor, columns: torch.Tensor | None = None) -> torch.Tensor:
        """(B, K) the fields of rows (B,) at columns (B, K), or (B, V) at all of them."""
        count = self.count[rows]
        owner = torch.repeat_interleave(count)  # (M,) which of the B each parted interface belongs to
        first = torch.cumsum(count, 0) - count
        place = self.start[rows][owner] + torch.arange(len(owner), device=owner.device) - first[owner]
        interface = self.interface[place]
        values = self.distances[interface] if columns is None else self.distances[interface[:, None], columns[owner]]
        result = torch.full((len(rows), values.shape[1]), CAP, device=values.device)
        return result.scatter_reduce(0, owner[:, None].expand_as(values), values, "amin")


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
                self._step(torch.from_numpy(shuffled(*ends, self.learner.count, _derived(self.seed, 0, epoch))))
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
        drawn = _derived(self.seed, 1, self.step, self.rank)
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


def shuffled(start: int, stop: int, count: int, seed: int) -> IntArray:
    """Places start to stop of a random order of ``count`` rows, without the rest of it: of points there may be
    billions, and of their order a few are ever asked for.

    A Feistel network permutes the least power of 4 that holds ``count``; what falls beyond goes through it again.
    """
    half = np.uint64(max(1, -(-(count - 1).bit_length() // 2)))
    mask = np.uint64((1 << int(half)) - 1)
    keys = np.random.SeedSequence(seed).generate_state(6, np.uint64)

    def permuted(rows: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
        left, right = rows >> half, rows & mask
        for key in keys:
            mixed = (right + key) * np.uint64(0x9E3779B97F4A7C15)  # the odd multiplier nearest 2⁶⁴ / golden ratio
            left, right = right, left ^ ((mixed ^ (mixed >> np.uint64(29))) >> np.uint64(17) & mask)
        return left << half | right

    rows = permuted(np.arange(start, stop, dtype=np.uint64))
    while len(beyond := np.flatnonzero(rows >= count)):
        rows[beyond] = permuted(rows[beyond])
    return rows.astype(np.int64)


def _derived(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0] >> np.uint64(1))


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
