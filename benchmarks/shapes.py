"""Shapes that nothing here was tuned on: do they all bake? ``python benchmarks/shapes.py`` (about 20 minutes).

A torus, a comb, a cup with a handle, a long rod and a thin plate with holes. For each, the figures of its bake, and
three of them drawn in pieces. Writes benchmarks/results/shapes.{json,md,png}.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import manifold3d
import numpy as np
import trimesh

import fracsim
from fracsim.baking import BakeOptions
from fracsim.study.view import draw_mesh, view_frame

RESULTS = Path(__file__).parent / "results"
SHOWN = ("comb", "cup", "plate")
Manifold = manifold3d.Manifold


def torus() -> manifold3d.Manifold:
    ring = manifold3d.CrossSection.circle(0.03, 24).translate((0.1, 0))
    return Manifold.revolve(ring, 48)


def comb() -> manifold3d.Manifold:
    teeth = [Manifold.cube((0.008, 0.06, 0.006)).translate((0.016 * k, 0, 0)) for k in range(10)]
    back = Manifold.cube((0.152, 0.02, 0.006)).translate((0, 0.055, 0))
    return Manifold.batch_boolean([back, *teeth], manifold3d.OpType.Add)


def cup() -> manifold3d.Manifold:
    body = Manifold.cylinder(0.08, 0.03, 0.042, 48)
    hollow = Manifold.cylinder(0.08, 0.0265, 0.0385, 48).translate((0, 0, 0.005))
    ring = manifold3d.CrossSection.circle(0.0045, 16).translate((0.02, 0))
    handle = Manifold.revolve(ring, 40).rotate((90, 0, 0)).translate((0.045, 0, 0.042))
    return (body + handle) - hollow


def rod() -> manifold3d.Manifold:
    return Manifold.cylinder(0.4, 0.008, circular_segments=20)


def plate() -> manifold3d.Manifold:
    holes = [
        Manifold.cylinder(0.02, 0.015, circular_segments=24).translate((0.05 * i, 0.05 * j, -0.01))
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
    ]
    slab = Manifold.cube((0.2, 0.2, 0.006), True)
    return slab - Manifold.batch_boolean(holes, manifold3d.OpType.Add)


SHAPES: dict[str, Callable[[], manifold3d.Manifold]] = {
    "torus": torus,
    "comb": comb,
    "cup": cup,
    "rod": rod,
    "plate": plate,
}


def mesh_of(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    """In metres, with edges of 4 % of the size at most."""
    low, high = np.split(np.array(solid.bounding_box()), 2)
    out = solid.refine_to_length(0.04 * float((high - low).max())).to_mesh64()
    vertices = np.asarray(out.vert_properties)[:, :3]
    return trimesh.Trimesh(vertices, np.asarray(out.tri_verts).astype(np.int64), process=False)


def main() -> None:
    rows, drawn = [], {}
    for name, make in SHAPES.items():
        asset = fracsim.bake(mesh_of(make()), options=BakeOptions(), progress=sys.stderr.isatty())
        impulses = asset.sample_impulses(200, 0)
        fractures = [asset.fracture(impulse) for impulse in impulses]
        volumes = [abs(sum(piece.volume for piece in f.pieces) / asset.volume - 1) for f in fractures]
        pieces = [piece for f in fractures if f.broken for piece in f.pieces][:100]
        tight = [trimesh.Trimesh(piece.vertices, piece.faces).is_watertight for piece in pieces]
        counts = asset.metadata["counts"]
        rows.append(
            {
                "shape": name,
                "vertices": counts["vertices"],
                "cells": counts["cells"],
                "atoms": counts["atoms"],
                "interfaces": counts["interfaces"],
                "seconds": asset.metadata["seconds"]["total"],
                "ari": asset.metadata["test"]["ari"],
                "ari_nearest_impulse": asset.metadata["test"]["ari_nearest_impulse"],
                "broke": sum(f.broken for f in fractures),
                "volume_error": max(volumes),
                "watertight": f"{sum(tight)} of {len(tight)}",
            }
        )
        print(rows[-1], flush=True)
        if name in SHOWN:
            drawn[name] = (asset, max(zip(impulses, fractures, strict=True), key=lambda pair: len(pair[1].pieces)))
    RESULTS.mkdir(exist_ok=True)
    result = {"command": "python benchmarks/shapes.py", "rows": rows}
    (RESULTS / "shapes.json").write_text(json.dumps(result, indent=2) + "\n")
    lines = [
        "Bakes at the defaults, and 200 impulses each on the baked asset. `python benchmarks/shapes.py`",
        "",
        "| shape | vertices | cells | atoms | interfaces | bake, s | ARI | nearest impulse | broke, of 200 | "
        "volume error | watertight pieces |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['shape']} | {row['vertices']} | {row['cells']} | {row['atoms']} | {row['interfaces']} | "
        f"{row['seconds']:.0f} | {row['ari']:.3f} | {row['ari_nearest_impulse']:.3f} | {row['broke']} | "
        f"{row['volume_error']:.0e} | {row['watertight']} |"
        for row in rows
    ]
    (RESULTS / "shapes.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(SHOWN), figsize=(12, 4))
    frame = view_frame(np.array([0.4, -0.8, 0.6]))
    for axis, name in zip(axes, SHOWN, strict=True):
        asset, (impulse, fracture) = drawn[name]
        centre = asset.center_of_mass
        vertices, faces, colours, count = [], [], [], 0
        for index, piece in enumerate(fracture.pieces):
            apart = 0.35 * (piece.center_of_mass - centre)
            vertices.append(piece.vertices + apart)
            faces.append(piece.faces + count)
            count += len(piece.vertices)
            colours.append(np.tile(matplotlib.colormaps["tab20"](index % 20), (len(piece.faces), 1)))
        draw_mesh(axis, np.vstack(vertices), np.vstack(faces), np.vstack(colours), frame)
        axis.set_axis_off()
        axis.set_title(f"{name}: {len(fracture.pieces)} pieces of {impulse.magnitude:.2g} N·s")
    figure.tight_layout()
    figure.savefig(RESULTS / "shapes.png", dpi=110)


if __name__ == "__main__":
    main()
