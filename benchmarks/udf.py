"""How exact the distance to the cracks is, and what it costs: error against time of ways to compute it.

python benchmarks/udf.py            # writes benchmarks/results/udf.{json,md,png}; about twenty minutes

The field is asked at every vertex and edge midpoint. The truth on the bunny, chair and vase is the exact
polyhedral distance (MMP, pygeodesic) on a mesh that has the crack curve for edges, from points every REFERENCE
along the curve; on the sphere, cylinder and box it is known in closed form. Lengths are in units of the size,
distances end at udf.CAP. The cracks are those of random impacts on the simulator's own body.

pygeodesic (the extra `check` brings it) is needed for the truth on the meshes and one row. Without it the row is
missing, and the truth there is marched on a surface of 16 times the faces instead.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import potpourri3d
import trimesh
from scipy.spatial import cKDTree

from fracsim.geometry.sampling import CONE, SurfacePoints, cone
from fracsim.metrics import amae
from fracsim.simulators.base import Impacts
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.cut import DegenerateCut, cut_once, join_slivers
from fracsim.solids.geodesics import CAP, CurveDistances, split_in_four
from fracsim.solids.lattice import tilted_lattice
from fracsim.solids.polygons import coarsen
from fracsim.solids.solid import Solid, relabel
from fracsim.solids.surface import Surface, read_surface, refine

try:
    from pygeodesic import geodesic
except ImportError:
    geodesic = None

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Field = Callable[[IntArray], FloatArray]  # labels (P,) to distances (V + E,)

RESULTS = Path(__file__).parent / "results"
MESHES = Path(__file__).parent.parent / "meshes"
CELLS, SEED = 5000, 0
FRACTURES = 30
RATIOS = (1.0, 5.0)  # of an impact's severity to the one at which it would first part the body
REFERENCE, COARSE = 0.001, 0.004  # of the size: spacing of the points on the curve, for the truth and for the row
OURS = "ours: exact seeds, marched, split mesh"
SEEDED = "marched from vertices, mesh as given"
HEAT = "heat method, mesh as given"
HEAT_SPLIT = "heat method, split mesh"
EXACT = f"exact polyhedral, points every {COARSE}"


def fractures(simulator: ModalSimulator, count: int, rng: np.random.Generator) -> IntArray:
    """(count, P) labels: the answers to single impacts at random places that part the body."""
    pool = SurfacePoints(simulator.surface.vertices, simulator.surface.faces)
    face, bary = pool.draw(2 * count, rng)
    directions = cone(-pool.normals[face], CONE, rng)
    impacts = Impacts(face[:, None], bary[:, None], directions[:, None], np.ones((2 * count, 1)))
    ratio = np.exp(rng.uniform(*np.log(RATIOS), 2 * count))
    labels = simulator.fracture(impacts.times(ratio * simulator.thresholds(impacts))).labels
    return labels[labels.any(axis=1)][:count]


# ----------------------------------------------------------------------------------------- ways to compute it


def ours(solid: Solid, surface: Surface) -> Field:
    return CurveDistances(solid, surface).between


def with_midpoints(values: FloatArray, edges: IntArray) -> FloatArray:
    """Capped values (V + E,): the midpoints of a mesh that has no nodes there take the mean of their ends."""
    return np.minimum(np.concatenate([values, values[edges].mean(axis=1)]), CAP)


def vertices_beside(solid: Solid, surface: Surface, edges: IntArray) -> Callable[[IntArray], IntArray]:
    """From labels to the vertices that have a neighbour on another piece."""
    part = solid.vertex_cells(len(surface.vertices))
    return lambda labels: np.unique(edges[labels[part[edges[:, 0]]] != labels[part[edges[:, 1]]]])


def seeded(solid: Solid, surface: Surface) -> Field:
    _, _, edges, _ = split_in_four(surface)
    beside = vertices_beside(solid, surface, edges)
    solver = potpourri3d.MeshFastMarchingDistanceSolver(surface.vertices, surface.faces)

    def field(labels: IntArray) -> FloatArray:
        seeds = beside(labels).tolist()
        if not seeds:  # a piece without a vertex
            return np.full(len(surface.vertices) + len(edges), CAP)
        marched = solver.compute_distance([[(s, [])] for s in seeds], [[0.0]] * len(seeds))
        return with_midpoints(marched, edges)

    return field


def heat(solid: Solid, surface: Surface) -> Field:
    _, _, edges, _ = split_in_four(surface)
    beside = vertices_beside(solid, surface, edges)
    solver = potpourri3d.MeshHeatMethodDistanceSolver(surface.vertices, surface.faces)

    def field(labels: IntArray) -> FloatArray:
        seeds = beside(labels)
        if len(seeds) == 0:
            return np.full(len(surface.vertices) + len(edges), CAP)
        return with_midpoints(solver.compute_distance_multisource(seeds), edges)

    return field


def heat_split(solid: Solid, surface: Surface) -> Field:
    """The heat method on our nodes, from the node nearest to each segment of the curve."""
    nodes, fine, _, _ = split_in_four(surface)
    curves = CurveDistances(solid, surface)
    nearest = curves.corners[np.arange(len(curves.corners)), curves.beside.argmin(axis=1)]
    solver = potpourri3d.MeshHeatMethodDistanceSolver(nodes, fine)

    def field(labels: IntArray) -> FloatArray:
        chosen = labels[curves.cells[:, 0]] != labels[curves.cells[:, 1]]
        return np.minimum(solver.compute_distance_multisource(np.unique(nearest[chosen])), CAP)

    return field


def exact(solid: Solid, surface: Surface, spacing: float = COARSE) -> Field:
    """Exact distances on the polyhedron (Mitchell, Mount and Papadimitriou 1987) from points on the curve.

    The mesh is the solid's own outside, where cracks run along edges, with points every ``spacing`` on those
    edges and a point at the middle of every edge of the surface.
    """
    curves = CurveDistances(solid, surface)
    vertices = len(surface.vertices)
    _, _, edges, face_edges = split_in_four(surface)
    outer = solid.source >= 0
    triangles, source = solid.triangles[outer], solid.source[outer]
    halves = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    lines, line = np.unique(np.sort(halves, axis=1), axis=0, return_inverse=True)
    line = line.reshape(-1)
    order = np.argsort(line, kind="stable")
    left, right = source[order[::2] // 3], source[order[1::2] // 3]  # closed: two triangles a line
    # Points to put on each line, as a line and a parameter along it.
    crack = np.searchsorted(lines[:, 0] * len(solid.points) + lines[:, 1], curves.segments @ [len(solid.points), 1])
    length = np.linalg.norm(solid.points[curves.segments[:, 0]] - solid.points[curves.segments[:, 1]], axis=1)
    steps = np.ceil(length / spacing).astype(np.int64)
    on = np.repeat(crack, steps - 1)
    step = np.arange(len(on)) - np.repeat(np.cumsum(steps - 1) - (steps - 1), steps - 1) + 1
    t = step / np.repeat(steps, steps - 1)
    # A line between two input faces lies on the edge that they share; the middle of that edge may be on it.
    rim = np.flatnonzero(left != right)
    shared = (face_edges[left[rim]][:, :, None] == face_edges[right[rim]][:, None]).any(axis=2)
    edge = face_edges[left[rim], shared.argmax(axis=1)]
    p, q = np.moveaxis(solid.points[lines[rim]], 1, 0)
    middle = ((curves.nodes[vertices + edge] - p) * (q - p)).sum(axis=1) / ((q - p) ** 2).sum(axis=1)
    holds = (middle > 1e-9) & (middle < 1 - 1e-9)
    if not np.array_equal(np.sort(edge[holds]), np.arange(len(edges))):
        raise RuntimeError("the middle of an edge is lost")
    on, t = np.concatenate([on, rim[holds]]), np.concatenate([t, middle[holds]])
    added = solid.points[lines[on, 0]] * (1 - t)[:, None] + solid.points[lines[on, 1]] * t[:, None]
    new = len(solid.points) + np.arange(len(on))
    at_middle = np.empty(len(edges), dtype=np.int64)
    at_middle[edge[holds]] = new[len(on) - int(holds.sum()) :]
    # Chains of points along the lines, and triangles from their links to the middles of the faces.
    where = np.concatenate([np.arange(len(lines)), np.arange(len(lines)), on])
    along = np.concatenate([np.zeros(len(lines)), np.ones(len(lines)), t])
    ids = np.concatenate([lines[:, 0], lines[:, 1], new])
    order = np.lexsort((along, where))
    chain, owner = ids[order], where[order]
    link = np.flatnonzero(owner[1:] == owner[:-1])
    links, owner = np.stack([chain[link], chain[link + 1]], axis=1), owner[link]
    low, high = (np.searchsorted(owner, line, side=side) for side in ("left", "right"))
    half = np.repeat(np.arange(len(line)), high - low)
    row = low[half] + np.arange(len(half)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    ends = np.where((halves[half, 0] == lines[line[half], 0])[:, None], links[row], links[row][:, ::-1])
    plain = np.bincount(half // 3) == 3
    busy = ~plain[half // 3]
    rank = np.cumsum(~plain) - 1
    centre = len(solid.points) + len(on) + rank[half[busy] // 3]
    faces = np.vstack([triangles[plain], np.column_stack([ends[busy], centre])])
    points = np.vstack([solid.points, added, solid.points[triangles[~plain]].mean(axis=1)])
    solver = geodesic.PyGeodesicAlgorithmExact(points, faces)
    cuts = np.concatenate([[0], np.cumsum(steps - 1)]) + len(solid.points)
    targets = np.concatenate([np.arange(vertices), at_middle])

    def field(labels: IntArray) -> FloatArray:
        chosen = np.flatnonzero(labels[curves.cells[:, 0]] != labels[curves.cells[:, 1]])
        between = np.concatenate([np.arange(cuts[k], cuts[k + 1]) for k in chosen])
        sources = np.concatenate([np.unique(curves.segments[chosen]), between])
        distance, _ = solver.geodesicDistances(sources, targets)
        # Where a node's own face holds the curve, the straight way to the segment beats the one to its points.
        np.minimum.at(distance, curves.corners[chosen].ravel(), curves.beside[chosen].ravel())
        return np.minimum(distance, CAP)

    return field


METHODS: dict[str, Callable[[Solid, Surface], Field]] = {
    OURS: ours,
    SEEDED: seeded,
    HEAT: heat,
    HEAT_SPLIT: heat_split,
    EXACT: exact,
}


# --------------------------------------------------------------------------------- the same cracks, other meshes


def recut(simulator: ModalSimulator, fine: Surface) -> Solid:
    """The simulator's cells with the same shape in finer faces for their outside: the same lattice, cut again."""
    rng = np.random.default_rng(SEED)
    while True:
        lattice = tilted_lattice(simulator.surface, CELLS, rng)
        try:
            cut_once(simulator.surface, *lattice)  # the simulator's own lattice is the first that can be cut
        except DegenerateCut:
            continue
        cells = join_slivers(cut_once(fine, *lattice))
        distance, match = cKDTree(simulator.fine_cells.centroids).query(cells.centroids)
        if len(cells.volumes) != len(simulator.fine_cells.volumes) or distance.max() > 1e-9:
            raise RuntimeError("the finer surface gives other cells")
        return coarsen(relabel(cells, simulator.fine_to_cell[match]), fine)


