"""From the contact to the pieces stepping in the world: what a break costs, first one of a process included.

A ball is shot at each place of a held-out set of impulses, hard enough to deliver that impulse, and the step that
breaks the body is timed whole. Every mesh has a process of its own. Beside it, in the same run: the thesis's pipeline,
which stops at labels of vertices (a perceptron of 704 x 7 and a watershed on a NetworkX graph).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ..fracture.asset import BreakableAsset, load

MESHES = ("bunny", "chair", "vase", "bunny 9x")
SIZE = 0.3  # m
RATE = 240  # Hz
LIMITS = {"median": 8.0, "p99": 17.0}  # ms; the median's is for some 3,300 vertices


def events(asset: BreakableAsset, count: int, seed: int) -> dict[str, Any]:
    """Break an asset by balls shot at it -> per event: ms whole, ms of the engine's own step, pieces and so on."""
    import pybullet as p

    from ..physics.world import World

    client = p.connect(p.DIRECT)
    rows: list[list[float]] = []
    stages: dict[str, list[float]] = {}
    impulses = asset.sample_impulses(count, seed)
    memory = 0.0
    for impulse in impulses:
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        p.setTimeStep(1 / RATE, physicsClientId=client)
        world = World(client)
        world.add(asset)
        radius, mass = 0.03 * asset.size, asset.mass
        arm = np.cross(impulse.point - asset.center_of_mass, impulse.direction)
        light = 2.0 / mass + arm @ np.linalg.solve(asset.inertia, arm)
        speed = impulse.magnitude * light
        start = impulse.point - (radius + 1e-3 * asset.size) * impulse.direction
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=client)
        ball = p.createMultiBody(mass, shape, -1, start.tolist(), physicsClientId=client)
        p.changeDynamics(ball, -1, maxJointVelocity=1e5, contactProcessingThreshold=1e-4, physicsClientId=client)
        p.resetBaseVelocity(ball, (speed * impulse.direction).tolist(), physicsClientId=client)
        memory = memory or _memory(anew=True)
        stepped = [0.0]
        step = world._engine.step

        def timed(step: Callable[[], None] = step, stepped: list[float] = stepped) -> None:
            begin = perf_counter()
            step()
            stepped[0] = perf_counter() - begin

        world._engine.step = timed  # type: ignore[method-assign]
        for _ in range(8):
            begin = perf_counter()
            broken = world.step()
            whole = perf_counter() - begin
            if broken:
                event, engine = broken[0], stepped[0]
                world.step()
                parts = sum(len(piece.convex_parts) for piece in event.fracture.pieces)
                whole += stepped[0]  # the pieces' first
                rows.append([1e3 * whole, 1e3 * engine, 1e3 * stepped[0], len(event.children), parts])
                for name, ms in event.timings.items():
                    stages.setdefault(name, []).append(ms)
                break
    p.disconnect(client)
    return {"shots": count, "rows": rows, "stages": stages, "extra_memory_mb": _memory() - memory}


def _memory(anew: bool = False) -> float:
    """MB, the most that this process has held, or what it holds, from which the most is counted anew (Linux)."""
    if anew:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def thesis(count: int, seed: int) -> dict[str, Any]:
    """ms of the thesis's pipeline on the bunny: perceptron (untrained: its weights cost no time), then watershed."""
    import torch

    from ..learning.mlp import Perceptron
    from ..segmentation.graph import SurfaceGraph
    from ..segmentation.reference import REFERENCES, prepare
    from ..segmentation.watershed import THRESHOLD

    torch.set_num_threads(os.cpu_count() or 1)
    asset = load("bunny")
    points = asset.arrays.points[: asset.vertex_count]
    net = Perceptron(9, 704, 7).eval()
    rng = np.random.default_rng(seed)
    graph = SurfaceGraph.of(asset)
    prediction, segmentation = [], []
    impulses = asset.sample_impulses(200, seed)
    broken = [fracture for impulse in impulses if (fracture := asset.fracture(impulse)).broken][:count]
    for fracture in broken:
        inputs = np.hstack([points, np.tile(rng.normal(size=6), (len(points), 1))]).astype(np.float32)
        begin = perf_counter()
        with torch.inference_mode():
            net(torch.from_numpy(inputs)).numpy()
        prediction.append(1e3 * (perf_counter() - begin))
        held = prepare(graph, fracture.udf / asset.size)
        begin = perf_counter()
        REFERENCES["watershed"](held, THRESHOLD)
        segmentation.append(1e3 * (perf_counter() - begin))
    return {"prediction": prediction, "segmentation": segmentation}


def _fine_bunny(folder: Path) -> Path:
    """The bunny with every face split in three twice, some 30,000 vertices, baked: a few minutes, once a folder."""
    from ..baking import BakeOptions, bake, model_for
    from ..solids.surface import read_surface, split_faces

    path = folder / "bunny_9x.frac"
    if not path.exists():
        from dataclasses import replace
        from importlib import resources

        import trimesh

        with resources.as_file(resources.files("fracsim.meshes") / "bunny.obj") as source:
            surface = split_faces(split_faces(read_surface(source)))
        mesh = trimesh.Trimesh(surface.vertices * surface.scale + surface.offset, surface.faces, process=False)
        learning = model_for("modal")
        learning = replace(learning, training=replace(learning.training, steps=1500))
        bake(mesh, options=BakeOptions(samples=20000, evaluated=50, model=learning)).save(path)
    return path


