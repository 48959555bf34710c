"""TODO cli.assets."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.errors import FracsimError
from .output import print_figures

if TYPE_CHECKING:
    from ..common.impulse import Impulse
    from ..fracture.asset import BreakableAsset


def bake(options: argparse.Namespace) -> dict[str, Any]:
    from ..baking import BakeOptions, bake, model_for

    out = options.out or Path(options.mesh.stem + ".frac")
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
    from ..fracture.asset import load

    asset = load(options.asset).scaled(options.scale)
    return asset.with_material(options.material) if options.material else asset


def _impulse_of(options: argparse.Namespace) -> Impulse | None:
    """What the command line gives, if anything."""
    from ..common.impulse import Impulse

    given = (options.point, options.direction, options.magnitude)
    if all(value is None for value in given):
        return None
    if any(value is None for value in given):
        raise FracsimError("give --point, --direction and --magnitude together, or none for a random impulse")
    return Impulse(*given)


def view(options: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from ..study.view import picture_fractures

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
        impacts = [found[k] for k in dict.fromkeys(chosen.tolist())]
    else:
        impacts = [(impulse, asset.fracture(impulse, options.predictor))]
    out = options.out or Path(f"{asset.name}.png")
    picture_fractures(asset, [([one], fracture) for one, fracture in impacts], out)
    print(f"{out}: {asset.name} in {', '.join(str(len(fracture.pieces)) for _, fracture in impacts)} pieces")
    return {
        "out": str(out),
        "impacts": [
            {
                "point": one.point.tolist(),
                "direction": one.direction.tolist(),
                "magnitude": one.magnitude,
                "severity": fracture.severity,
                "pieces": len(fracture.pieces),
            }
            for one, fracture in impacts
        ],
    }


def info(options: argparse.Namespace) -> dict[str, Any]:
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
