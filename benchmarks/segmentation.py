"""How good segmentations are, and how long they take: ``python benchmarks/segmentation.py`` (about 5 minutes).

The true fields of FRACTURES impulses that break the bunny (at three resolutions, every face split in three at its
centroid), the chair and the vase are segmented by the thesis's five methods at the thesis's parameters, as the thesis
states them on a NetworkX graph and as we compute them, and by ours: midpoint segmentation, with and without links, and
the watershed over atoms. Then the same on fields with errors. For times, run it on a quiet machine.
Writes benchmarks/results/segmentation.{json,md,png}. ``--table`` only writes table and chart again, from the JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from threadpoolctl import threadpool_limits

from fracsim.data.samples import sample
from fracsim.learning.atoms import atoms_for
from fracsim.learning.body import BodyGeometry
from fracsim.metrics import amae, ari
from fracsim.segmentation import METHODS
from fracsim.segmentation.graph import SurfaceGraph
from fracsim.segmentation.midpoints import midpoint_segmentation
from fracsim.segmentation.reference import REFERENCES, prepare
from fracsim.simulators.base import merge_small_pieces_each
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.geodesics import CAP, split_in_four
from fracsim.solids.surface import Surface, read_surface, refine, split_faces

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Cut = Callable[[FloatArray], IntArray]  # a field (V + E,) to labels (V,)

HERE = Path(__file__).parent
RESULTS = HERE / "results"
SEED = 0
FRACTURES = 100
REPEATS = 3  # of which the fastest counts, because other programs on the machine interrupt
TIMED = 3  # fractures that the references, and rules without a fast version, are run on
WORSE = 40  # fractures whose fields get errors
HEIGHTS = (0.002, 0.014)  # of passes between atoms: for exact fields, and for those of the default model
SLACK = 0.06  # of midpoint segmentation, where fields are not exact
OURS, LINKED = "midpoints", "midpoints and links"
ATOMS = [f"atoms at {height}" for height in HEIGHTS]
SLACKER = f"midpoints and links, slack {SLACK}"
LOW = "watershed at 0.05"


class Case:
    """One mesh: its graphs, and the true fields and labels of its fractures."""

    def __init__(self, name: str, surface: Surface) -> None:
        self.name = name
        options = SimulatorOptions()
        simulator = make_simulator(surface, options, SEED)
        self.body = BodyGeometry.of(surface, atoms_for(simulator, [], options.min_piece_volume_fraction))
        samples = sample(simulator, 4 * FRACTURES, SEED)
        self.atoms = samples.labels[samples.labels.any(axis=1)][:FRACTURES]
        self.truth = self.atoms[:, self.body.vertex_atom]
        self.nodes = self.body.fields(self.atoms, nodes=True).astype(np.float64)
        self.graph = SurfaceGraph.of(surface)
        self.linked = SurfaceGraph.of(surface, self.body.links)
        self.count = len(surface.vertices)
        _ = self.body.atom_watershed, self.body.vertex_atom

    def flooded(self, nodes: FloatArray, height: float) -> IntArray:
        labels = self.body.atom_watershed.labels(nodes[: self.count], height)
        atoms = self.body.atoms
        whole = merge_small_pieces_each(
            labels[None], self.body.volumes, atoms.interfaces, atoms.min_piece_volume_fraction
        )[0]
        return whole[self.body.vertex_atom]

    def at_vertices(self, method: str, parameter: float | None = None) -> Cut:
        return lambda nodes: METHODS[method](self.graph, nodes[: self.count], parameter)

    def ours(self) -> dict[str, Cut]:
        return {
            OURS: lambda nodes: midpoint_segmentation(self.graph, nodes),
            LINKED: lambda nodes: midpoint_segmentation(self.linked, nodes),
            **{name: partial(self.flooded, height=height) for name, height in zip(ATOMS, HEIGHTS, strict=True)},
        }

    def tried(self) -> dict[str, Cut]:
        """Earlier rules, which midpoint segmentation replaced."""
        return {"mid-rule": self.mid_rule, "saddle merge": self.saddle_merge}

    def mid_rule(self, nodes: FloatArray) -> IntArray:
        """Join edges whose midpoint is above 0.7 of the mean of their ends, and above 0.2 of their length."""
        pairs, middle = self.graph.surface, nodes[self.count :]
        mean = 0.5 * (nodes[pairs.first] + nodes[pairs.second])
        return pairs.connected((middle > 0.2 * self.graph.lengths) & (middle > 0.7 * mean))

    def saddle_merge(self, nodes: FloatArray) -> IntArray:
        """Join across edges by falling midpoint, where it is above 0.08 or 0.8 of the lower of two peaks."""
        heights, middle = nodes[: self.count], nodes[self.count :]
        parent, peak = list(range(self.count)), heights.tolist()

        def find(x: int) -> int:
            while parent[x] != x:
                parent[x] = parent[parent[x]]
                x = parent[x]
            return x

        rows = np.argsort(-middle, kind="stable")
        rows = rows[middle[rows] > 0.1 * self.graph.lengths[rows]]
        for (a, b), height in zip(self.graph.edges[rows].tolist(), middle[rows].tolist(), strict=True):
            i, j = find(a), find(b)
            if i != j and (height > 0.08 or height > 0.8 * min(peak[i], peak[j])):
                parent[j] = i
                peak[i] = max(peak[i], peak[j])
        return np.array([find(x) for x in range(self.count)])


def fastest(call: Callable[[], IntArray]) -> tuple[IntArray, float]:
    """What it returns, and the ms of the fastest of several calls."""
    best = np.inf
    for _ in range(REPEATS):
        begin = time.perf_counter()
        labels = call()
        best = min(best, (time.perf_counter() - begin) * 1e3)
    return labels, best


def timed(cut: Cut, fields: FloatArray) -> tuple[list[IntArray], list[float]]:
    cut(fields[0])  # fills what is computed once for each mesh
    labels, spent = zip(*[fastest(partial(cut, nodes)) for nodes in fields], strict=True)
    return list(labels), list(spent)


def row(case: Case, method: str, labels: list[IntArray], spent: list[float], slow: float | None) -> dict[str, object]:
    """One row of the table. slow: ms of the reference that it is compared with."""
    scores = [ari(truth, label) for truth, label in zip(case.truth, labels, strict=False)]
    median = float(np.median(spent))
    result = {
        "mesh": case.name,
        "vertices": case.count,
        "method": method,
        "fractures": len(labels),
        "ari": float(np.mean(scores)),
        "ari_min": float(np.min(scores)),
        "median_ms": median,
        "p99_ms": float(np.quantile(spent, 0.99)),
        "reference_ms": slow,
        "ratio": None if slow is None else slow / median,
    }
    print(result, flush=True)
    return result


def measured(case: Case) -> list[dict[str, object]]:
    rows, slow = [], {}
    for method, reference in REFERENCES.items():
        labels, spent = [], []
        for nodes in case.nodes[:TIMED]:
            graph = prepare(case.graph, nodes[: case.count])
            label, best = fastest(partial(reference, graph, METHODS[method].default))
            labels.append(label)
            spent.append(best)
        slow[method] = float(np.median(spent))
        rows.append(row(case, f"{method}, NetworkX", labels, spent, None))
        fast, spent = timed(case.at_vertices(method), case.nodes)
        if any(ari(a, b) < 1.0 for a, b in zip(labels, fast, strict=False)):
            raise RuntimeError(f"{case.name}: {method} and its reference differ")
        rows.append(row(case, method, fast, spent, slow[method]))
    rows.append(row(case, LOW, *timed(case.at_vertices("watershed", 0.05), case.nodes), slow["watershed"]))
    for method, cut in case.ours().items():
        rows.append(row(case, method, *timed(cut, case.nodes), slow["watershed"]))
    for method, cut in case.tried().items():
        rows.append(row(case, method, *timed(cut, case.nodes[: 5 * TIMED]), None))
    return rows


def worse(case: Case) -> dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]]:
    """Functions that add errors to a field (V + E,)."""
    points, faces, _, _ = split_in_four(case.body.surface)
    # The surface is closed: every edge comes in both directions.
    a, b = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    near = sp.coo_array((np.ones(len(a)), (a, b)), shape=(len(points), len(points))) + sp.eye_array(len(points))
    mean = sp.csr_array(sp.diags_array(1.0 / near.sum(axis=1)) @ near)

    def blurred(values: FloatArray, times: int) -> FloatArray:
        for _ in range(times):
            values = mean @ values
        return values

    def noisy(nodes: FloatArray, rng: np.random.Generator, size: float, times: int) -> FloatArray:
        noise = blurred(rng.standard_normal(len(nodes)), times)
        # A network learns zeros better than heights: a quarter of the noise at the crack, all of it 0.04 away.
        return np.clip(nodes + size * noise / noise.std() * np.minimum(1.0, 0.25 + nodes / 0.05), 0.0, CAP)

    def filled(nodes: FloatArray, rng: np.random.Generator, times: int) -> FloatArray:
        for centre in rng.choice(np.flatnonzero(nodes < 0.01), times):
            away = np.linalg.norm(points - points[centre], axis=1)
            nodes = np.maximum(nodes, 0.03 * (1.0 - (away / 0.06) ** 2))
        return nodes

    return {
        "exact": lambda nodes, rng: nodes,
        "fine noise, 0.01": lambda nodes, rng: noisy(nodes, rng, 0.01, 2),
        "smooth noise, 0.02": lambda nodes, rng: noisy(nodes, rng, 0.02, 20),
        "blurred": lambda nodes, rng: blurred(nodes, 10),
        "cracks filled at 4 places": lambda nodes, rng: filled(nodes, rng, 4),
        "all of these": lambda nodes, rng: noisy(blurred(filled(nodes, rng, 2), 2), rng, 0.012, 8),
    }


def spoiled(case: Case) -> list[dict[str, object]]:
    cuts = {
        "watershed": case.at_vertices("watershed"),
        LOW: case.at_vertices("watershed", 0.05),
        **case.tried(),
        LINKED: case.ours()[LINKED],
        SLACKER: lambda nodes: midpoint_segmentation(case.linked, nodes, SLACK),
        ATOMS[-1]: case.ours()[ATOMS[-1]],
    }
    rows = []
    for name, add_errors in worse(case).items():
        rng = np.random.default_rng(SEED)
        fields = [add_errors(nodes, rng) for nodes in case.nodes[:WORSE]]
        error = [amae(a[: case.count], b[: case.count]) for a, b in zip(case.nodes, fields, strict=False)]
        scores = {
            method: float(np.mean([ari(truth, cut(x)) for truth, x in zip(case.truth, fields, strict=False)]))
            for method, cut in cuts.items()
        }
        rows.append({"mesh": case.name, "field": name, "amae": float(np.mean(error)), "ari": scores})
        print(rows[-1], flush=True)
    return rows


def link_row(case: Case) -> dict[str, object]:
    ends = case.truth[:, case.linked.links]
    wrong = float((ends[:, :, 0] != ends[:, :, 1]).mean())
    return {"mesh": case.name, "links": len(case.linked.links), "across_pieces": wrong}


def write(result: dict) -> None:
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "segmentation.json").write_text(json.dumps(result, indent=2) + "\n")
    lines = [
        "Labels of the vertices from the true field: ARI, and time on one core. `python benchmarks/segmentation.py`",
        f"{FRACTURES} impulses that break each mesh; fewer for the references and for earlier rules. The thesis's",
        "methods have the thesis's parameters. Speed-up: the median of the NetworkX reference divided by the median of",
        "the row; our methods and the watershed at 0.05 are compared with the NetworkX watershed. Every fast method",
        "gave the partitions of its reference. A time is the fastest of",
        f"{REPEATS} runs of one fracture; the columns are the median and the 99th percentile over the fractures.",
        "",
        "| mesh | vertices | method | fractures | mean ARI | lowest ARI | median, ms | p99, ms | speed-up |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['mesh']} | {r['vertices']:,} | {r['method']} | {r['fractures']} | {r['ari']:.4f} | {r['ari_min']:.3f} | "
        f"{r['median_ms']:.3g} | {r['p99_ms']:.3g} | {'' if r['ratio'] is None else format(r['ratio'], '.3g')} |"
        for r in result["rows"]
    ]
    names = list(result["spoiled"][0]["ari"])
    lines += [
        "",
        f"Fields with errors ({WORSE} fractures each): mean ARI. The number after noise is its standard deviation, in",
        "units of the largest extent; blurred means averaged 10 times over neighbours; a filled place hides a crack",
        "over a length of 0.12, where the field is raised to 0.03.",
        "",
        f"| mesh | field | AMAE | {' | '.join(names)} |",
        "|---" * (3 + len(names)) + "|",
    ]
    for r in result["spoiled"]:
        scores = " | ".join(f"{r['ari'][name]:.3f}" for name in names)
        lines.append(f"| {r['mesh']} | {r['field']} | {r['amae']:.4f} | {scores} |")
    shares = "; ".join(f"{r['mesh']} {r['across_pieces']:.1%} of {r['links']}" for r in result["links"])
    lines += ["", f"Links between vertices of different pieces, on average over the fractures: {shares}."]
    (RESULTS / "segmentation.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def draw(result: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, middle, right) = pyplot.subplots(1, 3, figsize=(16, 5), width_ratios=(1.1, 1, 1.1))
    bunny = [r for r in result["rows"] if r["mesh"].startswith("bunny")]
    shown = [*METHODS, LINKED, ATOMS[0]]
    colour = {method: f"C{k}" for k, method in enumerate(shown)}
    for method in shown:
        rows = [r for r in bunny if r["method"] == method]
        middle.loglog([r["vertices"] for r in rows], [r["median_ms"] for r in rows], "o-", color=colour[method])
        slow = [r for r in bunny if r["method"] == f"{method}, NetworkX"]
        middle.loglog([r["vertices"] for r in slow], [r["median_ms"] for r in slow], "x--", color=colour[method])
        first = [(r["median_ms"], r["ari"]) for r in result["rows"] if r["method"] == method]
        left.semilogx(*zip(*first, strict=True), "o", color=colour[method], label=method, alpha=0.8)
        second = [(r["median_ms"], r["ari"]) for r in result["rows"] if r["method"] == f"{method}, NetworkX"]
        if second:
            left.semilogx(*zip(*second, strict=True), "x", color=colour[method], alpha=0.6)
    left.plot([], [], "kx", label="NetworkX reference")
    left.set(xlabel="median time, ms", ylabel="mean ARI, from the true field", title="All meshes")
    left.axvline(17.0, color="k", ls=":", lw=1)
    left.legend(fontsize=8, loc="center right", framealpha=0.6)
    middle.axhline(17.0, color="k", ls=":", lw=1)
    middle.text(30000, 14.0, "17 ms, the thesis's budget", fontsize=8, ha="right", va="top")
    sizes = sorted({r["vertices"] for r in bunny})
    middle.set_xticks(sizes, [f"{size:,}" for size in sizes])
    middle.minorticks_off()
    middle.set(xlabel="vertices", ylabel="median time, ms", title="Bunny: fast methods solid, NetworkX dashed")
    spoiled = [r for r in result["spoiled"] if r["mesh"] == "bunny"]
    names = list(spoiled[0]["ari"])
    for k, name in enumerate(names):
        x = np.arange(len(spoiled)) + 0.8 * (k / len(names) - 0.5)
        right.bar(x, [r["ari"][name] for r in spoiled], 0.75 / len(names), align="edge", color=f"C{k}", label=name)
    right.set_xticks(range(len(spoiled)), [r["field"] for r in spoiled], rotation=20, ha="right", fontsize=8)
    right.set(ylabel="mean ARI", title="Bunny: fields with errors", ylim=(0, 1.35))
    right.legend(fontsize=7, ncols=2, loc="upper right")
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(RESULTS / "segmentation.png", dpi=110)


def main() -> None:
    if "--table" in sys.argv[1:]:
        result = json.loads((RESULTS / "segmentation.json").read_text())
        write(result)
        draw(result)
        return
    rows, spoils, links = [], [], []
    with threadpool_limits(1):
        for name, splits in (("bunny", 0), ("chair", 0), ("vase", 0), ("bunny", 1), ("bunny", 2)):
            surface = refine(read_surface(HERE.parent / "meshes" / f"{name}.obj"))
            for _ in range(splits):
                surface = split_faces(surface)
            label = f"{name}, {3**splits}×" if splits else name
            case = Case(label, replace(surface, name=label))
            rows += measured(case)
            links.append(link_row(case))
            if not splits:
                spoils += spoiled(case)
    result = {
        "command": "python benchmarks/segmentation.py",
        "seed": SEED,
        "rows": rows,
        "spoiled": spoils,
        "links": links,
    }
    write(result)
    draw(result)


if __name__ == "__main__":
    main()
