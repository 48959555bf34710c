"""TODO cli.models."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ..common.errors import ModelError
from .output import print_figures


def tune(options: argparse.Namespace) -> dict[str, Any]:
    import hashlib

    from ..common.progress import Stages
    from ..data.dataset import Dataset
    from ..learning.body import BodyGeometry
    from ..learning.model import model_class
    from ..learning.options import options_from
    from ..study.optuna_study import open_study
    from ..study.search_space import Search, search_space
    from ..study.tune import tune
    from ..study.tune_figures import summary, write_figures

    names = ("epochs", "steps", "seconds", "batch", "rate")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.samples is not None and options.samples < 1:
        raise ModelError(f"--samples must be at least 1, got {options.samples}")
    ranges = search_space(options.model, _settings(options.range, "--range"))
    fixed = options_from(model_class(options.model).options_type, _settings(options.set), given)
    out = options.out or Path(f"tune_{options.model}")
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
        tune(search, body, samples, study, options.trials, options.population, stage.ticker("trials"))
    found = summary(study, search)
    for path in write_figures(found, out):
        print(path)
    print_figures(found)
    if found["chosen"] is None:
        raise ModelError(f"{out / 'trials.json'}: no trial finished; it says why")
    chosen = found["trials"][found["chosen"]]
    parameters = " ".join(f"--set {name}={value}" for name, value in chosen["parameters"].items())
    print(f"chosen: trial {chosen['number']}, {parameters}")
    print(f"  validation AMAE {chosen['amae']:.5f}, {chosen['seconds'] * 1e3:.3g} ms a query")
    return found


def _settings(texts: list[str], flag: str = "--set") -> dict[str, str]:
    settings: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ModelError(f"{flag} takes NAME=VALUE, got {text!r}")
        settings[name] = value
    return settings


def evaluate(options: argparse.Namespace) -> dict[str, Any]:
    from ..study.evaluate import evaluate
    from ..study.plan import read_plan
    from ..study.report import write_report

    out = options.out or Path(options.plan.stem)
    work = options.work or out / "work"
    plan = read_plan(options.plan)
    only = tuple(name.strip() for name in options.meshes.split(",") if name.strip())
    found = evaluate(plan, work, only, not options.quiet, options.again)
    for path in write_report(plan, found, out, work, f"fracsim evaluate {options.plan}"):
        print(path)
    print((out / "evaluation_models.md").read_text(encoding="utf-8"))
    for name in found["missing"]:
        print(f"fracsim: not measured yet: {name}", file=sys.stderr)
    return found


def train(options: argparse.Namespace) -> dict[str, Any]:
    import hashlib
    from dataclasses import asdict

    from ..common.progress import Stages
    from ..data.dataset import Dataset
    from ..learning.body import BodyGeometry
    from ..learning.model import model_class, save_model
    from ..learning.options import options_from
    from ..learning.trainer import Run, rank
    from ..metrics import amae

    kind = model_class(options.model)
    names = ("epochs", "steps", "seconds", "batch", "rate", "patience", "threads", "device")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    chosen = options_from(kind.options_type, _settings(options.set), given)
    out = options.out or Path(f"{options.dataset.stem}_{options.model}.safetensors")
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
        model, training = kind.fit(body, samples, chosen, options.seed, run)
        stage("validation")
        held_out = samples.of_split(1).take(slice(200))
        error = amae(body.fields(held_out.labels), model.predict(held_out.impacts)) if len(held_out) else float("nan")
    figures = {
        "model": options.model,
        "dataset": source,
        "seed": options.seed,
        "options": asdict(chosen),
        "training": training,
        "validation": {"impulses": len(held_out), "amae": error},
        "seconds": {**stage.seconds, "total": sum(stage.seconds.values())},
    }
    if first:
        save_model(model, out, figures)
        print(f"{out}: {options.model}, {out.stat().st_size / 1e6:.1f} MB")
        print_figures(figures)
        print(f"  validation AMAE {error:.5f} over {len(held_out)} impulses")
    else:
        options.json = None
    return figures
