"""Ways to make the bodies of a break: how true they are to its pieces, how still they lie, and how long they take.

Every way is given the same pieces, those of held-out impacts to the shipped meshes.
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

try:
    import manifold3d
    import trimesh
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

Bodies = list[list[FloatArray]]  # the points of each convex part of each piece

MESHES = ("bunny", "chair", "vase")
BREAKS = 5  # a mesh
STEPS = 240  # one second
DENSE = 20000  # samples of a surface that distances to it are taken from
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


WAYS = ("baked", "one hull a piece", "coacd", "coacd, clipped")


def _ways(asset: BreakableAsset, fracture: Fracture) -> dict[str, tuple[Bodies, float]]:
    """The parts that each way makes of a break's pieces, and how many ms that took."""
    baked = [[points for points, _ in piece.hulls] for piece in fracture.pieces]
    surfaces = [(piece.vertices / asset.size, piece.faces) for piece in fracture.pieces]
    begin = time.perf_counter()
    single = [[vertices[ConvexHull(vertices).vertices]] for vertices, _ in surfaces]
    ms_single = _ms(begin)
    begin = time.perf_counter()
    parts = coacd_parts(surfaces)
    ms_parts = _ms(begin)
    # What ``convex.separate`` does, with no second run of CoACD
    begin = time.perf_counter()
    made = {"one hull a piece": (single, ms_single), "coacd": (parts, ms_parts)}
    try:
        clipped = clip_apart(surfaces, parts, np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)))
        made["coacd, clipped"] = clipped, ms_parts + _ms(begin)
    except BakeError:  # a small piece was left with nothing; a world keeps the baked parts then
        pass
    sized = {
        way: ([[points * asset.size for points in some] for some in bodies], ms) for way, (bodies, ms) in made.items()
    }
    return {"baked": (baked, fracture.timings["pieces"]), **sized}


def measure(quick: bool, seed: int, progress: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
    """Figures of every way on every mesh, means over pieces; ms are of a whole break, ghost is the worst of all.

    quick: one break a mesh instead of five.
    """
    breaks = 1 if quick else BREAKS
    result: dict[str, Any] = {"quick": quick, "seed": seed, "breaks": breaks, "meshes": {}}
    done = 0
    for mesh in MESHES:
        asset = load(mesh)
        asset.fracture(asset.sample_impulses(1, seed))  # what is worked out once and kept
        fractures = (asset.fracture(impact) for impact in asset.sample_impulses(100 * breaks, seed))
        chosen = list(itertools.islice((fracture for fracture in fractures if fracture.broken), breaks))
        rows: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
        for fracture in chosen:
            for way, (bodies, ms) in _ways(asset, fracture).items():
                rows[way].append(_judge(asset, fracture, bodies, ms, seed))
            done += 1
            progress(done / (len(MESHES) * breaks))
        result["meshes"][mesh] = {name: _summary(some) for name, some in rows.items()}
        result["meshes"][mesh]["pieces"] = float(np.mean([len(fracture.pieces) for fracture in chosen]))
    return result


def _judge(
    asset: BreakableAsset, fracture: Fracture, bodies: Sequence[Sequence[FloatArray]], ms: float, seed: int
) -> dict[str, Any]:
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
    pieces = [row for some in breaks for row in some["pieces"]]
    ms = [some["ms"] for some in breaks]
    return {
        "breaks": len(breaks),
        **{name: float(np.mean([row[name] for row in pieces])) for name in pieces[0]},
        "overlap": float(np.mean([some["overlap"] for some in breaks])),
        "ms_median": float(np.median(ms)),
        "ms_p99": float(np.quantile(ms, 0.99)),
        "ghost": float(max(some["ghost"] for some in breaks)),
    }


def _hausdorff(first: manifold3d.Manifold, second: manifold3d.Manifold, seed: int) -> float:
    """The furthest that a point of either surface is from the other, among samples of both."""
    clouds = []
    for solid in (first, second):
        mesh = solid.to_mesh64()
        surface = trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False)
        clouds.append(np.vstack([surface.vertices, trimesh.sample.sample_surface(surface, DENSE, seed=seed)[0]]))
    trees = [cKDTree(cloud) for cloud in clouds]
    return float(max(trees[1].query(clouds[0])[0].max(), trees[0].query(clouds[1])[0].max()))


def _ghost(asset: BreakableAsset, fracture: Fracture, bodies: Sequence[Sequence[FloatArray]]) -> float:
    """m/s, the fastest piece after one second in which nothing acts on them."""
    pieces = [
        replace(piece, convex_parts=ConvexParts.of(parts)) for piece, parts in zip(fracture.pieces, bodies, strict=True)
    ]
    client = p.connect(p.DIRECT)
    try:
        engine = Engine(client)
        still = Pose(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
        spawned = spawn(engine, pieces, still, ContactProperties(0.5, 0.0, margin=GAP / 3 * asset.size), None)
        for _ in range(STEPS):
            engine.step()
        return float(max(np.linalg.norm(engine.motion(body.id)[0]) for body in spawned))
    finally:
        p.disconnect(client)


def _ms(begin: float) -> float:
    return (time.perf_counter() - begin) * 1e3


def table(figures: dict[str, Any]) -> str:
    """The figures as a table in Markdown."""
    lines = ["| mesh | bodies | breaks | " + " | ".join(COLUMNS.values()) + " |", "|---" * (len(COLUMNS) + 3) + "|"]
    for mesh, ways in figures["meshes"].items():
        for way in WAYS:
            cells = [f"{ways[way][column]:.3g}" for column in COLUMNS]
            lines.append(
                f"| {mesh} | {way} | {ways[way]['breaks']} of {figures['breaks']} | " + " | ".join(cells) + " |"
            )
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    """Symmetric difference against the time that the parts of a break take, a mark a mesh and a colour a way."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot") from error
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for k, way in enumerate(WAYS):
        for mesh, mark in zip(figures["meshes"], "o^s", strict=False):
            row = figures["meshes"][mesh][way]
            axes.plot(row["ms_median"], row["symmetric_difference"], mark, color=f"C{k}", label=f"{way}, {mesh}")
    axes.set(xscale="log", xlabel="ms a break, median", ylabel="symmetric difference, of the piece's volume")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=150)