def subdivided(surface: Surface, times: int) -> Surface:
    """Every face split in four, ``times`` over; the old vertices stay first."""
    for _ in range(times):
        nodes, faces, _, _ = split_in_four(surface)
        surface = replace(surface, vertices=nodes, faces=faces)
    return surface


def with_vertices(surface: Surface, count: int) -> Surface:
    """The same shape with about ``count`` vertices."""
    low, high = 1e-3, 1.0
    for _ in range(24):
        longest = float(np.sqrt(low * high))
        fine = refine(surface, longest)
        low, high = (longest, high) if len(fine.vertices) > count else (low, longest)
        if abs(len(fine.vertices) - count) < 0.01 * count:
            break
    return fine


# ------------------------------------------------------------------------------------------------ closed forms


def plane_cut(surface: Surface, normal: FloatArray, offset: float) -> Solid:
    """A body in two parts, on either side of a plane; its outside only, which is all that distances ask for."""
    height = surface.vertices @ normal - offset
    above = height > 0
    count = above[surface.faces].sum(axis=1)
    whole = np.flatnonzero(count % 3 == 0)
    crossed = np.flatnonzero(count % 3)
    lone = np.where(count[crossed] == 1, above[surface.faces[crossed]].T, ~above[surface.faces[crossed]].T).T
    first = lone.argmax(axis=1)
    a, b, c = (surface.faces[crossed, (first + k) % 3] for k in range(3))
    ends = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    unique, point = np.unique(ends, axis=0, return_inverse=True)
    t = height[unique[:, 0]] / (height[unique[:, 0]] - height[unique[:, 1]])
    p, q = surface.vertices[unique[:, 0]], surface.vertices[unique[:, 1]]
    x, y = point.reshape(2, -1) + len(surface.vertices)
    triangles = [surface.faces[whole]] + [np.stack(corner, axis=1) for corner in ((a, x, y), (x, b, c), (x, c, y))]
    part = np.concatenate([above[surface.faces[whole, 0]], above[a], above[b], above[b]]).astype(np.int64)
    source = np.concatenate([whole, crossed, crossed, crossed])
    points = np.vstack([surface.vertices, p + t[:, None] * (q - p)])
    sides = np.column_stack([part, np.full(len(part), -1)])
    return Solid(points, np.vstack(triangles), sides, source, np.zeros(2), np.zeros((2, 3)))


