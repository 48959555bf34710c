"""How wrong is diffusion? The simulator's spread of an impact beside a linear-elastic one, on the same interfaces.

python benchmarks/elastic.py                # writes benchmarks/results/elastic.{json,md,png}; needs the extra "check"

Each shape is built as it is baked; 300 single impacts fall on it, uniform over the area and in the cone of directions.
For each, the load ratios of its interfaces by momentum diffusion are ranked against those by elastic tractions under
inertia relief (fracsim/elastic.py). A strength and a jump of velocity have no common unit, so only ranks, and
fractures at 1.5 times each rule's own threshold, are compared. A finer mesh shows the reference's own error, and
the fracture of another impact what a comparison of unrelated fractures would give.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from scipy.stats import rankdata, spearmanr

from fracsim.fracture.rule import components, effective_opening, weakest_cut
from fracsim.geometry.sampling import SurfacePoints
from fracsim.metrics import ari
from fracsim.simulators.base import Impacts, merge_small_pieces_each
from fracsim.simulators.elastic import ElasticSimulator, single_impacts
from fracsim.simulators.elastic_fem import ElasticBody, mesh_edge, tetrahedralise
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.solid import sum_by_index
from fracsim.solids.surface import read_surface, refine

RESULTS = Path(__file__).parent / "results"
MESHES = Path(__file__).parent.parent / "meshes"
SHAPES = ("bunny", "chair", "vase")
IMPACTS = 300
FAR = 0.3  # of the largest extent, from the contact to the interface
RATIO = 1.5  # of an impact's severity to its threshold where fractures are compared
FINER = 0.7  # edge length of the finer mesh over that of the mesh used
FEWEST = 8  # interfaces a rank correlation is taken over at least
KINDS = ("all", "near", "far", "tension", "compression")


def centres(modal: ModalSimulator) -> np.ndarray:
    """(I, 3) the area-weighted centres of the interfaces."""
    parts, pairs = modal.cells, modal.interfaces.pairs
    inner = parts.source < 0
    corner = parts.points[parts.triangles[inner]]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    found, index = np.unique(np.sort(parts.sides[inner], axis=1), axis=0, return_inverse=True)
    assert np.array_equal(found, pairs)
    index = index.reshape(-1)
    return (
        sum_by_index(index, area[:, None] * corner.mean(axis=1), len(pairs))
        / sum_by_index(index, area, len(pairs))[:, None]
    )


def rank_correlations(left: np.ndarray, right: np.ndarray, chosen: np.ndarray) -> dict:
    """Spearman's correlation over the chosen interfaces (N, I) of each impact: its median and 10 and 90 %."""
    found = [
        float(spearmanr(a[c], b[c]).statistic) for a, b, c in zip(left, right, chosen, strict=True) if c.sum() >= FEWEST
    ]
    low, middle, high = np.percentile(found, (10, 50, 90))
    return {"median": middle, "p10": low, "p90": high, "impacts": len(found)}


def fractures(modal: ModalSimulator, drive: np.ndarray) -> np.ndarray:
    """(N, V) the piece of each vertex at RATIO times each impact's threshold."""
    pairs, count = modal.interfaces.pairs, len(modal.cells.volumes)
    whole = drive * (RATIO / weakest_cut(drive, pairs, count))[:, None] < 1.0
    labels = merge_small_pieces_each(
        components(whole, pairs, count), modal.cells.volumes, modal.interfaces, modal.min_piece_volume_fraction
    )
    return labels[:, modal.cells.vertex_cells(len(modal.surface.vertices))]


def agreement(modal: ModalSimulator, left: np.ndarray, right: np.ndarray) -> dict:
    """What becomes of the body under load ratios ``left`` and ``right`` (N, I) of the same impacts."""
    pairs, count = modal.interfaces.pairs, len(modal.cells.volumes)
    here, there = fractures(modal, left), fractures(modal, right)
    same = np.array([ari(a, b) for a, b in zip(here, there, strict=True)])
    other = np.array([ari(a, b) for a, b in zip(here, np.roll(there, 1, axis=0), strict=True)])
    cuts = [weakest_cut(drive, pairs, count) for drive in (left, right)]
    return {
        "thresholds": float(spearmanr(*cuts).statistic),
        "ari": float(same.mean()),
        "ari_of_another_impact": float(other.mean()),
        "pieces": [float((labels.max(axis=1) + 1).mean()) for labels in (here, there)],
    }


