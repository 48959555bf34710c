"""TODO cli.datasets."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..common.errors import DatasetError
from .output import print_figures


def dataset_make(options: argparse.Namespace) -> dict[str, Any]:
    import resource
    import time

    from ..data.dataset import Dataset
    from ..data.writing import make_dataset, regenerate
    from ..simulators.registry import SimulatorOptions
    from ..solids.surface import read_surface, refine

    begin = time.perf_counter()
    if (options.mesh is None) == (options.like is None):
        raise DatasetError("give a mesh, or --like and a dataset to make again")
    out = options.out or Path((options.mesh or options.like).stem + (".h5" if options.mesh else "_again.h5"))
    progress = not options.quiet
    if options.like is not None:
        for name in ("samples", "append", "seed", "simulator", "cells", "modes"):
            if getattr(options, name) is not None:
                raise DatasetError(f"--{name} cannot be given with --like, whose header says it")
        seconds = regenerate(options.like, out, options.workers, options.backend, progress)
    else:
        given = {name: getattr(options, name) for name in ("simulator", "cells", "modes")}
        given["name"] = given.pop("simulator")
        truth = SimulatorOptions(**{name: value for name, value in given.items() if value is not None})
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
    print_figures(figures)
    return figures


def dataset_info(options: argparse.Namespace) -> dict[str, Any]:
    from ..study.view import picture_sheet

    out = options.out or options.dataset.with_suffix(".png")
    if options.dataset.resolve() in (out.resolve(), options.json and options.json.resolve()):
        raise DatasetError(f"{options.dataset}: would be overwritten; name another file with --out or --json")
    figures = _describe(options.dataset)
    header = figures["header"]
    truth = ", ".join(f"{key} {value}" for key, value in header["simulator"].items())
    print(f"{options.dataset}: {figures['mesh']}; {truth}; seed {header['seed']}; fracsim {header['fracsim']}")
    print_figures(figures)
    for name in figures["damaged"]:
        print(f"  DAMAGED {name}")
    if figures["pieces"]["breaking"]:
        picture_sheet(options.dataset, out, abs(options.seed))
        print(f"{out}: some of its samples")
    return figures


def _describe(path: Path) -> dict[str, Any]:
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
                "parts": len(dataset.cells.volumes),
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