def unrolled_distance(nodes: FloatArray, corners: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """Distance on the side of a tall prism over the convex polygon ``corners`` (n, 2) to where a plane cuts it.

    The side unrolls into a strip, the cut into n straight segments of it; far from the ends, the distance is
    that in the plane.
    """
    ends = np.roll(corners, -1, axis=0)
    width = np.linalg.norm(ends - corners, axis=1)
    along = (ends - corners) / width[:, None]
    arm = nodes[:, None, :2] - corners
    u = np.clip((arm * along).sum(axis=2), 0, width)
    side = np.linalg.norm(arm - u[:, :, None] * along, axis=2).argmin(axis=1)
    start = np.cumsum(width) - width
    flat = np.column_stack([start[side] + u[np.arange(len(nodes)), side], nodes[:, 2]])
    rise = [(offset - end @ normal[:2]) / normal[2] for end in (corners, ends)]
    p, q = np.column_stack([start, rise[0]]), np.column_stack([start + width, rise[1]])
    best = np.full(len(nodes), np.inf)
    for turn in (-1, 0, 1):
        shift = np.array([turn * width.sum(), 0.0])
        arm = flat[:, None] - (p + shift)
        t = np.clip((arm * (q - p)).sum(axis=2) / ((q - p) ** 2).sum(axis=1), 0, 1)
        best = np.minimum(best, np.linalg.norm(arm - t[:, :, None] * (q - p), axis=2).min(axis=1))
    return np.minimum(best, CAP)


def closed_forms() -> dict[str, tuple[Surface, list[Solid], list[FloatArray]]]:
    """Shapes with solids in two parts, and the true distance at their nodes."""
    rng = np.random.default_rng(1)
    result = {}
    ball = trimesh.creation.icosphere(5, radius=0.5)
    surface = Surface(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int64), 1.0, np.zeros(3), "sphere")
    nodes = split_in_four(surface)[0]
    solids, truths = [], []
    for _ in range(10):
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        offset = rng.uniform(-0.3, 0.3)
        solids.append(plane_cut(surface, normal, offset))
        latitude = np.arcsin(np.clip(nodes @ normal / np.linalg.norm(nodes, axis=1), -1, 1))
        truths.append(np.minimum(0.5 * np.abs(latitude - np.arcsin(offset / 0.5)), CAP))
    result["sphere"] = (surface, solids, truths)
    for name, sides, radius in (("cylinder", 32, 0.2), ("box", 4, 0.25)):
        angle = 2 * np.pi * np.arange(sides) / sides
        corners = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rod = trimesh.creation.extrude_triangulation(
            corners, np.stack([np.zeros(sides - 2), np.arange(1, sides - 1), np.arange(2, sides)], 1).astype(int), 1.0
        )
        rod.apply_translation((0, 0, -0.5))
        surface = Surface(np.asarray(rod.vertices), np.asarray(rod.faces, dtype=np.int64), 1.0, np.zeros(3), name)
        surface = refine(surface, 0.04)
        nodes = split_in_four(surface)[0]
        solids, truths = [], []
        for _ in range(10):
            tilt, turn = rng.uniform(0.0, 0.4), rng.uniform(0, 2 * np.pi)
            normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
            offset = rng.uniform(-0.05, 0.05)
            solids.append(plane_cut(surface, normal, offset))
            truths.append(unrolled_distance(nodes, corners, normal, offset))
        result[name] = (surface, solids, truths)
    return result