def hardest(drive: np.ndarray) -> np.ndarray:
    """(N, I) the tenth of the interfaces that each impact loads hardest."""
    return drive >= np.quantile(drive, 0.9, axis=1, keepdims=True)


def openings(modal: ModalSimulator, impacts: Impacts) -> np.ndarray:
    """(N, I) the normal component of the diffused jump, positive where it opens the interface."""
    points = SurfacePoints(modal.surface.vertices, modal.surface.faces)
    field = points.rows(modal.impact_field, impacts.faces, impacts.barycentric)[:, 0]
    first, second = modal.interfaces.pairs.T
    return (field[:, second] - field[:, first]) * (impacts.directions[:, 0] @ modal.interfaces.normals.T)


def compare(name: str) -> tuple[dict, dict]:
    """The figures of one shape, and the arrays that are plotted."""
    start = time.perf_counter()
    surface = refine(read_surface(MESHES / f"{name}.obj"))
    rng = np.random.default_rng(np.random.SeedSequence(0).spawn(1)[0])
    modal = ModalSimulator.build(surface, SimulatorOptions(), rng)
    seconds = {"modal": time.perf_counter() - start}

    start = time.perf_counter()
    edge = mesh_edge(surface)
    mesh = tetrahedralise(surface, edge)
    seconds["mesh"] = time.perf_counter() - start
    start = time.perf_counter()
    elastic = ElasticSimulator.from_modal(modal, mesh)
    seconds["elastic"] = time.perf_counter() - start

    impacts = single_impacts(surface, IMPACTS, np.random.default_rng(1))
    start = time.perf_counter()
    diffused = modal.load_ratios(impacts)
    seconds["modal_query"] = (time.perf_counter() - start) / IMPACTS
    start = time.perf_counter()
    tractions = elastic.tractions(impacts)
    stressed = effective_opening(tractions, modal.interfaces.normals)
    seconds["elastic_query"] = (time.perf_counter() - start) / IMPACTS

    contacts = SurfacePoints(surface.vertices, surface.faces).at(impacts.faces[:, 0], impacts.barycentric[:, 0])
    directions = impacts.directions[:, 0]
    distance = np.linalg.norm(contacts[:, None] - centres(modal)[None], axis=2)
    pull = np.einsum("nik,ik->ni", tractions, modal.interfaces.normals)
    everywhere = np.ones(diffused.shape, dtype=bool)
    chosen = {"all": everywhere, "near": distance < FAR, "far": distance >= FAR}
    chosen |= {"tension": pull > 0, "compression": pull < 0}
    opened = openings(modal, impacts)

    # Forwards from the contacts themselves: the mean traction on a finer mesh, and bending on either.
    body = ElasticBody(surface, modal.cells, modal.interfaces, mesh)
    bent = body.root_mean_square_loads(body.displacements(contacts, directions))
    finer = ElasticBody(surface, modal.cells, modal.interfaces, edge=FINER * edge)
    moved = finer.displacements(contacts, directions)
    refined = effective_opening(finer.tractions_of(moved), modal.interfaces.normals)
    refined_bent = finer.root_mean_square_loads(moved)

    figures = {
        "vertices": len(surface.vertices),
        "parts": len(modal.cells.volumes),
        "interfaces": len(modal.interfaces),
        "tetrahedra": mesh.t.shape[1],
        "finer_tetrahedra": finer.mesh.t.shape[1],
        "edge": edge,
        "gauge": elastic.gauge,
        "load_ratios": {kind: rank_correlations(diffused, stressed, mask) for kind, mask in chosen.items()},
        "load_ratios_bending": rank_correlations(diffused, bent, everywhere),
        "mean_against_bending": rank_correlations(stressed, bent, everywhere),
        "load_ratios_finer_mesh": rank_correlations(stressed, refined, everywhere),
        "bending_finer_mesh": rank_correlations(bent, refined_bent, everywhere),
        "fracture": agreement(modal, diffused, stressed),
        "fracture_bending": agreement(modal, diffused, bent),
        "fracture_mean_against_bending": agreement(modal, stressed, bent),
        "fracture_finer_mesh": agreement(modal, stressed, refined),
        # Where elasticity pulls hard, does diffusion open? And how much of what is driven hardest is far away?
        "opened_where_pulled_hard": {
            kind: float((opened > 0)[hardest(stressed) & (pull > 0) & chosen[kind]].mean()) for kind in ("near", "far")
        },
        "opened": {kind: float((opened > 0)[chosen[kind]].mean()) for kind in ("near", "far")},
        "far_among_hardest_driven": {
            rule: float(chosen["far"][hardest(drive)].mean())
            for rule, drive in (("elastic", stressed), ("diffusion", diffused))
        },
        "seconds": seconds,
    }
    plotted = {
        "diffused": diffused,
        "stressed": stressed,
        "pull": pull,
        "distance": distance,
        "cuts": [weakest_cut(d, modal.interfaces.pairs, len(modal.cells.volumes)) for d in (diffused, stressed)],
    }
    return figures, plotted