def measure(quick: bool, seed: int, progress: Callable[[float], None], work: Path | None = None) -> dict[str, Any]:
    """Figures a mesh, over the breaking ones of so many shots, and the thesis's pipeline beside."""
    meshes = MESHES[:1] if quick else MESHES
    shots = 60 if quick else 400
    result: dict[str, Any] = {"shots": shots, "size": SIZE, "limits": LIMITS, "meshes": {}}
    folder = work or Path(tempfile.gettempdir()) / "fracsim-bench"
    folder.mkdir(exist_ok=True)
    for done, name in enumerate(meshes):
        source = str(_fine_bunny(folder)) if name == "bunny 9x" else name
        processes = [_in_process("events", source, shots, seed)]
        # The first event of a process, of some more processes.
        processes += [_in_process("events", source, 12, seed + k) for k in range(1, 2 if quick else 6)]
        result["meshes"][name] = _summary(processes) | {"vertices": load(source).vertex_count}
        progress((done + 1) / (len(meshes) + 1))
    beside = _in_process("thesis", "bunny", 5 if quick else 40, seed)
    total = np.array(beside["prediction"]) + np.array(beside["segmentation"])
    ours = result["meshes"]["bunny"]
    result["thesis"] = {
        "prediction_ms": float(np.median(beside["prediction"])),
        "segmentation_ms": float(np.median(beside["segmentation"])),
        "median_ms": float(np.median(total)),
        "p99_ms": float(np.quantile(total, 0.99)),
        "times_ours": float(np.median(total) / ours["median_ms"]),
    }
    progress(1.0)
    return result


def _in_process(function: str, source: str, count: int, seed: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "fracsim.bench.latency", function, source, str(count), str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def _summary(processes: list[dict[str, Any]]) -> dict[str, Any]:
    rows = np.array(processes[0]["rows"])
    first = [process["rows"][0][0] for process in processes if process["rows"]]
    whole = rows[:, 0]
    stages = {name: float(np.median(values)) for name, values in processes[0]["stages"].items()}
    bins = [2, 3, 5, 9, 17, 33, 65, 129]
    counts = np.histogram(rows[:, 3], bins)[0]
    return {
        "events": len(rows),
        "median_ms": float(np.median(whole)),
        "p99_ms": float(np.quantile(whole, 0.99)),
        "worst_ms": float(whole.max()),
        "first_ms": [float(value) for value in first],
        "stages_ms": stages,
        "engine_step_ms": float(np.median(rows[:, 1])),
        "step_after_ms": float(np.median(rows[:, 2])),
        "extra_memory_mb": processes[0]["extra_memory_mb"],
        "pieces": [int(value) for value in rows[:, 3]],
        "parts": [int(value) for value in rows[:, 4]],
        "ms": [float(value) for value in whole],
        "histogram": {f"{a}-{b - 1}": int(n) for a, b, n in zip(bins, bins[1:], counts, strict=False)},
    }


def table(figures: dict[str, Any]) -> str:
    lines = [
        "| mesh | vertices | events | pieces, median / most | convex parts | median, ms | p99, ms | "
        "first of a process, ms | the engine's own step | extra memory, MB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["meshes"].items():
        first = row["first_ms"]
        lines.append(
            f"| {name} | {row['vertices']} | {row['events']} | {np.median(row['pieces']):.0f} / {max(row['pieces'])} | "
            f"{np.median(row['parts']):.0f} | **{row['median_ms']:.1f}** | **{row['p99_ms']:.1f}** | "
            f"{np.median(first):.1f} (most {max(first):.1f}) | {row['engine_step_ms']:.2f} | "
            f"{row['extra_memory_mb']:.0f} |"
        )
    beside = figures["thesis"]
    lines += [
        "",
        f"The thesis's pipeline on the bunny, no bodies: {beside['prediction_ms']:.0f} ms of prediction and "
        f"{beside['segmentation_ms']:.1f} ms of segmentation, {beside['median_ms']:.0f} ms in all (p99 "
        f"{beside['p99_ms']:.0f}): **{beside['times_ours']:.0f} times** ours with bodies.",
        "",
        "Pieces of an event: "
        + "; ".join(
            f"{name}: " + ", ".join(f"{bin_} in {n}" for bin_, n in row["histogram"].items() if n)
            for name, row in figures["meshes"].items()
        )
        + ".",
    ]
    return "\n".join(lines)


def draw(figures: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    meshes = figures["meshes"]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.6))
    for k, (name, row) in enumerate(meshes.items()):
        left.plot(row["pieces"], row["ms"], ".", ms=4, alpha=0.6, color=f"C{k}", label=name)
    left.axhline(LIMITS["p99"], color="0.4", lw=1)
    place = ("axes fraction", "data")
    left.annotate("a frame at 60 Hz", (0.02, LIMITS["p99"]), xycoords=place, va="bottom", fontsize=8)
    left.set(xlabel="pieces", ylabel="ms from contact to bodies", ylim=(0, None))
    left.legend(frameon=False, fontsize=8)
    right.hist([row["pieces"] for row in meshes.values()], bins=24, label=list(meshes))
    right.set(xlabel="pieces", ylabel="events")
    right.legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _main() -> None:
    function, source, count, seed = sys.argv[1:]
    if function == "thesis":
        print(json.dumps(thesis(int(count), int(seed))))
    else:
        asset = load(source)
        print(json.dumps(events(asset.scaled(SIZE / asset.size), int(count), int(seed))))


if __name__ == "__main__":
    _main()
