"""Commands on datasets: ``dataset make`` and ``dataset info``.

The command line's main function adds them; each imports what it needs when it runs.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..common.errors import DatasetError
from ..common.material import as_material
from .arguments import MATERIAL, Commands, add_common, add_material, add_seed, add_simulator, add_sizes, settings_of
from .output import print_figures, require_file

SAMPLES = 1000  # of a new dataset, unless the command line says otherwise
KIB = 1024  # bytes; Linux counts a process's memory in KiB


def add_commands(commands: Commands) -> None:
    """Add the commands on datasets to the command line.

    Parameters
    ----------
    commands : Commands
        What ``ArgumentParser.add_subparsers`` returned.
    """
    dataset = commands.add_parser("dataset", help="make a file of fracture samples, or describe one")
    actions = dataset.add_subparsers(dest="action", required=True, metavar="ACTION")
    add_make(actions.add_parser("make", help="make a dataset, continue one, or repair one"))
    add_info(actions.add_parser("info", help="describe a dataset, check it, and draw some of its samples"))


def add_make(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim dataset make``."""
    parser.add_argument("mesh", type=Path, nargs="?", help="a watertight mesh; not needed with --like")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the dataset (default: the mesh's name with .h5)")
    parser.add_argument("--samples", type=int, help=f"the total that the file shall hold (default: {SAMPLES})")
    parser.add_argument("--append", type=int, metavar="N", help="instead: N more samples than the file holds")
    parser.add_argument("--like", type=Path, metavar="FILE", help="make that dataset again from its own header")
    add_seed(parser, "seed of all random choices", None)
    add_simulator(parser, None)
    add_material(parser, None)
    add_sizes(parser)
    parser.add_argument("--workers", type=int, default=1, help="processes (default: 1)")
    parser.add_argument(
        "--backend", default="joblib", metavar="NAME", help="joblib (default), on this machine, or ray, on a cluster"
    )
    add_common(parser, quiet=True)
    parser.set_defaults(
        run=make,
        check_out=require_file,
        interrupted=lambda _: "finished blocks of samples are kept; ask for the total with --samples to go on",
    )


def add_info(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim dataset info``."""
    parser.add_argument("dataset", type=Path, help="a file that fracsim dataset make wrote")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="the picture (default: the dataset's name with _samples.png)"
    )
    add_seed(parser, "seed that chooses the samples in the picture")
    add_common(parser)
    parser.set_defaults(run=info, check_out=require_file)


def make(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim dataset make``."""
    import resource
    import time

    from ..data.dataset import Dataset
    from ..data.writing import make_dataset, regenerate
    from ..simulators.registry import SimulatorOptions, options_for_body, options_from
    from ..solids.surface import read_surface, refine

    begin = time.perf_counter()
    if (options.mesh is None) == (options.like is None):
        raise DatasetError("give a mesh, or --like and a dataset to make again")
    out = options.out or Path((options.mesh or options.like).stem + (".h5" if options.mesh else "_again.h5"))
    require_file(out)
    progress = not options.quiet
    if options.like is not None:
        for name in ("samples", "append", "seed", "simulator", "material", "cells", "modes"):
            if getattr(options, name) is not None:
                raise DatasetError(f"--{name} cannot be given with --like, whose header says it")
        if options.set:
            raise DatasetError("--set cannot be given with --like, whose header says it")
        seconds = regenerate(options.like, out, options.workers, options.backend, progress)
    else:
        name = options.simulator or SimulatorOptions.name
        arguments = {"cells": options.cells, "modes": options.modes}
        values = {option: value for option, value in arguments.items() if value is not None}
        values |= options_from(name, settings_of(options.set))
        total = SAMPLES if options.samples is None else options.samples
        if options.append is not None:
            if options.samples is not None or options.append < 1:
                raise DatasetError("--append takes a number of at least 1, and no --samples beside it")
            with Dataset(out) as dataset:
                total = dataset.held + options.append
        surface = refine(read_surface(options.mesh))
        material = as_material(options.material or MATERIAL)
        simulator = options_for_body(name, material, surface.scale, **values)
        seed = options.seed or 0
        seconds = make_dataset(out, surface, total, seed, simulator, None, options.workers, options.backend, progress)
    figures = describe(out)
    figures["seconds"] = {**seconds, "total": time.perf_counter() - begin}
    # Of this process and of the largest of its workers.
    peak = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    figures["peak_memory_mb"] = max(peak) * KIB / 1e6
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")
    print_figures(figures)
    return figures


def info(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim dataset info``."""
    from ..study.view import picture_sheet

    out = require_file(options.out or options.dataset.with_name(f"{options.dataset.stem}_samples.png"))
    if options.dataset.resolve() in (out.resolve(), options.json and options.json.resolve()):
        raise DatasetError(f"{options.dataset}: would be overwritten; name another file with --out or --json")
    figures = describe(options.dataset)
    header = figures["header"]
    simulator = ", ".join(f"{key} {value}" for key, value in header["simulator"].items())
    print(f"{options.dataset}: {figures['mesh']}; {simulator}; seed {header['seed']}; fracsim {header['fracsim']}")
    print_figures(figures)
    for name in figures["damaged"]:
        print(f"  DAMAGED {name}")
    if figures["pieces"]["breaking"]:
        picture_sheet(options.dataset, out, abs(options.seed))
        print(f"{out}: some of its samples")
    return figures


def describe(path: Path) -> dict[str, Any]:
    """Read a dataset once, from end to end, and say what is in it.

    Parameters
    ----------
    path : Path
        The dataset.

    Returns
    -------
    dict
        Plain data: the header, the names of damaged chunks, and counts of samples, splits, kinds and pieces.

    Raises
    ------
    DatasetError
        If the file is not a dataset.
    """
    import numpy as np

    from ..data.dataset import Dataset
    from ..data.impacts import KINDS

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
                "cells": len(dataset.cells.volumes),
                "interfaces": len(dataset.file["interfaces/pairs"]),
                "links": len(dataset.links),
            },
            "splits": dict(zip(("train", "validation", "test"), splits.tolist(), strict=True)),
            "kinds": dict(zip(KINDS, kinds.tolist(), strict=True)),
            "repeatability": dataset.header.get("repeatability", {}),
            "pieces": {
                "breaking": int(broken.sum()),
                "median": float(np.median(count[broken])) if broken.any() else 0.0,
                "most": int(count.max(initial=0)),
            },
        }