# ---------------------------------------------------------------------------------------------------- measuring


def measure(truths: list[FloatArray], fields: list[FloatArray], vertices: int) -> dict[str, float]:
    error = np.abs(np.array(truths) - np.array(fields))
    near = np.array(truths) < CAP
    return {
        "mean_vertices": float(error[:, :vertices].mean()),
        "mean_midpoints": float(error[:, vertices:].mean()),
        "mean_near": float(error[near].mean()),
        "p99": float(np.quantile(error, 0.99)),
        "max": float(error.max()),
        "amae": float(np.mean([amae(t, f) for t, f in zip(truths, fields, strict=True)])),
    }


def timed(call: Callable[[], object]) -> tuple[float, object]:
    start = time.perf_counter()
    value = call()
    return time.perf_counter() - start, value


def row(
    name: str, method: str, build: list[float], seconds: list[float], errors: dict[str, float]
) -> dict[str, object]:
    print(f"{name:9}{method:42} mean {errors['mean_vertices']:.1e} max {errors['max']:.1e}", flush=True)
    milliseconds = 1e3 * np.array(seconds)
    return {
        "shape": name,
        "method": method,
        **errors,
        "build_ms": 1e3 * float(np.median(build)),
        "median_ms": float(np.median(milliseconds)),
        "p99_ms": float(np.quantile(milliseconds, 0.99)),
    }


