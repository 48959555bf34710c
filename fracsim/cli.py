"""The command line: one program, a subcommand a task, figures to a file with ``--json``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import AssetError, DatasetError, FracsimError, ModelError

if TYPE_CHECKING:
    from .asset import BreakableAsset
    from .impulse import Impulse


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code: 0, 2 for bad input, 130 when interrupted."""
    parser = argparse.ArgumentParser(prog="fracsim", description="Breakable objects for PyBullet and Gymnasium.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    bake = commands.add_parser("bake", help="make a breakable asset of a watertight mesh")
    bake.add_argument("mesh", type=Path, help="any format trimesh reads, in metres; one watertight component")
    bake.add_argument("--out", type=Path, help="the asset to write (default: the mesh's name with .frac)")
    bake.add_argument("--material", default="ceramic", help="glass, ceramic, plaster, stone or ice")
    bake.add_argument("--seed", type=int, default=0)
    bake.add_argument("--truth", default="modal", help="what it learns from: modal (default), elastic or radial")
    bake.add_argument("--cells", type=int, default=5000, help="of the solid that is cut up")
    bake.add_argument("--modes", type=int, default=20, help="fracture modes")
    bake.add_argument("--samples", type=int, default=250000, help="impulses to learn from and be tested on")
    bake.add_argument("--steps", type=int, default=8000, help="of training")
    bake.add_argument("--workers", type=int, default=2, help="processes that make samples")
    bake.add_argument("--quiet", action="store_true", help="no progress bars")
    bake.set_defaults(run=_bake)

    fracture = commands.add_parser("fracture", help="break an asset and say what comes of it")
    fracture.add_argument("asset", help="a file, or the name of an asset that ships")
    fracture.add_argument("--out", type=Path, help="a folder to write the pieces to, as OBJ files")
    fracture.set_defaults(run=_fracture)

    view = commands.add_parser("view", help="draw how an asset breaks: field, pieces, convex parts")
    view.add_argument("asset", help="a file, or the name of an asset that ships")
    view.add_argument("--count", type=int, default=3, help="blows, from few pieces to many (default: 3)")
    view.add_argument("--out", type=Path, help="the picture (default: the asset's name with .png)")
    view.set_defaults(run=_view)
    for command in (fracture, view):
        command.add_argument("--point", type=float, nargs=3, metavar=("X", "Y", "Z"), help="m, in the asset's frame")
        command.add_argument("--direction", type=float, nargs=3, metavar=("X", "Y", "Z"))
        command.add_argument("--magnitude", type=float, help="N·s")
        command.add_argument("--seed", type=int, default=0, help="draws the impulse where none is given")
        command.add_argument("--predictor", default="field", help="field, interfaces or modes")
        command.add_argument("--material", help="another than the asset's own")
        command.add_argument("--scale", type=float, default=1.0, help="times the asset's own size")

    info = commands.add_parser("info", help="say what an asset holds and how good its model is")
    info.add_argument("asset", help="a file, or the name of an asset that ships")
    info.set_defaults(run=_info)

    tune = commands.add_parser("tune", help="search for an architecture that errs little and answers fast")
    tune.add_argument("dataset", type=Path)
    tune.add_argument("--model", default="mlp", help="mlp (default), deltaconv, field or interfaces")
    tune.add_argument("--trials", type=int, default=20, help="that the study shall hold in the end")
    tune.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="an option that is held fixed")
    tune.add_argument("--range", action="append", default=[], metavar="NAME=LOW:HIGH", help="of an option, to seek in")
    tune.add_argument("--population", type=int, default=20, help="trials a generation (default: 20)")
    tune.add_argument("--epochs", type=int, help="of each fit")
    tune.add_argument("--steps", type=int, help="of each fit")
    tune.add_argument("--seconds", type=float, help="of each fit")
    tune.add_argument("--batch", type=int, help="training points or impulses a step")
    tune.add_argument("--rate", type=float, help="learning rate")
    tune.add_argument("--samples", type=int, help="at most so many of the dataset's")
    tune.add_argument("--folds", type=int, default=5, help="that each trial is fitted and judged on (default: 5)")
    tune.add_argument("--seed", type=int, default=0)
    tune.add_argument("--study", help="its name (default: the dataset's and the model's)")
    tune.add_argument("--storage", help="a file or a database URL, shared by all workers (default: OUT/study.log)")
    tune.add_argument("--out", type=Path, help="the folder for figures (default: tune_MODEL)")
    tune.add_argument("--quiet", action="store_true", help="no progress bars")
    tune.set_defaults(run=_tune)

    evaluate = commands.add_parser("evaluate", help="measure models, segmentations and meshes of a plan side by side")
    evaluate.add_argument("plan", type=Path, help="a TOML file, such as benchmarks/evaluation.toml")
    evaluate.add_argument("--out", type=Path, help="the folder for tables and pictures (default: the plan's name)")
    evaluate.add_argument("--work", type=Path, help="the folder for what can be gone on from (default: OUT/work)")
    evaluate.add_argument("--meshes", default="", help="only these of the plan, separated by commas")
    evaluate.add_argument("--again", action="store_true", help="measure anew, with the models that are there")
    evaluate.add_argument("--quiet", action="store_true", help="no progress bars")
    evaluate.set_defaults(run=_evaluate)

    dataset = commands.add_parser("dataset", help="make a file of fracture samples, or say what is in one")
    actions = dataset.add_subparsers(dest="action", required=True, metavar="ACTION")
    make = actions.add_parser("make", help="make a dataset, go on with one, or mend one")
    make.add_argument("mesh", type=Path, nargs="?", help="a watertight mesh; not needed with --like")
    make.add_argument("--out", type=Path, help="the file (default: the mesh's name with .h5)")
    make.add_argument("--samples", type=int, help="that the file shall hold in the end (default: 1000)")
    make.add_argument("--append", type=int, metavar="N", help="instead: so many more than it holds")
    make.add_argument("--like", type=Path, metavar="FILE", help="make that dataset again from its own header")
    make.add_argument("--seed", type=int, help="default: 0")
    make.add_argument("--truth", help="modal (default), elastic or radial")
    make.add_argument("--cells", type=int, help="of the solid that is cut up (default: 5000)")
    make.add_argument("--modes", type=int, help="fracture modes, of the modal and elastic truths (default: 20)")
    make.add_argument("--workers", type=int, default=1, help="processes")
    make.add_argument("--backend", default="joblib", help="joblib, on this machine, or ray, on a cluster")
    make.add_argument("--quiet", action="store_true", help="no progress bars")
    make.set_defaults(run=_dataset_make)
    describe = actions.add_parser("info", help="say what is in a dataset, check it, and draw some of it")
    describe.add_argument("dataset", type=Path)
    describe.add_argument("--out", type=Path, help="the picture (default: the dataset's name with .png)")
    describe.add_argument("--seed", type=int, default=0, help="chooses the samples in the picture")
    describe.set_defaults(run=_dataset_info)

    train = commands.add_parser("train", help="fit a model to a dataset")
    train.add_argument("dataset", type=Path)
    train.add_argument("--model", default="mlp", help="mlp (default), deltaconv, field, interfaces, shared or nearest")
    train.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the model's")
    train.add_argument("--epochs", type=int, help="over the training samples")
    train.add_argument("--steps", type=int, help="of the optimiser")
    train.add_argument("--seconds", type=float, help="instead of a number of steps, what time allows")
    train.add_argument("--batch", type=int, help="training points or impulses a step")
    train.add_argument("--rate", type=float, help="learning rate")
    train.add_argument("--patience", type=int, help="validations without progress that end it; keeps the best weights")
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--threads", type=int, help="of torch (default: 1)")
    train.add_argument("--device", help="auto (default), cpu, cuda or cuda:N")
    train.add_argument("--out", type=Path, help="the model (default: DATASET_MODEL.safetensors)")
    train.add_argument("--checkpoint", type=Path, metavar="FILE", help="kept while training, and taken up if there")
    train.add_argument("--log", type=Path, metavar="DIR", help="a folder for TensorBoard")
    train.add_argument("--quiet", action="store_true", help="no progress bars")
    train.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="measure the running simulation on this machine")
    bench.add_argument("name", help="latency, idle, decomposition, timestep, stability or soak")
    bench.add_argument("--quick", action="store_true", help="a short run, to see that it works")
    bench.add_argument("--seed", type=int, default=0)
    bench.add_argument("--out", type=Path, help="a folder for runtime_NAME.json, .md and .png")
    bench.add_argument("--quiet", action="store_true", help="no progress bar")
    bench.set_defaults(run=_bench)

    for command in (bake, fracture, view, info, make, describe, train, evaluate, tune, bench):
        command.add_argument("--json", type=Path, metavar="FILE", help="write the figures here")
    options = parser.parse_args(arguments)
    try:
        for path in (options.json, getattr(options, "out", None)):
            if path is not None and not path.absolute().parent.is_dir():
                raise AssetError(f"{path}: the folder {path.parent} does not exist; create it first")
        for path in (options.json, options.out if options.command in ("bake", "dataset", "train", "view") else None):
            if path is not None and path.is_dir():
                raise AssetError(f"{path}: is a folder; name a file in it")
        figures = options.run(options)
        if options.json is not None:
            from .asset import write_beside

            write_beside(options.json, (json.dumps(figures, indent=2) + "\n").encode())
    except FracsimError as error:
        print(f"fracsim: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        kept = "nothing was written"
        if options.command == "dataset":
            kept = "finished blocks of samples are kept; ask for the total with --samples to go on"
        elif options.command == "tune":
            kept = "finished trials are kept; run the same command again to go on"
        elif options.command == "evaluate":
            kept = "what was measured and trained is kept; run the same command again to go on"
        elif options.command == "train" and options.checkpoint is None:
            kept += "; with --checkpoint FILE, training could go on"
        elif options.command == "train" and options.checkpoint.exists():
            kept = f"{options.checkpoint} keeps what was learnt; run the same command again to go on"
        print(f"fracsim: interrupted; {kept}", file=sys.stderr)
        return 130
    return 0


def _bake(options: argparse.Namespace) -> dict[str, Any]:
    from .baking import BakeOptions, bake, model_for

    out = options.out or Path(options.mesh.stem + ".frac")
    learning = model_for(options.truth)
    learning = replace(learning, training=replace(learning.training, steps=options.steps))
    asset = bake(
        options.mesh,
        options.material,
        options.seed,
        BakeOptions(
            truth=options.truth,
            cells=options.cells,
            modes=options.modes,
            samples=options.samples,
            workers=options.workers,
            model=learning,
        ),
        progress=not options.quiet,
    )
    asset.save(out)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")
    _print_figures(asset.metadata)
    test = asset.metadata["test"]
    if test["ari"] < test["ari_nearest_impulse"]:
        print("fracsim: the model is worse than answering with the most similar training impulse", file=sys.stderr)
    return asset.metadata


def _tune(options: argparse.Namespace) -> dict[str, Any]:
    import hashlib

    from .models.base import Body, model_class
    from .progress import Stages
    from .storage import Dataset
    from .train import options_from
    from .tune import Search, open_study, search_space, summary, tune, write_figures

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
            body, samples = Body.read(dataset, stage.ticker("distances"))
        samples = samples.rows(slice(options.samples))
        source = f"{len(samples)} of {hashlib.sha256(header.encode()).hexdigest()}"
        search = Search(options.model, fixed, ranges, options.folds, options.seed, source)
        out.mkdir(exist_ok=True)
        name = options.study or f"{options.dataset.stem} {options.model}"
        study = open_study(options.storage or str(out / "study.log"), name, search)
        tune(search, body, samples, study, options.trials, options.population, stage.ticker("trials"))
    found = summary(study, search)
    for path in write_figures(found, out):
        print(path)
    _print_figures(found)
    if found["chosen"] is None:
        raise ModelError(f"{out / 'trials.json'}: no trial finished; it says why")
    chosen = found["trials"][found["chosen"]]
    parameters = " ".join(f"--set {name}={value}" for name, value in chosen["parameters"].items())
    print(f"chosen: trial {chosen['number']}, {parameters}")
    print(f"  validation AMAE {chosen['amae']:.5f}, {chosen['seconds'] * 1e3:.3g} ms a query")
    return found


def _bench(options: argparse.Namespace) -> dict[str, Any]:
    from .bench import NAMES, run
    from .progress import Stages

    if options.name not in NAMES:
        raise FracsimError(f"unknown benchmark {options.name!r}; use one of {', '.join(NAMES)}")
    with Stages(not options.quiet) as stage:
        figures = run(options.name, options.quick, options.seed, options.out, stage.ticker(options.name))
    print(figures["table"])
    return figures


def _settings(texts: list[str], flag: str = "--set") -> dict[str, str]:
    settings: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ModelError(f"{flag} takes NAME=VALUE, got {text!r}")
        settings[name] = value
    return settings


def _evaluate(options: argparse.Namespace) -> dict[str, Any]:
    from .evaluate import evaluate, read_plan
    from .report import write_report

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


def _dataset_make(options: argparse.Namespace) -> dict[str, Any]:
    import resource
    import time

    from .generator import TruthOptions
    from .mesh import read_surface, refine
    from .storage import Dataset, make_dataset, regenerate

    begin = time.perf_counter()
    if (options.mesh is None) == (options.like is None):
        raise DatasetError("give a mesh, or --like and a dataset to make again")
    out = options.out or Path((options.mesh or options.like).stem + (".h5" if options.mesh else "_again.h5"))
    progress = not options.quiet
    if options.like is not None:
        for name in ("samples", "append", "seed", "truth", "cells", "modes"):
            if getattr(options, name) is not None:
                raise DatasetError(f"--{name} cannot be given with --like, whose header says it")
        seconds = regenerate(options.like, out, options.workers, options.backend, progress)
    else:
        given = {name: getattr(options, name) for name in ("truth", "cells", "modes")}
        truth = TruthOptions(**{name: value for name, value in given.items() if value is not None})
        total = 1000 if options.samples is None else options.samples
        if options.append is not None:
            if options.samples is not None or options.append < 1:
                raise DatasetError("--append takes a number of at least 1, and no --samples beside it")
            with Dataset(out) as there:
                total = there.held + options.append
        surface = refine(read_surface(options.mesh))
        seed = options.seed or 0
        seconds = make_dataset(out, surface, total, seed, truth, None, options.workers, options.backend, progress)
    figures = _describe(out)
    figures["seconds"] = {**seconds, "total": time.perf_counter() - begin}
    # Linux counts in KiB. Of this process and of the largest of its workers.
    peak = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    figures["peak_memory_mb"] = max(peak) * 1024 / 1e6
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")
    _print_figures(figures)
    return figures


def _dataset_info(options: argparse.Namespace) -> dict[str, Any]:
    from .view import picture_sheet

    out = options.out or options.dataset.with_suffix(".png")
    if options.dataset.resolve() in (out.resolve(), options.json and options.json.resolve()):
        raise DatasetError(f"{options.dataset}: would be overwritten; name another file with --out or --json")
    figures = _describe(options.dataset)
    header = figures["header"]
    truth = ", ".join(f"{key} {value}" for key, value in header["truth"].items())
    print(f"{options.dataset}: {figures['mesh']}; {truth}; seed {header['seed']}; fracsim {header['fracsim']}")
    _print_figures(figures)
    for name in figures["damaged"]:
        print(f"  DAMAGED {name}")
    if figures["pieces"]["breaking"]:
        picture_sheet(options.dataset, out, abs(options.seed))
        print(f"{out}: some of its samples")
    return figures


def _train(options: argparse.Namespace) -> dict[str, Any]:
    import hashlib
    from dataclasses import asdict

    from .metrics import amae
    from .models.base import Body, model_class, save_model
    from .progress import Stages
    from .storage import Dataset
    from .train import Run, options_from, rank

    kind = model_class(options.model)
    names = ("epochs", "steps", "seconds", "batch", "rate", "patience", "threads", "device")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    chosen = options_from(kind.options_type, _settings(options.set), given)
    out = options.out or Path(f"{options.dataset.stem}_{options.model}.safetensors")
    first = rank() == 0
    with Stages(first and not options.quiet) as stage:
        with Dataset(options.dataset) as dataset:
            header = json.dumps(dataset.header, sort_keys=True)
            body, samples = Body.read(dataset, stage.ticker("distances"))
        source = {"header": hashlib.sha256(header.encode()).hexdigest(), "samples": len(samples)}
        architecture = {name: value for name, value in asdict(chosen).items() if name != "training"}
        label = json.dumps([options.model, source, architecture], sort_keys=True)
        tick = stage.ticker("training")
        run = Run(options.checkpoint, options.checkpoint is not None, label=label, log=options.log, progress=tick)
        model, training = kind.fit(body, samples, chosen, options.seed, run)
        stage("validation")
        held_out = samples.part(1).rows(slice(200))
        error = amae(body.fields(held_out.labels), model.predict(held_out.blows)) if len(held_out) else float("nan")
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
        _print_figures(figures)
        print(f"  validation AMAE {error:.5f} over {len(held_out)} impulses")
    else:
        options.json = None
    return figures


def _describe(path: Path) -> dict[str, Any]:
    import numpy as np

    from .dataset import KINDS
    from .storage import Dataset

    with Dataset(path) as dataset:
        damaged = [name for _, name in dataset.damage()]
        splits, kinds = np.zeros(3, dtype=np.int64), np.zeros(len(KINDS), dtype=np.int64)
        pieces: list[Any] = []
        for block in dataset.blocks(skip_damaged=True):
            splits += np.bincount(block.split, minlength=3)
            kinds += np.bincount(block.kind, minlength=len(KINDS))
            pieces.append(block.labels.max(axis=1, initial=0) + 1)
        count = np.concatenate([np.zeros(0, dtype=np.int64), *pieces])
        broken = count > 1
        return {
            "header": dataset.header,
            "mesh": dataset.surface.name,
            "damaged": damaged,
            "counts": {
                "samples": len(count),
                "damaged_chunks": len(damaged),
                "vertices": len(dataset.surface.vertices),
                "parts": len(dataset.parts.volumes),
                "interfaces": len(dataset.file["interfaces/pairs"]),
                "links": len(dataset.links),
            },
            "splits": dict(zip(("train", "validation", "test"), splits.tolist(), strict=True)),
            "kinds": dict(zip(KINDS, kinds.tolist(), strict=True)),
            "pieces": {
                "breaking": int(broken.sum()),
                "median": float(np.median(count[broken])) if broken.any() else 0.0,
                "most": int(count.max(initial=0)),
            },
        }


def _print_figures(metadata: dict[str, Any]) -> None:
    for group in ("counts", "splits", "kinds", "pieces", "seconds", "test"):
        if group in metadata:
            print(f"  {group}")
        for key, value in metadata.get(group, {}).items():
            print(f"    {key:<36}{value:>12.5g}" if isinstance(value, float) else f"    {key:<36}{value:>12}")


def _fracture(options: argparse.Namespace) -> dict[str, Any]:
    from .asset import write_beside

    asset = _asset_of(options)
    impulse = _impulse_of(options) or asset.sample_impulses(1, options.seed)[0]
    result = asset.fracture(impulse, options.predictor)
    print(
        f"{asset.name}, {asset.size:.3g} m of {asset.material.name}, {asset.mass:.4g} kg: "
        f"{impulse.magnitude:.4g} N·s at {impulse.point.round(4).tolist()} along {impulse.direction.round(4).tolist()}"
    )
    print(f"severity {result.severity:.3g}{' (clamped)' if result.clamped else ''}: {len(result.pieces)} piece(s)")
    for index, piece in enumerate(result.pieces):
        centre = piece.center_of_mass.round(4).tolist()
        print(f"  {index:>3}  {piece.mass:.5g} kg, centre of mass {centre}, {len(piece.hulls)} convex parts")
    print("  ".join(f"{stage} {ms:.2f} ms" for stage, ms in result.timings.items()))
    if options.out is not None:
        options.out.mkdir(exist_ok=True)
        for index, piece in enumerate(result.pieces):
            lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in piece.vertices.tolist()]
            lines += [f"f {a} {b} {c}" for a, b, c in (piece.faces + 1).tolist()]
            write_beside(options.out / f"{asset.name}_{index:03d}.obj", ("\n".join(lines) + "\n").encode())
    return {
        "impulse": {
            "point": impulse.point.tolist(),
            "direction": impulse.direction.tolist(),
            "magnitude": impulse.magnitude,
        },
        "severity": result.severity,
        "clamped": result.clamped,
        "predictor": result.predictor,
        "pieces": [
            {"mass": piece.mass, "volume": piece.volume, "center_of_mass": piece.center_of_mass.tolist()}
            for piece in result.pieces
        ],
        "timings": result.timings,
    }


