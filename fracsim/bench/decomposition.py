"""Methods to make the bodies of a break: ``fracsim bench decomposition``.

How close they are to the pieces, how still they lie, and how long they take. Every method gets the same pieces, those
of test impacts on the shipped meshes. Only the command line uses this module.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as p
from scipy.spatial import ConvexHull, cKDTree

from ..common.arrays import FloatArray
from ..common.errors import BakeError, MissingExtraError
from ..fracture.asset import BreakableAsset, load
from ..fracture.pieces import ConvexParts
from ..fracture.result import Fracture
from ..physics.bodies import Pose, spawn
from ..physics.bullet import Engine
from ..physics.states import ContactProperties
from ..solids.convex import clip_apart
from ..solids.convex_partition import GAP
from ..solids.hulls import coacd_parts
from .picture import new_figure, save_figure

try:
    import manifold3d
    import trimesh
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

Bodies = list[list[FloatArray]]  # the points of each convex part of each piece, m

MESHES = ("bunny", "chair", "vase")
METHODS = ("baked", "one hull a piece", "coacd", "coacd, clipped")
BREAKS, QUICK_BREAKS = 5, 1  # of each mesh
IMPACTS = 100  # tried for each break; that is enough
STEPS = 240  # one second, in which nothing acts on the bodies
DENSE = 20000  # samples of a surface that distances to it are measured from
FRICTION = 0.5
COLUMNS = {
    "kept": "volume kept",
    "symmetric_difference": "symmetric difference",
    "hausdorff": "Hausdorff, % of size",
    "overlap": "overlap, % of volume",
    "hulls": "hulls a piece",
    "points": "points a hull",
    "ms_median": "ms, median",
    "ms_p99": "ms, p99",
    "ghost": "ghost, m/s",
}


def _bodies(asset: BreakableAsset, fracture: Fracture) -> dict[str, tuple[Bodies, float]]:
    """Make the bodies of a break by each method -> their convex parts in m, and how many ms that took."""
    baked = [[points for points, _ in piece.hulls] for piece in fracture.pieces]
    surfaces = [(piece.vertices / asset.size, piece.faces) for piece in fracture.pieces]
    begin = time.perf_counter()
    single = [[vertices[ConvexHull(vertices).vertices]] for vertices, _ in surfaces]
    ms_single = _ms_since(begin)
    begin = time.perf_counter()
    parts = coacd_parts(surfaces)
    ms_parts = _ms_since(begin)
    made = {"one hull a piece": (single, ms_single), "coacd": (parts, ms_parts)}
    # What a world's "coacd" decomposition does, with no second run of CoACD.
    begin = time.perf_counter()
    try:
        clipped = clip_apart(surfaces, parts, np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)))
        made["coacd, clipped"] = clipped, ms_parts + _ms_since(begin)
    except BakeError:  # a small piece was left with nothing; a world keeps the baked parts then
        pass
    result = {"baked": (baked, fracture.timings["pieces"])}
    for method, (bodies, ms) in made.items():
        result[method] = [[points * asset.size for points in parts] for parts in bodies], ms
    return result


def measure(quick: bool, seed: int, progress: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
    """Measure every method on every mesh.

    Parameters
    ----------
    quick : bool
        Whether to measure one break of each mesh.
    seed : int
        Draws the impacts.
    progress : callable
        Called with the share done, from 0 to 1.

    Returns
    -------
    dict
        Plain data. Figures are means over the pieces; ms are of a whole break, ``ghost`` is the largest of all.
    """
    breaks = QUICK_BREAKS if quick else BREAKS
    result: dict[str, Any] = {"quick": quick, "seed": seed, "breaks": breaks, "meshes": {}}
    done = 0
    for mesh in MESHES:
        asset = load(mesh)
        asset.fracture(asset.sample_impulses(1, seed))  # works out what is kept from then on
        fractures = (asset.fracture(impact) for impact in asset.sample_impulses(IMPACTS * breaks, seed))
        chosen = list(itertools.islice((fracture for fracture in fractures if fracture.broken), breaks))
        rows: dict[str, list[dict[str, Any]]] = {method: [] for method in METHODS}
        for fracture in chosen:
            for method, (bodies, ms) in _bodies(asset, fracture).items():
                rows[method].append(_judge(asset, fracture, bodies, ms, seed))
            done += 1
            progress(done / (len(MESHES) * breaks))
        result["meshes"][mesh] = {method: _summary(figures) for method, figures in rows.items()}
        result["meshes"][mesh]["pieces"] = float(np.mean([len(fracture.pieces) for fracture in chosen]))
    return result


def _judge(
    asset: BreakableAsset, fracture: Fracture, bodies: Sequence[Sequence[FloatArray]], ms: float, seed: int
) -> dict[str, Any]:
    """Compare the bodies of one break with its pieces."""
    unions, rows = [], []
    for piece, parts in zip(fracture.pieces, bodies, strict=True):
        solid = manifold3d.Manifold(
            manifold3d.Mesh64(np.ascontiguousarray(piece.vertices), piece.faces.astype(np.uint64))
        )
        hulls = [manifold3d.Manifold.hull_points(points) for points in parts]
        union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
        shared = (union ^ solid).volume()
        unions.append(union)
        rows.append(
            {
                "kept": union.volume() / piece.volume,
                "symmetric_difference": (union.volume() + piece.volume - 2 * shared) / piece.volume,
                "hausdorff": 100 * _hausdorff(solid, union, seed) / asset.size,
                "hulls": len(parts),
                "points": float(np.mean([len(points) for points in parts])),
            }
        )
    overlap = sum((a ^ b).volume() for a, b in itertools.combinations(unions, 2))
    return {
        "pieces": rows,
        "overlap": 100 * overlap / asset.volume,
        "ms": ms,
        "ghost": _ghost(asset, fracture, bodies),
    }


def _summary(breaks: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Summarise what ``_judge`` found for the breaks of one mesh by one method."""
    pieces = [row for figures in breaks for row in figures["pieces"]]
    ms = [figures["ms"] for figures in breaks]
    return {
        "breaks": len(breaks),
        **{name: float(np.mean([row[name] for row in pieces])) for name in pieces[0]},
        "overlap": float(np.mean([figures["overlap"] for figures in breaks])),
        "ms_median": float(np.median(ms)),
        "ms_p99": float(np.quantile(ms, 0.99)),
        "ghost": float(max(figures["ghost"] for figures in breaks)),
    }