def on_mesh(simulator: ModalSimulator, labels: IntArray) -> list[dict[str, object]]:
    name, surface = Path(simulator.surface.name).stem, simulator.surface
    if geodesic:
        reference = exact(simulator.cells, surface, REFERENCE)
        truths = [reference(label) for label in labels]
    else:
        nodes = len(split_in_four(surface)[0])
        fine = subdivided(surface, 2)
        reference = CurveDistances(recut(simulator, fine), fine).between
        truths = [reference(label)[:nodes] for label in labels]  # the first subdivision's nodes are ours
    rows = []
    for method, make in METHODS.items():
        if make is exact and geodesic is None:
            continue
        build, field = timed(partial(make, simulator.cells, surface))
        seconds, fields = zip(*[timed(partial(field, label)) for label in labels], strict=True)
        rows.append(row(name, method, [build], seconds, measure(truths, fields, len(surface.vertices))))
    return rows


def on_closed_form(name: str, surface: Surface, solids: list[Solid], truths: list[FloatArray]) -> list[dict]:
    rows = []
    for method, make in METHODS.items():
        if make is exact and geodesic is None:
            continue
        made = [timed(partial(make, solid, surface)) for solid in solids]
        results = [timed(partial(field, np.array([0, 1]))) for _, field in made]
        errors = measure(truths, [field for _, field in results], len(surface.vertices))
        rows.append(row(name, method, [b for b, _ in made], [s for s, _ in results], errors))
    return rows