def _asset_of(options: argparse.Namespace) -> BreakableAsset:
    from .asset import load

    asset = load(options.asset).scaled(options.scale)
    return asset.with_material(options.material) if options.material else asset


def _impulse_of(options: argparse.Namespace) -> Impulse | None:
    """What the command line gives, if anything."""
    from .impulse import Impulse

    given = (options.point, options.direction, options.magnitude)
    if all(value is None for value in given):
        return None
    if any(value is None for value in given):
        raise FracsimError("give --point, --direction and --magnitude together, or none for a random impulse")
    return Impulse(*given)


def _view(options: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from .view import picture_fractures

    asset = _asset_of(options)
    impulse = _impulse_of(options)
    if options.count < 1:
        raise FracsimError(f"--count must be at least 1, got {options.count}")
    if impulse is None:
        drawn = asset.sample_impulses(20 * options.count, options.seed)
        found = [(one, asset.fracture(one, options.predictor)) for one in drawn]
        found = sorted((pair for pair in found if pair[1].broken), key=lambda pair: len(pair[1].pieces))
        if not found:
            raise FracsimError(f"{asset.name}: none of {len(drawn)} random impulses breaks it; give one")
        chosen = np.linspace(0, len(found) - 1, options.count).round().astype(int)
        blows = [found[k] for k in dict.fromkeys(chosen.tolist())]
    else:
        blows = [(impulse, asset.fracture(impulse, options.predictor))]
    out = options.out or Path(f"{asset.name}.png")
    picture_fractures(asset, [([one], fracture) for one, fracture in blows], out)
    print(f"{out}: {asset.name} in {', '.join(str(len(fracture.pieces)) for _, fracture in blows)} pieces")
    return {
        "out": str(out),
        "blows": [
            {
                "point": one.point.tolist(),
                "direction": one.direction.tolist(),
                "magnitude": one.magnitude,
                "severity": fracture.severity,
                "pieces": len(fracture.pieces),
            }
            for one, fracture in blows
        ],
    }


def _info(options: argparse.Namespace) -> dict[str, Any]:
    from .asset import load

    asset = load(options.asset)
    print(f"{asset.name}: {asset.size:.4g} m of {asset.material.name}, {asset.mass:.4g} kg, {asset.volume:.4g} m³")
    _print_figures(asset.metadata)
    return {
        "name": asset.name,
        "size": asset.size,
        "mass": asset.mass,
        "volume": asset.volume,
        "material": asset.material.to_dict(),
        **asset.metadata,
    }


if __name__ == "__main__":
    sys.exit(main())
