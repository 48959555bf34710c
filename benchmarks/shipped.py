"""Tabulate what baking measured of the assets that ship: ``python benchmarks/shipped.py``.

Writes benchmarks/results/shipped.{json,md,png}. The figures were taken on the test split by ``fracsim bake`` when
the assets were made; nothing is computed anew here.
"""

from __future__ import annotations

import json
from pathlib import Path

import fracsim

RESULTS = Path(__file__).parent / "results"
NAMES = ("bunny", "chair", "vase")


def main() -> None:
    assets = {name: fracsim.load(name).metadata for name in NAMES}
    RESULTS.mkdir(exist_ok=True)
    data = {"command": "python benchmarks/shipped.py", "assets": assets}
    (RESULTS / "shipped.json").write_text(json.dumps(data, indent=2) + "\n")
    lines = [
        "| | vertices | atoms | ARI | baseline | ARI ≥ 0.7 | baseline | AMAE | breaks or not | baseline |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, meta in assets.items():
        test, counts = meta["test"], meta["counts"]
        lines.append(
            f"| {name} | {counts['vertices']} | {counts['atoms']} | **{test['ari']:.3f}** | "
            f"{test['ari_nearest_impulse']:.3f} | **{test['accepted']:.1%}** | "
            f"{test['accepted_nearest_impulse']:.1%} | "
            f"{test['amae']:.4f} | **{test['balanced_accuracy']:.1%}** | "
            f"{test['balanced_accuracy_nearest_impulse']:.1%} |"
        )
    (RESULTS / "shipped.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.5))
    for offset, key, label in (
        (-0.2, "ari", "learned field, watershed"),
        (0.2, "ari_nearest_impulse", "nearest training impulse"),
    ):
        axes.bar([k + offset for k in range(len(NAMES))], [assets[n]["test"][key] for n in NAMES], 0.36, label=label)
    axes.set(xticks=range(len(NAMES)), xticklabels=NAMES, ylim=(0, 1), ylabel="ARI, held-out breaking impulses")
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(RESULTS / "shipped.png", dpi=110)


if __name__ == "__main__":
    main()
