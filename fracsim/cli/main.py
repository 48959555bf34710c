"""The command line: one program, a subcommand a task, figures to a file with ``--json``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..common.errors import AssetError, FracsimError
from . import assets, datasets, models


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code: 0, 2 for bad input, 130 when interrupted."""
    parser = argparse.ArgumentParser(prog="fracsim", description="Breakable objects for PyBullet and Gymnasium.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    bake = commands.add_parser("bake", help="make a breakable asset of a watertight mesh")
    bake.add_argument("mesh", type=Path, help="any format trimesh reads, in metres; one watertight component")
    bake.add_argument("--out", type=Path, help="the asset to write (default: the mesh's name with .frac)")
    bake.add_argument("--material", default="ceramic", help="glass, ceramic, plaster, stone or ice")
    bake.add_argument("--seed", type=int, default=0)
    bake.add_argument(
        "--simulator",
        "--truth",
        dest="simulator",
        default="modal",
        help="what it learns from: modal (default), elastic or radial",
    )
    bake.add_argument("--cells", type=int, default=5000, help="of the solid that is cut up")
    bake.add_argument("--modes", type=int, default=20, help="fracture modes")
    bake.add_argument("--samples", type=int, default=250000, help="impulses to learn from and be tested on")
    bake.add_argument("--steps", type=int, default=8000, help="of training")
    bake.add_argument("--workers", type=int, default=2, help="processes that make samples")
    bake.add_argument("--quiet", action="store_true", help="no progress bars")
    bake.set_defaults(run=assets.bake)

    fracture = commands.add_parser("fracture", help="break an asset and say what comes of it")
    fracture.add_argument("asset", help="a file, or the name of an asset that ships")
    fracture.add_argument("--out", type=Path, help="a folder to write the pieces to, as OBJ files")
    fracture.set_defaults(run=assets.fracture)

    view = commands.add_parser("view", help="draw how an asset breaks: field, pieces, convex parts")
    view.add_argument("asset", help="a file, or the name of an asset that ships")
    view.add_argument("--count", type=int, default=3, help="impacts, from few pieces to many (default: 3)")
    view.add_argument("--out", type=Path, help="the picture (default: the asset's name with .png)")
    view.set_defaults(run=assets.view)
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
    info.set_defaults(run=assets.info)

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
    tune.set_defaults(run=models.tune)

    evaluate = commands.add_parser("evaluate", help="measure models, segmentations and meshes of a plan side by side")
    evaluate.add_argument("plan", type=Path, help="a TOML file, such as benchmarks/evaluation.toml")
    evaluate.add_argument("--out", type=Path, help="the folder for tables and pictures (default: the plan's name)")
    evaluate.add_argument("--work", type=Path, help="the folder for what can be gone on from (default: OUT/work)")
    evaluate.add_argument("--meshes", default="", help="only these of the plan, separated by commas")
    evaluate.add_argument("--again", action="store_true", help="measure anew, with the models that are there")
    evaluate.add_argument("--quiet", action="store_true", help="no progress bars")
    evaluate.set_defaults(run=models.evaluate)

    dataset = commands.add_parser("dataset", help="make a file of fracture samples, or say what is in one")
    actions = dataset.add_subparsers(dest="action", required=True, metavar="ACTION")
    make = actions.add_parser("make", help="make a dataset, go on with one, or mend one")
    make.add_argument("mesh", type=Path, nargs="?", help="a watertight mesh; not needed with --like")
    make.add_argument("--out", type=Path, help="the file (default: the mesh's name with .h5)")
    make.add_argument("--samples", type=int, help="that the file shall hold in the end (default: 1000)")
    make.add_argument("--append", type=int, metavar="N", help="instead: so many more than it holds")
    make.add_argument("--like", type=Path, metavar="FILE", help="make that dataset again from its own header")
    make.add_argument("--seed", type=int, help="default: 0")
    make.add_argument("--simulator", "--truth", dest="simulator", help="modal (default), elastic or radial")
    make.add_argument("--cells", type=int, help="of the solid that is cut up (default: 5000)")
    make.add_argument("--modes", type=int, help="fracture modes, of the modal and elastic truths (default: 20)")
    make.add_argument("--workers", type=int, default=1, help="processes")
    make.add_argument("--backend", default="joblib", help="joblib, on this machine, or ray, on a cluster")
    make.add_argument("--quiet", action="store_true", help="no progress bars")
    make.set_defaults(run=datasets.dataset_make)
    describe = actions.add_parser("info", help="say what is in a dataset, check it, and draw some of it")
    describe.add_argument("dataset", type=Path)
    describe.add_argument("--out", type=Path, help="the picture (default: the dataset's name with .png)")
    describe.add_argument("--seed", type=int, default=0, help="chooses the samples in the picture")
    describe.set_defaults(run=datasets.dataset_info)

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
    train.set_defaults(run=models.train)

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
            from ..common.files import write_beside

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


def _bench(options: argparse.Namespace) -> dict[str, Any]:
    from ..bench import NAMES, run
    from ..common.progress import Stages

    if options.name not in NAMES:
        raise FracsimError(f"unknown benchmark {options.name!r}; use one of {', '.join(NAMES)}")
    with Stages(not options.quiet) as stage:
        figures = run(options.name, options.quick, options.seed, options.out, stage.ticker(options.name))
    print(figures["table"])
    return figures


if __name__ == "__main__":
    sys.exit(main())
