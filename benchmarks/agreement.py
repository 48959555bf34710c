"""Does the structural simulator repeat itself and agree with single cracks? ``python benchmarks/agreement.py``.

For a mug, a plate, a vase and a bunny of ceramic, with the same options: how far two answers agree when an impact moves
by 1 % and 3 % of the size, and when the body is divided into other cells (``fracsim.data.repeatability``); how many
pieces of more than 1 % there are at 1, 2 and 4 times the force that breaks the body; and how the share of the largest
piece goes with that of the sequential simulator under the same impacts, of which four copies moved by 1 % are averaged,
since it is chaotic. The modal simulator, and the answer to the nearest of the other impacts, stand beside it. Writes
benchmarks/results/agreement.{json,md,png}; about 20 minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from things import thing

from fracsim.common.arrays import FloatArray, IntArray
from fracsim.common.material import PRESETS
from fracsim.data.repeatability import moved, repeatability
from fracsim.geometry.sampling import SEVERITY
from fracsim.metrics import volume_ari
from fracsim.simulators.base import FractureSimulator, Impacts
from fracsim.simulators.capabilities import reference_factors
from fracsim.simulators.elastic import single_impacts
from fracsim.simulators.registry import make_simulator, options_for_body
from fracsim.solids.surface import Surface, read_surface, refine

RESULTS = Path(__file__).parent / "results"
SIZES = {"mug": 0.1, "plate": 0.27, "vase": 0.3, "bunny": 0.3}  # m
MATERIAL = "ceramic"
IMPACTS = 100
COPIES = 4  # of the sequential simulator's answers, each of the impact moved
SHIFT = 0.01  # of the size, that they are moved by
MULTIPLES = (1.0, 2.0, 4.0)  # of the force that breaks the body
HARD = 2.0  # times that force: where the two simulators are compared
SMALLEST = 0.01  # of the body: what counts as a piece
SEED = 123
TARGETS = {
    "volume_ari_moved_1_percent": 0.9,
    "volume_ari_moved_3_percent": 0.75,
    "largest_share_correlation": 0.8,
    "sequential_correlation": 0.5,
}


def read(mesh: str, size: float) -> Surface:
    """Read a mesh at its real size."""
    return refine(read_surface(thing(mesh, size)))


def build(name: str, surface: Surface, seed: int = 0) -> FractureSimulator:
    """Build a simulator of ceramic."""
    return make_simulator(surface, options_for_body(name, PRESETS[MATERIAL], surface.scale), seed)


def select(impacts: Impacts, rows: IntArray) -> Impacts:
    """Keep some of the impacts."""
    return Impacts(impacts.faces[rows], impacts.barycentric[rows], impacts.directions[rows], impacts.severities[rows])


def shares(simulator: FractureSimulator, impacts: Impacts) -> list[FloatArray]:
    """Break the body: the shares of the pieces, the largest first."""
    volumes = simulator.cells.volumes / simulator.cells.volumes.sum()
    return [np.sort(np.bincount(labels, volumes))[::-1] for labels in simulator.fracture(impacts).labels]


def of_sequential(sequential: FractureSimulator, impacts: Impacts) -> tuple[FloatArray, float]:
    """Let the sequential simulator answer: the largest shares (N,), and seconds of processor time."""
    begin = time.process_time()
    return np.array([share[0] for share in shares(sequential, impacts)]), time.process_time() - begin


def nearest_ari(simulator: FractureSimulator, impacts: Impacts) -> float:
    """Answer each impact with what the nearest of the others did: mean ARI by volume."""
    labels, volumes = simulator.fracture(impacts).labels, simulator.cells.volumes
    corner = simulator.surface.vertices[simulator.surface.faces[impacts.faces[:, 0]]]
    points = np.einsum("nc,nci->ni", impacts.barycentric[:, 0], corner)
    keys = np.concatenate([points, 0.1 * impacts.directions[:, 0]], axis=1)
    distance = np.linalg.norm(keys[:, None] - keys[None], axis=2) + 1e9 * np.eye(len(keys))
    pairs = enumerate(np.argmin(distance, axis=1).tolist())
    return float(np.mean([volume_ari(labels[k], labels[other], volumes) for k, other in pairs]))


def as_drawn(simulator: FractureSimulator, impacts: Impacts) -> dict[str, float]:
    """Draw severities as datasets do, 0.3 to 5 times those of the first crack, so that about half do nothing."""
    low, high = np.log(SEVERITY)
    rng = np.random.default_rng(SEED)
    drawn = impacts.times(reference_factors(simulator, impacts) * np.exp(rng.uniform(low, high, len(impacts))))
    labels, volumes = simulator.fracture(drawn).labels, simulator.cells.volumes
    result = {"broke": float(labels.any(axis=1).mean())}
    for k, shift in enumerate((0.01, 0.03)):
        again = simulator.fracture(moved(simulator.surface, drawn, shift, np.random.default_rng(SEED + k))).labels
        agreement = [volume_ari(*pair, volumes) for pair in zip(labels, again, strict=True)]
        result[f"volume_ari_moved_{100 * shift:.0f}_percent"] = float(np.mean(agreement))
    return result


def measure(mesh: str, count: int) -> dict[str, Any]:
    """Measure one body."""
    surface = read(mesh, SIZES[mesh])
    structural, other = build("structural", surface), build("structural", surface, 1)
    row: dict[str, Any] = {"mesh": mesh, "size": SIZES[mesh]}
    row["structural"] = repeatability(structural, SEED, other, count, workers=2)
    impacts = single_impacts(surface, count, np.random.default_rng(SEED))
    row["as_drawn"] = as_drawn(structural, impacts)
    # One process for each core; the factor of each impact is found alone.
    threshold = np.concatenate(
        Parallel(2)(
            delayed(structural.thresholds)(select(impacts, rows)) for rows in np.array_split(np.arange(count), 8)
        )
    )
    impacts, threshold = select(impacts, np.flatnonzero(np.isfinite(threshold))), threshold[np.isfinite(threshold)]
    row["impacts"] = len(impacts)
    begin = time.process_time()
    answers = {k: shares(structural, impacts.times(k * threshold)) for k in MULTIPLES}
    row["structural"]["milliseconds"] = 1e3 * (time.process_time() - begin) / (len(MULTIPLES) * len(impacts))
    row["structural"]["pieces"] = [
        float(np.mean([(share >= SMALLEST).sum() for share in answers[k]])) for k in MULTIPLES
    ]
    row["structural"]["nearest_impact"] = nearest_ari(structural, impacts.times(HARD * threshold))
    largest = np.array([share[0] for share in shares(structural, impacts.times(HARD * threshold))])
    sequential = build("sequential", surface)
    copies = [
        moved(surface, impacts.times(HARD * threshold), SHIFT, np.random.default_rng(SEED + k)) for k in range(COPIES)
    ]
    done = Parallel(2)(delayed(of_sequential)(sequential, copy) for copy in copies)
    table = np.array([shares for shares, _ in done])  # (copies, N)
    row["sequential"] = {
        "milliseconds": 1e3 * sum(seconds for _, seconds in done) / table.size,
        "largest": float(table.mean()),
        "copies_correlation": float(np.mean(np.corrcoef(table)[np.triu_indices(COPIES, 1)])),
    }
    row["structural"]["largest"] = float(largest.mean())
    row["structural"]["sequential_correlation"] = float(np.corrcoef(largest, table.mean(axis=0))[0, 1])
    row["shares"] = {"structural": largest.tolist(), "sequential": table.mean(axis=0).tolist()}
    modal = build("modal", surface)
    row["modal"] = repeatability(modal, SEED, None, count, workers=2)
    struck = shares(modal, impacts.times(HARD * modal.thresholds(impacts)))
    row["modal"]["sequential_correlation"] = float(
        np.corrcoef([share[0] for share in struck], table.mean(axis=0))[0, 1]
    )
    return row


def write(rows: list[dict[str, Any]], command: str) -> None:
    """Write the figures, a table and a plot."""
    RESULTS.mkdir(exist_ok=True)
    data = {"command": command, "material": MATERIAL, "targets": TARGETS, "rows": rows}
    (RESULTS / "agreement.json").write_text(json.dumps(data, indent=1) + "\n")
    lines = [
        f"Self-agreement is ARI by volume between the answers to an impact and to the same impact moved by 1 % and by "
        f"3 % of the size, over impacts of 1 to 5 times the force of a first crack that break the body (in brackets: "
        f"over impacts as datasets draw them, half of which do nothing); of the nearest of the other impacts at "
        f"{HARD:g} times the force that breaks it. Tilings: Pearson's correlation of the largest pieces' shares "
        f"between two divisions into cells. Sequential: the same between a simulator and the mean of {COPIES} moved "
        f"copies of the sequential one (in brackets: those among themselves). Pieces: of at least 1 %, at 1, 2 and 4 "
        f"times the force that breaks the body. {MATERIAL}, {IMPACTS} impacts each. `{command}`",
        "",
        "| body | moved 1 % | moved 3 % | nearest impact | tilings | sequential | pieces at 1, 2, 4x | ms an impact "
        "| modal: moved 1 % | moved 3 % | sequential | sequential, ms an impact |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ours, modal, chain = row["structural"], row["modal"], row["sequential"]
        lines.append(
            f"| {row['mesh']}, {row['size']} m "
            f"| {ours['volume_ari_moved_1_percent']:.2f} ({row['as_drawn']['volume_ari_moved_1_percent']:.2f}) "
            f"| {ours['volume_ari_moved_3_percent']:.2f} ({row['as_drawn']['volume_ari_moved_3_percent']:.2f}) "
            f"| {ours['nearest_impact']:.2f} "
            f"| {ours['largest_share_correlation']:.2f} | {ours['sequential_correlation']:.2f} "
            f"({chain['copies_correlation']:.2f}) | {', '.join(f'{n:.1f}' for n in ours['pieces'])} "
            f"| {ours['milliseconds']:.0f} | {modal['volume_ari_moved_1_percent']:.2f} "
            f"| {modal['volume_ari_moved_3_percent']:.2f} | {modal['sequential_correlation']:.2f} "
            f"| {chain['milliseconds']:.0f} |"
        )
    missed = [
        f"{row['mesh']}: {name.replace('_', ' ')} {row['structural'][name]:.2f} (wanted {target:g})"
        for row in rows
        for name, target in TARGETS.items()
        if row["structural"][name] < target
    ]
    missed += [f"{row['mesh']}: pieces do not grow" for row in rows if np.diff(row["structural"]["pieces"]).min() <= 0]
    lines += ["", "Targets missed: " + ("; ".join(missed) if missed else "none") + "."]
    (RESULTS / "agreement.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(rows), figsize=(3 * len(rows), 3), sharex=True, sharey=True, squeeze=False)
    for axis, row in zip(axes[0], rows, strict=True):
        axis.plot(row["shares"]["sequential"], row["shares"]["structural"], ".", alpha=0.6)
        axis.plot([0, 1], [0, 1], color="0.7", linewidth=0.8)
        axis.set(title=f"{row['mesh']}, {row['size']} m", xlabel="sequential, mean of four")
    axes[0, 0].set_ylabel("structural")
    figure.suptitle("Share of the largest piece", fontsize=10)
    figure.tight_layout()
    figure.savefig(RESULTS / "agreement.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one body and ten impacts; nothing is written")
    parser.add_argument("--drawn", action="store_true", help="measure again only over impacts as datasets draw them")
    arguments = parser.parse_args()
    quick = arguments.quick
    if arguments.drawn:
        rows = json.loads((RESULTS / "agreement.json").read_text())["rows"]
        for row in rows:
            surface = read(row["mesh"], row["size"])
            impacts = single_impacts(surface, IMPACTS, np.random.default_rng(SEED))
            row["as_drawn"] = as_drawn(build("structural", surface), impacts)
            print(row["mesh"], row["as_drawn"], flush=True)
        write(rows, "python benchmarks/agreement.py")
        return
    rows = [measure(mesh, 10 if quick else IMPACTS) for mesh in (("plate",) if quick else SIZES)]
    if quick:
        print(json.dumps([{key: row[key] for key in row if key != "shares"} for row in rows], indent=1))
    else:
        write(rows, "python benchmarks/agreement.py")


if __name__ == "__main__":
    main()
