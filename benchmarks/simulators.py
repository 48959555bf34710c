"""What the model learns from other simulators: ``python benchmarks/simulators.py`` (about 15 minutes).

The bunny is baked from elastic stress and from radial cracks, with a response of its own for every interface, as with
any simulator but the modal one. The table says how near the model comes, beside the most similar training impulse and,
where the simulator has no atoms of its own, beside the best that atoms could express. Figures are the bake's own, on
its test split. Writes benchmarks/results/simulators.{json,md,png}.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import fracsim
from fracsim.baking import BakeOptions
from fracsim.learning.field import FieldOptions

HERE = Path(__file__).parent
RESULTS = HERE / "results"
SIMULATORS = ("elastic", "radial")
SAMPLES = {"elastic": 60000, "radial": 30000}
STEPS = 4000


def main() -> None:
    rows = []
    for name in SIMULATORS:
        model = FieldOptions(response=True)
        model = replace(model, training=replace(model.training, steps=STEPS))
        options = BakeOptions(simulator=name, samples=SAMPLES[name], workers=1, evaluated=600, model=model)
        metadata = fracsim.bake(HERE.parent / "meshes" / "bunny.obj", options=options).metadata
        rows.append({"simulator": name, **metadata["counts"], **metadata["test"]})
        print(rows[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    data = {"command": "python benchmarks/simulators.py", "samples": SAMPLES, "rows": rows}
    (RESULTS / "simulators.json").write_text(json.dumps(data, indent=2) + "\n")
    lines = [
        f"The bunny baked from other simulators, {STEPS} steps of training. `python benchmarks/simulators.py`",
        "",
        "| simulator | samples | atoms | interfaces | ARI | nearest impulse | atoms at best "
        "| breaks or not | nearest impulse |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['simulator']} | {SAMPLES[row['simulator']]} | {row['atoms']} | {row['interfaces']} | {row['ari']:.2f} "
        f"| {row['ari_nearest_impulse']:.2f} | {row.get('ari_of_the_atoms', 1.0):.2f} | {row['balanced_accuracy']:.1%} "
        f"| {row['balanced_accuracy_nearest_impulse']:.1%} |"
        for row in rows
    ]
    (RESULTS / "simulators.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3))
    for k, (key, label) in enumerate((("ari", "model"), ("ari_nearest_impulse", "nearest training impulse"))):
        axes.bar([i + 0.4 * k for i in range(len(rows))], [row[key] for row in rows], 0.36, label=label)
    axes.set_xticks([i + 0.2 for i in range(len(rows))], [row["simulator"] for row in rows])
    axes.set(ylabel="ARI, test split", ylim=(0, 1))
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(RESULTS / "simulators.png", dpi=110)


if __name__ == "__main__":
    main()
