"""What a break costs, from the contact to the pieces stepping in the world: ``fracsim bench latency``.

A ball hits each place of a set of test impulses, hard enough to deliver that impulse, and the step that breaks the body
is timed as a whole. Every mesh has a process of its own, whose first break is counted too. The thesis's pipeline, which
stops at labels of vertices (a perceptron of 704 x 7 and a watershed on a NetworkX graph), is timed in the same run.
Only the command line uses this module.
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
from .picture import new_figure, save_figure

MESHES = ("bunny", "chair", "vase", "bunny 9x")
SIZE = 0.3  # m, the largest extent of the objects
RATE = 240  # Hz, the steps of the simulation
LIMITS = {"median": 8.0, "p99": 17.0}  # ms, what the project promises; the median is for some 3,300 vertices
SHOTS, QUICK_SHOTS = 400, 60  # at each mesh
FIRST_SHOTS = 12  # at each mesh in each further process, of which only the first break counts
PROCESSES, QUICK_PROCESSES = 6, 2  # for each mesh, to time the first break of a process
STEPS_TO_BREAK = 8  # steps in which a ball that starts so near has hit
BALL_RADIUS = 0.03  # of the object's size
START_GAP = 1e-3  # of the object's size, between the ball and the object
THESIS_BREAKS, QUICK_THESIS_BREAKS = 40, 5  # that the thesis's pipeline is timed on
PIECE_BINS = (2, 3, 5, 9, 17, 33, 65, 129)  # counts of pieces where the bins of the histogram begin


def events(asset: BreakableAsset, count: int, seed: int) -> dict[str, Any]:
    """Break an asset again and again with balls.

    Parameters
    ----------
    asset : BreakableAsset
        The asset at its final size.
    count : int
        How many balls hit it, each a new copy.
    seed : int
        Draws the places and the strength of the hits.

    Returns
    -------
    dict
        Plain data. ``rows`` has one row for each break: ms as a whole, ms of the engine's own step, ms of the step
        after it, pieces, convex parts. ``stages`` has the ms of each stage, ``extra_memory_mb`` the memory that
        breaking took at most.
    """
    import pybullet as p

    from ..physics.world import World

    client = p.connect(p.DIRECT)
    rows: list[list[float]] = []
    stages: dict[str, list[float]] = {}
    memory = 0.0
    for impulse in asset.sample_impulses(count, seed):
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        p.setTimeStep(1 / RATE, physicsClientId=client)
        world = World(client)
        world.times_engine = True
        world.add(asset)
        radius, mass = BALL_RADIUS * asset.size, asset.mass
        # The speed at which a ball of the object's own mass delivers the impulse: J * (1/m_ball + 1/m_eff at the
        # point), where the object's rotation about its centre of mass counts, too.
        arm = np.cross(impulse.point - asset.center_of_mass, impulse.direction)
        inverse_mass = 2.0 / mass + arm @ np.linalg.solve(asset.inertia, arm)
        speed = impulse.magnitude * inverse_mass
        start = impulse.point - (radius + START_GAP * asset.size) * impulse.direction
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=client)
        ball = p.createMultiBody(mass, shape, -1, start.tolist(), physicsClientId=client)
        p.changeDynamics(ball, -1, maxJointVelocity=1e5, contactProcessingThreshold=1e-4, physicsClientId=client)
        p.resetBaseVelocity(ball, (speed * impulse.direction).tolist(), physicsClientId=client)
        memory = memory or _memory(restart=True)
        for _ in range(STEPS_TO_BREAK):
            begin = perf_counter()
            broken = world.step()
            seconds = perf_counter() - begin
            if broken:
                event, engine = broken[0], world.engine_seconds
                world.step()
                after = world.engine_seconds  # of the first step that the pieces take
                parts = sum(len(piece.convex_parts) for piece in event.fracture.pieces)
                rows.append([1e3 * (seconds + after), 1e3 * engine, 1e3 * after, len(event.children), parts])
                for name, ms in event.timings.items():
                    stages.setdefault(name, []).append(ms)
                break
    p.disconnect(client)
    return {"shots": count, "rows": rows, "stages": stages, "extra_memory_mb": _memory() - memory}


def _memory(restart: bool = False) -> float:
    """Read the peak memory of this process in MB (Linux); restart: begin to count the peak from what it holds now."""
    if restart:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def thesis(count: int, seed: int) -> dict[str, Any]:
    """Time the thesis's pipeline on the bunny: perceptron, then watershed.

    The perceptron is not trained, since the values of its weights cost no time.

    Parameters
    ----------
    count : int
        How many breaks to time.
    seed : int
        Draws the impulses.

    Returns
    -------
    dict
        ``prediction`` and ``segmentation``, a list of ms each.
    """
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
    fractures = (asset.fracture(impulse) for impulse in asset.sample_impulses(200, seed))
    for fracture in [fracture for fracture in fractures if fracture.broken][:count]:
        inputs = np.hstack([points, np.tile(rng.normal(size=6), (len(points), 1))]).astype(np.float32)
        begin = perf_counter()
        with torch.inference_mode():
            net(torch.from_numpy(inputs)).numpy()
        prediction.append(1e3 * (perf_counter() - begin))
        prepared = prepare(graph, fracture.udf / asset.size)
        begin = perf_counter()
        REFERENCES["watershed"](prepared, THRESHOLD)
        segmentation.append(1e3 * (perf_counter() - begin))
    return {"prediction": prediction, "segmentation": segmentation}


def _fine_bunny(folder: Path) -> Path:
    """Bake the bunny with every face split in three twice, some 30,000 vertices: a few minutes, once a folder."""
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
    """Measure the breaks of each mesh, and the thesis's pipeline.

    Parameters
    ----------
    quick : bool
        Whether to measure the bunny only, with fewer hits.
    seed : int
        Draws the hits.
    progress : callable
        Called with the share done, from 0 to 1.
    work : Path, optional
        A folder that keeps the fine bunny; by default one in the system's temporary folder.

    Returns
    -------
    dict
        Plain data.
    """
    meshes = MESHES[:1] if quick else MESHES
    shots = QUICK_SHOTS if quick else SHOTS
    result: dict[str, Any] = {"shots": shots, "size": SIZE, "limits": LIMITS, "meshes": {}}
    folder = work or Path(tempfile.gettempdir()) / "fracsim-bench"
    folder.mkdir(exist_ok=True)
    for done, name in enumerate(meshes):
        source = str(_fine_bunny(folder)) if name == "bunny 9x" else name
        processes = [_in_process("events", source, shots, seed)]
        further = range(1, QUICK_PROCESSES if quick else PROCESSES)
        processes += [_in_process("events", source, FIRST_SHOTS, seed + number) for number in further]
        result["meshes"][name] = summary_of(processes) | {"vertices": load(source).vertex_count}
        progress((done + 1) / (len(meshes) + 1))
    times = _in_process("thesis", "bunny", QUICK_THESIS_BREAKS if quick else THESIS_BREAKS, seed)
    total = np.array(times["prediction"]) + np.array(times["segmentation"])
    result["thesis"] = {
        "prediction_ms": float(np.median(times["prediction"])),
        "segmentation_ms": float(np.median(times["segmentation"])),
        "median_ms": float(np.median(total)),
        "p99_ms": float(np.quantile(total, 0.99)),
        "times_ours": float(np.median(total) / result["meshes"]["bunny"]["median_ms"]),
    }
    progress(1.0)
    return result


def _in_process(function: str, source: str, count: int, seed: int) -> dict[str, Any]:
    """Call a function of this module in a process of its own, and read what it prints last."""
    command = [sys.executable, "-m", "fracsim.bench.latency", function, source, str(count), str(seed)]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(process.stdout.splitlines()[-1])


def summary_of(processes: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise the breaks of one mesh.

    Parameters
    ----------
    processes : list of dict
        What ``events`` returned in each process. The first process counts with all its breaks, each with its first.

    Returns
    -------
    dict
        Plain data.
    """
    rows = np.array(processes[0]["rows"])
    first = [process["rows"][0][0] for process in processes if process["rows"]]
    whole = rows[:, 0]
    stages = {name: float(np.median(values)) for name, values in processes[0]["stages"].items()}
    counts = np.histogram(rows[:, 3], PIECE_BINS)[0]
    bins = zip(PIECE_BINS, PIECE_BINS[1:], counts, strict=False)
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
        "convex_parts": [int(value) for value in rows[:, 4]],
        "ms": [float(value) for value in whole],
        "histogram": {f"{a}-{b - 1}": int(n) for a, b, n in bins},
    }