def spread(found: dict) -> str:
    return f"{found['median']:.2f} ({found['p10']:.2f} to {found['p90']:.2f})"


def show(values: dict, form: str = ".2f", scale: float = 1) -> str:
    return " / ".join(f"{scale * value:{form}}" for value in values.values())


def rows(s: dict) -> list[tuple[str, str]]:
    """What the table says of one shape."""
    load_ratios, seconds = s["load_ratios"], {stage: s["seconds"][stage] for stage in ("modal", "mesh", "elastic")}
    queries = {stage: s["seconds"][stage] for stage in ("modal_query", "elastic_query")}
    fracture, bending, finer = (s[f"fracture{what}"] for what in ("", "_mean_against_bending", "_finer_mesh"))
    return [
        ("atoms / interfaces / tetrahedra", show({k: s[k] for k in ("parts", "interfaces", "tetrahedra")}, "d")),
        ("**ρ of load ratios**, diffusion and elastic", spread(load_ratios["all"])),
        (f"… interfaces nearer than {FAR}", spread(load_ratios["near"])),
        (f"… farther than {FAR}", spread(load_ratios["far"])),
        ("… in tension", spread(load_ratios["tension"])),
        ("… in compression", spread(load_ratios["compression"])),
        ("diffusion and elastic with bending kept", spread(s["load_ratios_bending"])),
        ("elastic and elastic with bending kept", spread(s["mean_against_bending"])),
        ("elastic and elastic on a finer mesh", spread(s["load_ratios_finer_mesh"])),
        ("**ρ of thresholds**, diffusion and elastic", f"{fracture['thresholds']:.2f}"),
        ("elastic and elastic with bending kept", f"{bending['thresholds']:.2f}"),
        ("elastic and elastic on a finer mesh", f"{finer['thresholds']:.2f}"),
        ("**ARI of fractures**, diffusion and elastic", f"{fracture['ari']:.2f}"),
        ("diffusion and elastic, unrelated impacts", f"{fracture['ari_of_another_impact']:.2f}"),
        ("elastic and elastic with bending kept", f"{bending['ari']:.2f}"),
        ("elastic and elastic on a finer mesh", f"{finer['ari']:.2f}"),
        ("pieces, diffusion / elastic", show(dict(enumerate(fracture["pieces"])), ".1f")),
        ("pulled hard and opened by diffusion too, near / far, %", show(s["opened_where_pulled_hard"], ".0f", 100)),
        ("opened by diffusion, of all interfaces, near / far, %", show(s["opened"], ".0f", 100)),
        ("far among the most loaded, elastic / diffusion, %", show(s["far_among_hardest_driven"], ".0f", 100)),
        ("to build: modal / mesh / elastic, s", show(seconds, ".0f")),
        ("an impact: modal / elastic, µs", show(queries, ".0f", 1e6)),
    ]