def converges(simulator: ModalSimulator, labels: IntArray) -> list[dict[str, object]]:
    """How fields come together as spacing and faces shrink: mean and largest gap to the truth."""
    surface = simulator.surface
    nodes = len(split_in_four(surface)[0])
    reference = exact(simulator.cells, surface, REFERENCE)
    truths = np.array([reference(label) for label in labels])

    def entry(what: str, fields: list[FloatArray]) -> dict[str, object]:
        gap = np.abs(np.array(fields) - truths)
        print(f"{what}: {gap.mean():.1e}, {gap.max():.1e}", flush=True)
        return {"what": what, "mean": float(gap.mean()), "max": float(gap.max())}

    rows = []
    for spacing in (4 * REFERENCE, 2 * REFERENCE, REFERENCE / 2):
        field = exact(simulator.cells, surface, spacing)
        rows.append(entry(f"exact polyhedral, points every {spacing:g}", [field(label) for label in labels]))
    for times in range(3):
        fine = subdivided(surface, times)
        curves = CurveDistances(simulator.cells if times == 0 else recut(simulator, fine), fine)
        fields = [curves.between(label)[:nodes] for label in labels]
        rows.append(entry(f"ours on {4**times} × the faces", fields))
    return rows


def resolutions(simulator: ModalSimulator, labels: IntArray) -> list[dict[str, object]]:
    """The same fractures on 1, 3 and 9 times the vertices: mean gaps of the field at the vertices they share."""
    base = len(simulator.surface.vertices)
    surfaces = [simulator.surface, *(with_vertices(simulator.surface, k * base) for k in (3, 9))]
    solids = [simulator.cells, *(recut(simulator, fine) for fine in surfaces[1:])]
    rows = []
    for method in (OURS, SEEDED, HEAT, HEAT_SPLIT):
        fields = []
        for solid, surface in zip(solids, surfaces, strict=True):
            distance, same = cKDTree(surface.vertices).query(simulator.surface.vertices)
            if distance.max() > 1e-12:
                raise RuntimeError("a vertex went missing")
            field = METHODS[method](solid, surface)
            fields.append(np.array([field(label)[same] for label in labels]))
        gaps = {
            f"{a} to {b}": np.abs(fields[i] - fields[j]).mean(axis=1)
            for (i, a), (j, b) in (((0, "1×"), (1, "3×")), ((1, "3×"), (2, "9×")), ((0, "1×"), (2, "9×")))
        }
        print(method, {key: f"{gap.mean():.2%}" for key, gap in gaps.items()}, flush=True)
        rows.append(
            {
                "method": method,
                "vertices": [len(surface.vertices) for surface in surfaces],
                "mean": {key: float(gap.mean()) for key, gap in gaps.items()},
                "worst": {key: float(gap.max()) for key, gap in gaps.items()},
            }
        )
    return rows


def draw(rows: list[dict], gaps: list[dict]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.6), width_ratios=(1.4, 1))
    shapes = list(dict.fromkeys(r["shape"] for r in rows))
    markers = dict(zip(shapes, "osDv^P", strict=False))
    colors = {method: f"C{k}" for k, method in enumerate(METHODS)}
    for r in rows:
        left.loglog(r["median_ms"], r["mean_near"], markers[r["shape"]], color=colors[r["method"]], ms=7, alpha=0.85)
    for method in dict.fromkeys(r["method"] for r in rows):
        left.plot([], [], "s", color=colors[method], label=method)
    for shape in shapes:
        left.plot([], [], markers[shape], color="none", markeredgecolor="k", label=shape)
    left.set(
        xlabel="time for one field, ms (median)",
        ylabel="mean error where the truth is below the cap, of the size",
        title="Distance to the cracks: error against time",
    )
    left.grid(alpha=0.3)
    left.legend(fontsize=7, loc="best", ncols=2)
    for k, r in enumerate(gaps):
        values = [100 * v for v in r["mean"].values()]
        x = np.arange(len(values)) + 0.2 * (k - (len(gaps) - 1) / 2)
        right.bar(x, values, 0.19, color=colors[r["method"]], label=r["method"])
    right.axhline(1.0, color="k", ls="--", lw=1)
    right.text(-0.4, 1.02, "target: 1 %", ha="left", va="bottom", fontsize=8)
    right.set_xticks(range(3), [key for key in gaps[0]["mean"]])
    right.set(ylabel="mean difference at shared vertices, % of the size", title="Bunny: the same cracks, finer meshes")
    right.set_ylim(0, 1.5)
    right.legend(fontsize=7, loc="upper right")
    figure.tight_layout()
    figure.savefig(RESULTS / "udf.png", dpi=120)