def _hausdorff(first: manifold3d.Manifold, second: manifold3d.Manifold, seed: int) -> float:
    """Find the largest distance from a point of either surface to the other, among samples of both."""
    clouds = []
    for solid in (first, second):
        mesh = solid.to_mesh64()
        surface = trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False)
        clouds.append(np.vstack([surface.vertices, trimesh.sample.sample_surface(surface, DENSE, seed=seed)[0]]))
    trees = [cKDTree(cloud) for cloud in clouds]
    return float(max(trees[1].query(clouds[0])[0].max(), trees[0].query(clouds[1])[0].max()))


def _ghost(asset: BreakableAsset, fracture: Fracture, bodies: Sequence[Sequence[FloatArray]]) -> float:
    """Find the speed of the fastest piece, m/s, after one second in which nothing acts on the pieces."""
    pieces = [
        replace(piece, convex_parts=ConvexParts.of(parts)) for piece, parts in zip(fracture.pieces, bodies, strict=True)
    ]
    client = p.connect(p.DIRECT)
    try:
        engine = Engine(client)
        still = Pose(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
        spawned = spawn(engine, pieces, still, ContactProperties(FRICTION, 0.0, margin=GAP / 3 * asset.size), None)
        for _ in range(STEPS):
            engine.step()
        return float(max(np.linalg.norm(engine.motion(body.id)[0]) for body in spawned))
    finally:
        p.disconnect(client)


def _ms_since(begin: float) -> float:
    """Read the clock, in ms."""
    return (time.perf_counter() - begin) * 1e3


def table(figures: dict[str, Any]) -> str:
    """Write the figures as Markdown.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.

    Returns
    -------
    str
        A table with a row for each mesh and method.
    """
    lines = ["| mesh | bodies | breaks | " + " | ".join(COLUMNS.values()) + " |", "|---" * (len(COLUMNS) + 3) + "|"]
    for mesh, rows in figures["meshes"].items():
        for method in METHODS:
            cells = [f"{rows[method][column]:.3g}" for column in COLUMNS]
            counts = f"{rows[method]['breaks']} of {figures['breaks']}"
            lines.append(f"| {mesh} | {method} | {counts} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw the symmetric difference over the time that the parts of a break take.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned. Each mesh has a mark, each method a colour.
    path : Path
        The PNG file to write.
    """
    figure = new_figure(6.4, 4.0, constrained=True)
    axes = figure.subplots()
    for k, method in enumerate(METHODS):
        for mesh, mark in zip(figures["meshes"], "o^s", strict=False):
            row = figures["meshes"][mesh][method]
            axes.plot(row["ms_median"], row["symmetric_difference"], mark, color=f"C{k}", label=f"{method}, {mesh}")
    axes.set(xscale="log", xlabel="ms a break, median", ylabel="symmetric difference, of the piece's volume")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", fontsize="small")
    save_figure(figure, path, dots=150)