def table(figures: dict[str, Any]) -> str:
    """Write the figures as Markdown.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.

    Returns
    -------
    str
        A table, and two paragraphs below it.
    """
    lines = [
        "| mesh | vertices | events | pieces, median / most | convex parts | median, ms | p99, ms | "
        "first of a process, ms | the engine's own step | extra memory, MB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in figures["meshes"].items():
        first = row["first_ms"]
        lines.append(
            f"| {name} | {row['vertices']} | {row['events']} | {np.median(row['pieces']):.0f} / {max(row['pieces'])} | "
            f"{np.median(row['convex_parts']):.0f} | **{row['median_ms']:.1f}** | **{row['p99_ms']:.1f}** | "
            f"{np.median(first):.1f} (most {max(first):.1f}) | {row['engine_step_ms']:.2f} | "
            f"{row['extra_memory_mb']:.0f} |"
        )
    thesis = figures["thesis"]
    lines += [
        "",
        f"The thesis's pipeline on the bunny, no bodies: {thesis['prediction_ms']:.0f} ms of prediction and "
        f"{thesis['segmentation_ms']:.1f} ms of segmentation, {thesis['median_ms']:.0f} ms in all (p99 "
        f"{thesis['p99_ms']:.0f}): **{thesis['times_ours']:.0f} times** ours with bodies.",
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
    """Draw the time of each break over its pieces, and how many breaks have how many pieces.

    Parameters
    ----------
    figures : dict
        What ``measure`` returned.
    path : Path
        The PNG file to write.
    """
    meshes = figures["meshes"]
    figure = new_figure(9, 3.6)
    left, right = figure.subplots(1, 2)
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
    save_figure(figure, path)


def _main() -> None:
    """Run one function in this process, as ``_in_process`` asks, and print what it returns as JSON."""
    function, source, count, seed = sys.argv[1:]
    if function == "thesis":
        print(json.dumps(thesis(int(count), int(seed))))
    else:
        asset = load(source)
        print(json.dumps(events(asset.scaled(SIZE / asset.size), int(count), int(seed))))


if __name__ == "__main__":
    _main()