def between(values: list[float], form: str = ".2f", scale: float = 1.0) -> str:
    low, high = (f"{scale * value:{form}}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def sentences(shapes: dict) -> list[str]:
    every = list(shapes.values())
    added = [s["seconds"]["mesh"] + s["seconds"]["elastic"] for s in every]
    far = [s["far_among_hardest_driven"] for s in every]
    pulled = [s["opened_where_pulled_hard"] for s in every]
    ratios, fractures = [s["load_ratios"] for s in every], [s["fracture"] for s in every]
    slower = [s["seconds"]["elastic_query"] / s["seconds"]["modal_query"] for s in every]
    return [
        "Diffusion is a rough guide to elastic stress: the median rank correlation of the load ratios is "
        f"{between([d['all']['median'] for d in ratios])}, where the reference agrees with itself on a finer mesh to "
        f"{between([s['load_ratios_finer_mesh']['median'] for s in every])}. Part of that is distance alone: within "
        f"the interfaces near the contact it is {between([d['near']['median'] for d in ratios])}, within the far ones "
        f"{between([d['far']['median'] for d in ratios])}.",
        "Far-side tension it hardly sees: of the interfaces farther than "
        f"{FAR} that elasticity pulls apart and loads hardest, diffusion opens "
        f"{between([p['far'] for p in pulled], '.0f', 100)} %, of all far interfaces "
        f"{between([s['opened']['far'] for s in every], '.0f', 100)} %; near the contact it is "
        f"{between([p['near'] for p in pulled], '.0f', 100)} %. Elasticity has "
        f"{between([f['elastic'] for f in far], '.0f', 100)} % of its most loaded tenth beyond {FAR}, diffusion "
        f"{between([f['diffusion'] for f in far], '.0f', 100)} %.",
        "Which impacts break the body most easily, the two rank alike to "
        + ", ".join(f"{s['fracture']['thresholds']:.2f} ({name})" for name, s in shapes.items())
        + f". The pieces agree to an ARI of {between([f['ari'] for f in fractures])}, unrelated impacts to "
        f"{between([f['ari_of_another_impact'] for f in fractures])}, the reference with itself on a finer mesh to "
        f"{between([s['fracture_finer_mesh']['ari'] for s in every])}.",
        "The mean traction of an interface hides bending where the interface is a whole section, tension on one side "
        "cancelling compression on the other. With bending kept (root mean square over the interface) the elastic "
        f"ranks agree with the mean's to {between([s['mean_against_bending']['median'] for s in every])}, and with "
        f"diffusion's to {between([s['load_ratios_bending']['median'] for s in every])}.",
        f"Elastic load ratios would add {between(added, '.0f')} s to a bake, the mesh included, and make a query "
        f"{between(slower, '.1f')} times as dear. They are not the truth either: quasi-static, without waves, and "
        "all that breaks breaks at once, under the stress of the whole body.",
    ]


def draw(shapes: dict, plotted: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, len(shapes), figsize=(4.2 * len(shapes), 8), layout="constrained")
    for axis, (name, arrays) in zip(axes[0], plotted.items(), strict=True):
        # The impact whose correlation is the median one.
        found = [float(spearmanr(a, b).statistic) for a, b in zip(arrays["diffused"], arrays["stressed"], strict=True)]
        typical = int(np.argsort(found)[len(found) // 2])
        ranks = [
            100 * rankdata(arrays[rule][typical]) / len(arrays[rule][typical]) for rule in ("diffused", "stressed")
        ]
        pulled = arrays["pull"][typical] > 0
        colours = dict(
            c=arrays["distance"][typical], cmap="viridis_r", vmin=0.0, vmax=0.9, edgecolors="k", linewidths=0.3
        )
        for chosen, marker, what in ((pulled, "^", "tension"), (~pulled, "v", "compression")):
            part = colours | {"c": colours["c"][chosen]}
            dots = axis.scatter(ranks[0][chosen], ranks[1][chosen], s=26, marker=marker, label=what, **part)
        axis.plot([0, 100], [0, 100], color="grey", lw=0.8, zorder=0)
        axis.set(
            title=f"{name}, a typical impact: ρ = {found[typical]:.2f}", xlabel="rank by diffusion, %", aspect="equal"
        )
    axes[0, 0].set_ylabel("rank by elasticity, %")
    axes[0, 1].legend(fontsize=8, title="by elasticity", title_fontsize=8, loc="lower right")
    figure.colorbar(dots, ax=axes[0], label="distance from the contact, sizes", shrink=0.8)

    bars = axes[1, 0]
    labels = [*KINDS, "finer\nmesh"]
    width = 0.8 / len(shapes)
    for k, (name, s) in enumerate(shapes.items()):
        values = [s["load_ratios"][kind] for kind in KINDS] + [s["load_ratios_finer_mesh"]]
        middle = np.array([v["median"] for v in values])
        error = np.array([[v["median"] - v["p10"] for v in values], [v["p90"] - v["median"] for v in values]])
        place = np.arange(len(values)) + (k - (len(shapes) - 1) / 2) * width
        bars.bar(place, middle, width, yerr=error, label=name, error_kw={"lw": 0.8})
    bars.set_xticks(range(len(labels)), [label.replace("compression", "compr.") for label in labels], fontsize=8)
    bars.axhline(0, color="k", lw=0.6)
    bars.axvline(len(KINDS) - 0.5, color="grey", lw=0.8, ls=":")
    bars.set(title="load ratios: ρ with elastic ones, p10 to p90", ylabel="Spearman's ρ")
    bars.legend(fontsize=8, loc="upper left")

    scatter = axes[1, 1]
    for (name, arrays), colour in zip(plotted.items(), ("C0", "C1", "C2"), strict=True):
        diffused, stressed = (np.median(cut) / cut for cut in arrays["cuts"])
        scatter.loglog(diffused, stressed, ".", ms=3, color=colour, alpha=0.6)
        label = f"{name}, ρ = {shapes[name]['fracture']['thresholds']:.2f}"
        scatter.plot([], [], "o", color=colour, label=label)
    scatter.set(title="thresholds over their median", xlabel="by diffusion", ylabel="by elasticity")
    scatter.legend(fontsize=8)

    pieces = axes[1, 2]
    kinds = {
        "another\nimpact": lambda s: s["fracture"]["ari_of_another_impact"],
        "diffusion": lambda s: s["fracture"]["ari"],
        "bending\nkept": lambda s: s["fracture_mean_against_bending"]["ari"],
        "finer\nmesh": lambda s: s["fracture_finer_mesh"]["ari"],
    }
    for k, (name, s) in enumerate(shapes.items()):
        place = np.arange(len(kinds)) + (k - (len(shapes) - 1) / 2) * width
        pieces.bar(place, [value(s) for value in kinds.values()], width, label=name)
    pieces.set_xticks(range(len(kinds)), kinds, fontsize=8)
    pieces.set(title=f"fractures at {RATIO} × threshold", ylabel="ARI with elastic ones", ylim=(-0.05, 1.05))
    pieces.axhline(0, color="k", lw=0.6)
    figure.savefig(RESULTS / "elastic.png", dpi=110)


def report(shapes: dict, plotted: dict) -> None:
    RESULTS.mkdir(exist_ok=True)
    result = {
        "command": "python benchmarks/elastic.py",
        "impacts": IMPACTS,
        "ratio": RATIO,
        "far": FAR,
        "shapes": shapes,
    }
    (RESULTS / "elastic.json").write_text(json.dumps(result, indent=2) + "\n")
    columns = [rows(s) for s in shapes.values()]
    lines = [
        f"Momentum diffusion, as in the simulator, beside linear elasticity under inertia relief; {IMPACTS} single",
        "impacts a shape. ρ: Spearman's rank correlation, of load ratios over the interfaces of each impact (median,",
        "10 % to 90 % of the impacts) or of thresholds over the impacts. ARI: of the pieces that the vertices lie on,",
        f"at {RATIO} times each rule's own threshold. `python benchmarks/elastic.py`",
        "",
        "| | " + " | ".join(shapes) + " |",
        "|---" * (len(shapes) + 1) + "|",
    ]
    lines += [f"| {row[0][0]} | " + " | ".join(value for _, value in row) + " |" for row in zip(*columns, strict=True)]
    lines += ["", *(f"- {sentence}" for sentence in sentences(shapes))]
    (RESULTS / "elastic.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    draw(shapes, plotted)


def main() -> None:
    shapes, plotted = {}, {}
    for name in SHAPES:
        shapes[name], plotted[name] = compare(name)
    report(shapes, plotted)


if __name__ == "__main__":
    main()