def write(result: dict) -> None:
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "udf.json").write_text(json.dumps(result, indent=2) + "\n")
    known = result["truth"]
    lines = [
        "Distance to the cracks at vertices and edge midpoints: error, in units of the size, and time.",
        f"`python benchmarks/udf.py`, seed {SEED}. {known}",
        f"Meshes: {FRACTURES} fractures each, single impacts at {RATIOS[0]:g} to {RATIOS[1]:g} times what parts them.",
        "Sphere, cylinder and box: 10 planar cuts each, the truth in closed form; the sphere's is that of the round",
        f'sphere (10,242 vertices). Fields end at {CAP}; "near" counts only nodes nearer than that. The p99 time is',
        "over the fields of a shape, so close to the slowest.",
        "",
        "| shape | method | mean, vertices | mean, midpoints | mean, near | 99 % | max | AMAE | field, ms | p99 | "
        "build, ms |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in result["rows"]:
        figures = " | ".join(
            f"{r[key]:.1e}" for key in ("mean_vertices", "mean_midpoints", "mean_near", "p99", "max", "amae")
        )
        lines.append(
            f"| {r['shape']} | {r['method']} | {figures} | {r['median_ms']:.1f} | {r['p99_ms']:.1f} | "
            f"{r['build_ms']:.0f} |"
        )
    if result["convergence"]:
        lines += [
            "",
            f"The truth has converged (bunny, {result['convergence_fractures']} fractures): gaps to the truth with",
            f"points every {REFERENCE:g}.",
            "",
            "| | mean | max |",
            "|---|---|---|",
            *(f"| {r['what']} | {r['mean']:.1e} | {r['max']:.1e} |" for r in result["convergence"]),
        ]
    counts = ", ".join(f"{v:,}" for v in result["resolutions"][0]["vertices"])
    lines += [
        "",
        f"The same fractures of the bunny on meshes of {counts} vertices of one shape: mean difference of the field at",
        "the shared vertices, in the mean over fractures (worst fracture). The target is below 1 % of the size.",
        "",
        "| method | 1× to 3× | 3× to 9× | 1× to 9× |",
        "|---|---|---|---|",
    ]
    for r in result["resolutions"]:
        cells = " | ".join(f"{r['mean'][key]:.2%} ({r['worst'][key]:.2%})" for key in r["mean"])
        lines.append(f"| {r['method']} | {cells} |")
    (RESULTS / "udf.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def main() -> None:
    rows: list[dict] = []
    gaps: list[dict] = []
    convergence: list[dict] = []
    for name in ("bunny", "chair", "vase"):
        surface = replace(refine(read_surface(MESHES / f"{name}.obj")), name=name)
        simulator = ModalSimulator.build(surface, SimulatorOptions(cells=CELLS), np.random.default_rng(SEED))
        labels = fractures(simulator, FRACTURES, np.random.default_rng(SEED + 1))
        rows += on_mesh(simulator, labels)
        if name == "bunny":
            gaps = resolutions(simulator, labels)
            if geodesic:
                convergence = converges(simulator, labels[:5])
    for name, (surface, solids, truths) in closed_forms().items():
        rows += on_closed_form(name, surface, solids, truths)
    known = f"Truth on the meshes: exact polyhedral distance (MMP) to points every {REFERENCE:g} along the cracks."
    if geodesic is None:
        known = "pygeodesic is missing: no exact row, and truth on the meshes is ours on 16 times the faces."
    result = {
        "command": "python benchmarks/udf.py",
        "seed": SEED,
        "fractures": FRACTURES,
        "truth": known,
        "rows": rows,
        "resolutions": gaps,
        "convergence": convergence,
        "convergence_fractures": 5,
    }
    write(result)
    draw(rows, gaps)


if __name__ == "__main__":
    main()
