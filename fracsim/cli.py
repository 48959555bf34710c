"""The command line: one program, a subcommand a task, figures to a file with ``--json``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .errors import AssetError, FracsimError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code: 0, 2 for bad input, 130 when interrupted."""
    parser = argparse.ArgumentParser(prog="fracsim", description="Breakable objects for PyBullet and Gymnasium.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    bake = commands.add_parser("bake", help="make a breakable asset of a watertight mesh")
    bake.add_argument("mesh", type=Path, help="any format trimesh reads, in metres; one watertight component")
    bake.add_argument("--out", type=Path, help="the asset to write (default: the mesh's name with .frac)")
    bake.add_argument("--material", default="ceramic", help="glass, ceramic, plaster, stone or ice")
    bake.add_argument("--seed", type=int, default=0)
    bake.add_argument("--cells", type=int, default=5000, help="of the solid that is cut up")
    bake.add_argument("--modes", type=int, default=20, help="fracture modes")
    bake.add_argument("--samples", type=int, default=50000, help="impulses to learn from and be tested on")
    bake.add_argument("--steps", type=int, default=5000, help="of training")
    bake.add_argument("--workers", type=int, default=2, help="processes for the convex parts")
    bake.add_argument("--quiet", action="store_true", help="no progress bars")
    bake.set_defaults(run=_bake)

    fracture = commands.add_parser("fracture", help="break an asset and say what comes of it")
    fracture.add_argument("asset", help="a file, or the name of an asset that ships")
    fracture.add_argument("--point", type=float, nargs=3, metavar=("X", "Y", "Z"), help="m, in the asset's frame")
    fracture.add_argument("--direction", type=float, nargs=3, metavar=("X", "Y", "Z"))
    fracture.add_argument("--magnitude", type=float, help="N·s")
    fracture.add_argument("--seed", type=int, default=0, help="draws the impulse where none is given")
    fracture.add_argument("--predictor", default="field", help="field or modes")
    fracture.add_argument("--material", help="another than the asset's own")
    fracture.add_argument("--scale", type=float, default=1.0, help="times the asset's own size")
    fracture.add_argument("--out", type=Path, help="a folder to write the pieces to, as OBJ files")
    fracture.set_defaults(run=_fracture)

    info = commands.add_parser("info", help="say what an asset holds and how good its model is")
    info.add_argument("asset", help="a file, or the name of an asset that ships")
    info.set_defaults(run=_info)

    for command in (bake, fracture, info):
        command.add_argument("--json", type=Path, metavar="FILE", help="write the figures here")
    options = parser.parse_args(arguments)
    try:
        for path in (options.json, getattr(options, "out", None)):
            if path is not None and not path.absolute().parent.is_dir():
                raise AssetError(f"{path}: the folder {path.parent} does not exist; create it first")
        for path in (options.json, options.out if options.command == "bake" else None):
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
        print("fracsim: interrupted; nothing was written", file=sys.stderr)
        return 130
    return 0


def _bake(options: argparse.Namespace) -> dict[str, Any]:
    from .baking import BakeOptions, bake
    from .train import TrainingOptions

    out = options.out or Path(options.mesh.stem + ".frac")
    asset = bake(
        options.mesh,
        options.material,
        options.seed,
        BakeOptions(
            cells=options.cells,
            modes=options.modes,
            samples=options.samples,
            workers=options.workers,
            training=TrainingOptions(steps=options.steps),
        ),
        progress=not options.quiet,
    )
    asset.save(out)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")
    _print_figures(asset.metadata)
    return asset.metadata


def _print_figures(metadata: dict[str, Any]) -> None:
    for group in ("counts", "seconds", "test"):
        print(f"  {group}")
        for key, value in metadata.get(group, {}).items():
            print(f"    {key:<36}{value:>12.5g}" if isinstance(value, float) else f"    {key:<36}{value:>12}")


def _fracture(options: argparse.Namespace) -> dict[str, Any]:
    from .asset import load, write_beside
    from .impulse import Impulse

    asset = load(options.asset).scaled(options.scale)
    if options.material:
        asset = asset.with_material(options.material)
    given = (options.point, options.direction, options.magnitude)
    if all(value is None for value in given):
        impulse = asset.sample_impulses(1, options.seed)[0]
    elif any(value is None for value in given):
        raise FracsimError("give --point, --direction and --magnitude together, or none for a random impulse")
    else:
        impulse = Impulse(*given)
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
