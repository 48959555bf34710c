"""Commands that make, break, draw and describe assets: ``bake``, ``fracture``, ``view``, ``info``.

The command line's main function adds them; each imports what it needs when it runs.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.errors import FracsimError
from ..common.material import PRESETS
from .arguments import (
    MATERIAL,
    Commands,
    add_common,
    add_material,
    add_seed,
    add_simulator,
    add_sizes,
    listed,
    settings_of,
)
from .output import print_figures, require_file, require_folder

if TYPE_CHECKING:
    from ..common.impulse import Impulse
    from ..fracture.asset import BreakableAsset

PREDICTORS = "field (default), interfaces or simulator"
TRIES = 20  # random impulses that are tried for each impact that view draws; at least one of them mostly breaks


def add_commands(commands: Commands) -> None:
    """Add the commands on assets to the command line.

    Parameters
    ----------
    commands : Commands
        What ``ArgumentParser.add_subparsers`` returned.
    """
    add_bake(commands.add_parser("bake", help="make a breakable asset from a watertight mesh"))
    add_fracture(commands.add_parser("fracture", help="break an asset once, and print or write its pieces"))
    add_view(commands.add_parser("view", help="draw how an asset breaks: field, pieces, convex parts"))
    add_info(commands.add_parser("info", help="print what an asset holds and how good its model is"))


def add_bake(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim bake``."""
    parser.add_argument("mesh", type=Path, help="any format that trimesh reads, in metres; one watertight component")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the asset (default: the mesh's name with .frac)")
    add_material(parser, MATERIAL)
    add_seed(parser, "seed of all random choices")
    add_simulator(parser, "modal")
    add_sizes(parser)
    parser.add_argument(
        "--samples",
        type=int,
        help="impacts to learn from and test on (default: the simulator's, modal 250000, structural 5000)",
    )
    parser.add_argument("--steps", type=int, default=8000, help="training steps (default: 8000)")
    parser.add_argument("--workers", type=int, default=2, help="processes that make samples (default: 2)")
    add_common(parser, quiet=True)
    parser.set_defaults(run=bake, check_out=require_file)


def add_fracture(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim fracture``."""
    _add_impact(parser)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write the pieces to this folder, as OBJ files")
    add_common(parser)
    parser.set_defaults(run=fracture, check_out=require_folder)


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim view``."""
    _add_impact(parser)
    parser.add_argument(
        "--count", type=int, default=3, help="random impacts to draw, from few pieces to many (default: 3)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="the picture (default: the asset's name with .png)")
    add_common(parser)
    parser.set_defaults(run=view, check_out=require_file)


def add_info(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fracsim info``."""
    parser.add_argument("asset", help="a file, or the name of an asset that comes with fracsim")
    add_common(parser)
    parser.set_defaults(run=info)


def _add_impact(parser: argparse.ArgumentParser) -> None:
    """Add the asset and the impulse that acts on it."""
    parser.add_argument("asset", help="a file, or the name of an asset that comes with fracsim")
    parser.add_argument(
        "--point", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where the impulse acts, m, in the asset's frame"
    )
    parser.add_argument(
        "--direction", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where the impulse points; of any length"
    )
    parser.add_argument("--magnitude", type=float, help="of the impulse, N·s")
    add_seed(parser, "seed that draws the impulse, if none is given")
    parser.add_argument("--predictor", default="field", metavar="NAME", help=f"what predicts the pieces: {PREDICTORS}")
    parser.add_argument("--material", metavar="NAME", help=f"instead of the asset's own: {listed(PRESETS)}")
    parser.add_argument("--scale", type=float, default=1.0, help="times the asset's own size (default: 1)")


def bake(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim bake``."""
    from ..baking import BakeOptions, bake, model_for
    from ..fracture.file import SUFFIX
    from ..simulators.registry import options_from

    out = require_file(options.out or Path(options.mesh.stem + SUFFIX))
    if out.suffix != SUFFIX:
        raise FracsimError(f"{out}: an asset's file must end in {SUFFIX}, so that it replaces nothing else")
    learning = model_for(options.simulator)
    learning = replace(learning, training=replace(learning.training, steps=options.steps))
    asset = bake(
        options.mesh,
        options.material,
        options.seed,
        BakeOptions(
            simulator=options.simulator,
            cells=options.cells,
            modes=options.modes,
            samples=options.samples,
            workers=options.workers,
            model=learning,
            simulator_settings=options_from(options.simulator, settings_of(options.set)),
        ),
        progress=not options.quiet,
    )
    asset.save(out)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")
    print_figures(asset.metadata)
    test = asset.metadata["test"]
    if test["ari"] < test["ari_nearest_impulse"]:
        print("fracsim: the model is worse than answering with the most similar training impulse", file=sys.stderr)
    return asset.metadata


def fracture(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim fracture``."""
    from ..common.files import write_beside

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
    """Load the asset that the command line names, of the size and material that it asks for."""
    from ..fracture.asset import load

    asset = load(options.asset).scaled(options.scale)
    return asset.with_material(options.material) if options.material else asset


def _impulse_of(options: argparse.Namespace) -> Impulse | None:
    """Read the impulse on the command line; None if there is none."""
    from ..common.impulse import Impulse

    values = (options.point, options.direction, options.magnitude)
    if all(value is None for value in values):
        return None
    if any(value is None for value in values):
        raise FracsimError("give --point, --direction and --magnitude together, or none for a random impulse")
    return Impulse(*values)


def view(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim view``."""
    import numpy as np

    from ..study.view import picture_fractures

    if options.count < 1:
        raise FracsimError(f"--count must be at least 1, got {options.count}")
    asset = _asset_of(options)
    out = require_file(options.out or Path(f"{asset.name}.png"))
    impulse = _impulse_of(options)
    if impulse is None:
        drawn = asset.sample_impulses(TRIES * options.count, options.seed)
        tried = [(impulse, asset.fracture(impulse, options.predictor)) for impulse in drawn]
        broken = sorted((pair for pair in tried if pair[1].broken), key=lambda pair: len(pair[1].pieces))
        if not broken:
            raise FracsimError(
                f"{asset.name}: none of {len(drawn)} random impulses breaks it; give one with --point, "
                "--direction and --magnitude"
            )
        chosen = np.linspace(0, len(broken) - 1, options.count).round().astype(int)
        impacts = [broken[index] for index in dict.fromkeys(chosen.tolist())]
    else:
        impacts = [(impulse, asset.fracture(impulse, options.predictor))]
    picture_fractures(asset, [([impulse], fracture) for impulse, fracture in impacts], out)
    print(f"{out}: {asset.name} in {', '.join(str(len(fracture.pieces)) for _, fracture in impacts)} pieces")
    return {
        "out": str(out),
        "impacts": [
            {
                "point": impulse.point.tolist(),
                "direction": impulse.direction.tolist(),
                "magnitude": impulse.magnitude,
                "severity": fracture.severity,
                "pieces": len(fracture.pieces),
            }
            for impulse, fracture in impacts
        ],
    }


def info(options: argparse.Namespace) -> dict[str, Any]:
    """Run ``fracsim info``."""
    from ..fracture.asset import load

    asset = load(options.asset)
    print(f"{asset.name}: {asset.size:.4g} m of {asset.material.name}, {asset.mass:.4g} kg, {asset.volume:.4g} m³")
    print_figures(asset.metadata)
    return {
        "name": asset.name,
        "size": asset.size,
        "mass": asset.mass,
        "volume": asset.volume,
        "material": asset.material.to_dict(),
        **asset.metadata,
    }
