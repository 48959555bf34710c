"""What the model's prior, that an impact spreads like heat from a patch, is worth: ``python benchmarks/prior.py``.

The same bunny, samples, seed and steps, trained with the prior, without, and without but with a response of every
interface's own; scores on the validation split. Writes benchmarks/results/prior.{json,md,png}. About 5 minutes.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from fracsim.data.samples import sample
from fracsim.learning.atoms import atoms_for
from fracsim.learning.body import BodyGeometry
from fracsim.learning.field import FieldModel, FieldOptions
from fracsim.metrics import ari
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.surface import read_surface

HERE = Path(__file__).parent
RESULTS = HERE / "results"
STEPS = (500, 1500)
ROWS = {
    "impacts spread like heat (default)": FieldOptions(),
    "no prior": FieldOptions(prior=False, filter_rate=10.0),
    "no prior, a response of each interface": FieldOptions(prior=False, response=True, filter_rate=10.0),
}


def main() -> None:
    surface = read_surface(HERE.parent / "meshes" / "bunny.obj")
    simulator = make_simulator(surface, SimulatorOptions(), 0)
    body = BodyGeometry.of(surface, atoms_for(simulator, [], 1e-3))
    samples = sample(simulator, 60000, 0)
    held_out = samples.of_split(1)
    held_out = held_out.take(held_out.labels.any(axis=1))
    truth = held_out.labels[:, body.vertex_atom]

    results = []
    for name, row in ROWS.items():
        for steps in STEPS:
            options = replace(row, training=replace(row.training, steps=steps))
            model, figures = FieldModel.fit(body, samples, options)
            labels = model.predict_labels(held_out.impacts)[:, body.vertex_atom]
            score = float(np.mean([ari(a, b) for a, b in zip(truth, labels, strict=True)]))
            results.append({"row": name, "steps": steps, "ari": score, **figures})
            print(f"{name}, {steps} steps: ARI {score:.3f}, loss {figures['validation']:.4f}", flush=True)

    RESULTS.mkdir(exist_ok=True)
    data = {"command": "python benchmarks/prior.py", "results": results}
    (RESULTS / "prior.json").write_text(json.dumps(data, indent=2) + "\n")
    lines = ["| | " + " | ".join(f"{steps} steps" for steps in STEPS) + " |", "|---" * (1 + len(STEPS)) + "|"]
    for name in ROWS:
        cells = [f"{r['ari']:.3f}" for r in results if r["row"] == name]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    (RESULTS / "prior.md").write_text("\n".join(lines) + "\n")

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.5))
    for name in ROWS:
        chosen = [r for r in results if r["row"] == name]
        axes.plot([r["seconds"] for r in chosen], [r["ari"] for r in chosen], "o-", label=name)
    axes.set(xscale="log", xlabel="training, s", ylabel="ARI, validation", ylim=(0, 1), title="bunny")
    axes.legend(loc="lower right", fontsize=8)
    figure.tight_layout()
    figure.savefig(RESULTS / "prior.png", dpi=110)


if __name__ == "__main__":
    main()
