"""Commands on models: ``train``, ``tune`` and ``evaluate``.

The command line's main function adds them; each imports what it needs when it runs.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ..common.errors import ModelError
from .arguments import Commands, add_common, add_model, add_seed, settings_of
from .output import print_figures, require_file, require_folder

VALIDATED = 200  # validation impacts, at most, that train's own figure is taken over: a second's work


def add_commands(commands: Commands) -> None:
    """Add the commands on models to the command line.

    Parameters
    ----------
    commands : Commands
        What ``ArgumentParser.add_subparsers`` returned.
    """
    add_train(commands.add_parser("train", help="fit a model to a dataset"))
    add_tune(commands.add_parser("tune", help="search for a model's options that give small errors and fast answers"))
    add_evaluate(commands.add_parser("evaluate", help="measure the models, segmentations and meshes of a plan"))


def _add_training(parser: argparse.ArgumentParser) -> None:
    """Add how long a model is trained, and with what batches."""
    parser.add_argument("--epochs", type=int, help="passes over the training samples")
    parser.add_argument("--steps", type=int, help="steps of the optimiser")
    parser.add_argument("--seconds", type=float, help="time to train, instead of a number of steps")
    parser.add_argument("--batch", type=int, help="training points or impacts a step")
    parser.add_argument("--rate", type=float, help="learning rate")


def add_train(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim train``."""
    parser.add_argument("dataset", type=Path, help="a file that fracsim dataset make wrote")
    add_model(parser, "fit")
    _add_training(parser)
    parser.add_argument("--patience", type=int, metavar="N", help="stop after N validations without progress")
    add_seed(parser, "seed of all random choices")
    parser.add_argument("--threads", type=int, help="of torch (default: 1)")
    parser.add_argument("--device", metavar="NAME", help="auto (default), cpu, cuda or cuda:N")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the model (default: DATASET_MODEL.safetensors)")
    parser.add_argument(
        "--checkpoint", type=Path, metavar="FILE", help="keep the state of training here; continue from it if it exists"
    )
    parser.add_argument("--log", type=Path, metavar="FOLDER", help="write figures for TensorBoard to this folder")
    add_common(parser, quiet=True)
    parser.set_defaults(run=train, check_out=require_file, interrupted=_kept_of_training)


