"""Are impacts spread evenly over the surface? ``python benchmarks/sampling.py`` (about a minute).

Impacts of single impacts per patch of surface, over what the patch's area calls for: ours, beside the usual way of
keeping only impacts of one strength that break the body (the thesis's section 6.5 found its own data crowded on
weak spots for that reason). Writes benchmarks/results/sampling.{json,md,png}.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.stats import chi2, kstest
from sklearn.cluster import KMeans

from fracsim.data.impacts import KINDS, draw_impacts
from fracsim.data.samples import sample
from fracsim.geometry.sampling import SEVERITY
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.surface import read_surface, refine

HERE = Path(__file__).parent
RESULTS = HERE / "results"
MESHES = ("bunny", "chair", "vase")
COUNT, PATCHES = 40000, 100


def density(faces: np.ndarray, patch: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, float]:
    """Impacts per patch over what its area calls for, and the p-value of their being uniform."""
    expected = np.bincount(patch, area) / area.sum() * len(faces)
    found = np.bincount(patch[faces], minlength=PATCHES)
    statistic = ((found - expected) ** 2 / expected).sum()
    return found / expected, float(chi2.sf(statistic, PATCHES - 1))


def main() -> None:
    rows, curves = [], {}
    for name in MESHES:
        surface = refine(read_surface(HERE.parent / "meshes" / f"{name}.obj"))
        simulator = make_simulator(surface, SimulatorOptions(), 0)
        centres, area = surface.trimesh.triangles_center, surface.trimesh.area_faces
        patch = KMeans(PATCHES, n_init=1, random_state=0).fit_predict(centres, sample_weight=area)
        drawn = sample(simulator, COUNT, 0)
        single = drawn.kind == 0
        ours, p_ours = density(drawn.faces[single, 0], patch, area)
        # The usual way: one strength, that which breaks half of the impacts, and what does not break is rejected.
        impacts, kind = draw_impacts(surface, COUNT, np.random.default_rng(1))
        threshold = simulator.thresholds(impacts)
        kept = (kind == 0) & (threshold <= np.median(threshold[kind == 0]))
        rejected, p_rejected = density(impacts.faces[kept, 0], patch, area)
        curves[name] = (ours, rejected, drawn.ratio)
        rows.append(
            {
                "mesh": name,
                "impacts": int(single.sum()),
                "density": {"p5": float(np.percentile(ours, 5)), "p95": float(np.percentile(ours, 95))},
                "uniform_p": p_ours,
                "kept": int(kept.sum()),
                "density_of_rejection": {
                    "p5": float(np.percentile(rejected, 5)),
                    "p95": float(np.percentile(rejected, 95)),
                },
                "uniform_p_of_rejection": p_rejected,
                "severity_p": float(
                    kstest(
                        np.log(drawn.ratio), "uniform", (np.log(SEVERITY[0]), np.log(SEVERITY[1] / SEVERITY[0]))
                    ).pvalue
                ),
                "breaking": float(drawn.labels.any(axis=1).mean()),
                "kinds": {kind: float((drawn.kind == k).mean()) for k, kind in enumerate(KINDS)},
            }
        )
        print(rows[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    result = {"command": "python benchmarks/sampling.py", "samples": COUNT, "patches": PATCHES, "rows": rows}
    (RESULTS / "sampling.json").write_text(json.dumps(result, indent=2) + "\n")
    lines = [
        f"{COUNT} samples a mesh, {PATCHES} patches of surface: impacts in a patch over what its area calls for, 5th",
        "and 95th percentile over patches (with so many impacts, chance alone gives 0.91 to 1.09), and the chi-square",
        "p-value of their being uniform. Rejection: impacts of one strength, those that do not break the body thrown",
        "away.",
        "`python benchmarks/sampling.py`",
        "",
        "| mesh | ours | p | rejection | p | severity log-uniform, p | breaking | several contacts |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ours, other = row["density"], row["density_of_rejection"]
        unlikely = max(row["uniform_p_of_rejection"], 1e-99)
        lines.append(
            f"| {row['mesh']} | {ours['p5']:.2f} - {ours['p95']:.2f} | {row['uniform_p']:.2f} | "
            f"{other['p5']:.2f} - {other['p95']:.2f} | {unlikely:.0e} | {row['severity_p']:.2f} | "
            f"{row['breaking']:.1%} | {1 - row['kinds']['single']:.1%} |"
        )
    (RESULTS / "sampling.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(14, 3.2))
    for axis, (name, (ours, rejected, _)) in zip(axes, curves.items(), strict=False):
        bins = np.linspace(0, 3, 46)
        axis.hist(np.clip(rejected, 0, 3), bins, alpha=0.6, label="rejection of what does not break")
        axis.hist(ours, bins, alpha=0.8, label="ours")
        axis.axvline(1, color="k", lw=0.8)
        axis.set(title=name, xlabel="impacts / what the area calls for", ylabel="patches of surface")
    axes[0].legend(fontsize=7, loc="center right")
    for name, (_, _, ratio) in curves.items():
        axes[3].hist(np.log10(ratio), 30, histtype="step", label=name)
    axes[3].set(title="severity", xlabel="log10 of severity / threshold", ylabel="samples", ylim=(0, None))
    axes[3].legend(fontsize=7, loc="lower center")
    figure.tight_layout()
    figure.savefig(RESULTS / "sampling.png", dpi=110)


if __name__ == "__main__":
    main()