def add_tune(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim tune``."""
    parser.add_argument("dataset", type=Path, help="a file that fracsim dataset make wrote")
    add_model(parser, "tune")
    parser.add_argument("--trials", type=int, default=20, help="the total that the study shall hold (default: 20)")
    parser.add_argument(
        "--range", action="append", default=[], metavar="NAME=LOW:HIGH", help="where to search an option of the model"
    )
    parser.add_argument("--population", type=int, default=20, help="trials a generation (default: 20)")
    _add_training(parser)
    parser.add_argument("--samples", type=int, help="use no more than so many of the dataset's samples")
    parser.add_argument("--folds", type=int, default=5, help="folds of the cross-validation (default: 5)")
    parser.add_argument(
        "--segmentation", default="watershed", metavar="NAME", help="cuts the predicted fields (default: watershed)"
    )
    add_seed(parser, "seed of all random choices")
    parser.add_argument("--study", metavar="NAME", help="the study's name (default: the dataset's and the model's)")
    parser.add_argument("--storage", help="a file or a database URL, the same for all workers (default: OUT/study.log)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for tables and pictures (default: tune_MODEL)")
    add_common(parser, quiet=True)
    parser.set_defaults(
        run=tune,
        check_out=require_folder,
        interrupted=lambda _: "finished trials are kept; run the same command again to go on",
    )


def add_evaluate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim evaluate``."""
    parser.add_argument("plan", type=Path, help="a TOML file, such as benchmarks/evaluation.toml")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for tables and pictures (default: the plan's name)")
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="for datasets and models (default: OUT/work)")
    parser.add_argument("--meshes", default="", metavar="NAMES", help="only these of the plan, separated by commas")
    parser.add_argument("--again", action="store_true", help="measure again, with the models that are trained already")
    add_common(parser, quiet=True)
    parser.set_defaults(
        run=evaluate,
        check_out=require_folder,
        interrupted=lambda _: "what was measured and trained is kept; run the same command again to go on",
    )


def _kept_of_training(options: argparse.Namespace) -> str:
    """Say what an interrupted training leaves behind."""
    if options.checkpoint is None:
        return "nothing was written; with --checkpoint FILE, training could go on"
    if options.checkpoint.exists():
        return f"{options.checkpoint} keeps what was learnt; run the same command again to go on"
    return "nothing was written"


def _training_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Collect the arguments that stand on the command line."""
    return {name: getattr(options, name) for name in names if getattr(options, name) is not None}


def train(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim train``."""
    import hashlib
    from dataclasses import asdict

    from ..common.progress import Stages
    from ..data.dataset import Dataset
    from ..learning import model_class
    from ..learning.body import BodyGeometry
    from ..learning.devices import rank
    from ..learning.model import save_model
    from ..learning.options import options_from
    from ..learning.trainer import Run
    from ..metrics import amae

    kind = model_class(options.model)
    training = _training_options(
        options, "epochs", "steps", "seconds", "batch", "rate", "patience", "threads", "device"
    )
    chosen = options_from(kind.options_type, settings_of(options.set), training)
    out = require_file(options.out or Path(f"{options.dataset.stem}_{options.model}.safetensors"))
    if options.checkpoint is not None:
        require_file(options.checkpoint)
    if options.log is not None:
        require_folder(options.log)
    first = rank() == 0
    with Stages(first and not options.quiet) as stage:
        with Dataset(options.dataset) as dataset:
            header = json.dumps(dataset.header, sort_keys=True)
            body, samples = BodyGeometry.read(dataset, stage.ticker("distances"))
        source = {"header": hashlib.sha256(header.encode()).hexdigest(), "samples": len(samples)}
        architecture = {name: value for name, value in asdict(chosen).items() if name != "training"}
        label = json.dumps([options.model, source, architecture], sort_keys=True)
        tick = stage.ticker("training")
        run = Run(options.checkpoint, options.checkpoint is not None, label=label, log=options.log, progress=tick)
        model, fitting = kind.fit(body, samples, chosen, options.seed, run)
        stage("validation")
        validation = samples.of_split(1).take(slice(VALIDATED))
        error = (
            amae(body.fields(validation.labels), model.predict(validation.impacts)) if len(validation) else float("nan")
        )
    figures = {
        "model": options.model,
        "dataset": source,
        "seed": options.seed,
        "options": asdict(chosen),
        "training": fitting,
        "validation": {"impulses": len(validation), "amae": error},
        "seconds": {**stage.seconds, "total": sum(stage.seconds.values())},
    }
    if first:
        save_model(model, out, figures)
        print(f"{out}: {options.model}, {out.stat().st_size / 1e6:.1f} MB")
        print_figures(figures)
        print(f"  validation AMAE {error:.5f} over {len(validation)} impulses")
    else:  # the first of several processes writes
        options.json = None
    return figures


def tune(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim tune``."""
    import hashlib

    from ..common.progress import Stages
    from ..data.dataset import Dataset
    from ..learning import model_class
    from ..learning.body import BodyGeometry
    from ..learning.options import options_from
    from ..study.optuna_study import open_study
    from ..study.search_space import Search, search_space
    from ..study.tune import tune
    from ..study.tune_figures import write_figures
    from ..study.tune_summary import summary

    training = _training_options(options, "epochs", "steps", "seconds", "batch", "rate")
    if options.samples is not None and options.samples < 1:
        raise ModelError(f"--samples must be at least 1, got {options.samples}")
    ranges = search_space(options.model, settings_of(options.range, "--range"))
    fixed = options_from(model_class(options.model).options_type, settings_of(options.set), training)
    out = require_folder(options.out or Path(f"tune_{options.model}"))
    if options.storage is not None and "://" not in options.storage:  # a file, not a database
        require_file(Path(options.storage))
    with Stages(not options.quiet) as stage:
        with Dataset(options.dataset) as dataset:
            header = json.dumps(dataset.header, sort_keys=True)
            body, samples = BodyGeometry.read(dataset, stage.ticker("distances"))
        samples = samples.take(slice(options.samples))
        source = f"{len(samples)} of {hashlib.sha256(header.encode()).hexdigest()}"
        search = Search(options.model, fixed, ranges, options.folds, options.seed, source)
        out.mkdir(exist_ok=True)
        name = options.study or f"{options.dataset.stem} {options.model}"
        study = open_study(options.storage or str(out / "study.log"), name, search)
        progress = stage.ticker("trials")
        tune(search, body, samples, study, options.trials, options.population, progress, options.segmentation)
    figures = summary(study, search)
    for path in write_figures(figures, out):
        print(path)
    print_figures(figures)
    if figures["chosen"] is None:
        raise ModelError(f"{out / 'trials.json'}: no trial finished; the file says why")
    chosen = figures["trials"][figures["chosen"]]
    parameters = " ".join(f"--set {name}={value}" for name, value in chosen["parameters"].items())
    print(f"chosen: trial {chosen['number']}, {parameters}")
    print(f"  validation AMAE {chosen['amae']:.5f}, {chosen['seconds'] * 1e3:.3g} ms a query")
    return figures


def evaluate(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim evaluate``."""
    from ..study.evaluate import evaluate
    from ..study.plan import read_plan
    from ..study.report import write_report

    out = require_folder(options.out or Path(options.plan.stem))
    work = options.work or out / "work"
    if options.work is not None:
        require_folder(work)
    plan = read_plan(options.plan)
    meshes = tuple(name.strip() for name in options.meshes.split(",") if name.strip())
    figures = evaluate(plan, work, meshes, not options.quiet, options.again)
    for path in write_report(plan, figures, out, work, f"fracsim evaluate {options.plan}"):
        print(path)
    print((out / "evaluation_models.md").read_text(encoding="utf-8"))
    for name in figures["missing"]:
        print(f"fracsim: not measured yet: {name}", file=sys.stderr)
    return figures
