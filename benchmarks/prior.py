"""What the model's prior, that a blow spreads like heat, is worth: ``python benchmarks/prior.py``.

The same bunny, samples, seed and steps, trained with the prior and without; scores on the validation split.
Writes benchmarks/results/prior.{json,md,png}.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np

from fracsim.breaking import components
from fracsim.dataset import sample
from fracsim.generator import modal_generator
from fracsim.mesh import read_surface
from fracsim.metrics import ari
from fracsim.solid import surface_parts
from fracsim.spectrum import spectrum
from fracsim.train import TrainingOptions, train_field

HERE = Path(__file__).parent
RESULTS = HERE / "results"
STEPS = (500, 1500, 4500)


def main() -> None:
    surface = read_surface(HERE.parent / "meshes" / "bunny.obj")
    generator = modal_generator(surface, np.random.default_rng(0))
    interfaces = generator.interfaces
    samples = sample(generator, 40000, 1)
    geometry = spectrum(generator.cells, generator.atom, surface, 96)
    owner = surface_parts(generator.parts, len(surface.vertices))
    held_out = samples.part(1)

    results = []
    for prior in (True, False):
        for steps in STEPS:
            options = TrainingOptions(prior=prior, steps=steps)
            if not prior:  # free weights bear a larger rate, and there is no filter to favour
                options = dataclasses.replace(options, rate=3e-3, filter_rate=1.0)
            model, figures = train_field(samples, geometry, surface.faces, interfaces, 0, options)
            scores = []
            for k in range(len(held_out)):
                there = held_out.severities[k] > 0
                scores.append(
                    model.scores(
                        surface.faces[held_out.faces[k, there]],
                        held_out.barycentric[k, there],
                        held_out.directions[k, there],
                        held_out.severities[k, there],
                    )
                )
            label = components(np.array(scores) < 0.5, interfaces.pairs, len(generator.parts.volumes))
            breaking = np.flatnonzero(held_out.labels.any(axis=1))
            score = float(np.mean([ari(held_out.labels[k][owner], label[k][owner]) for k in breaking]))
            results.append({"prior": prior, "steps": steps, "ari": score, **figures})
            print(f"prior {prior!s:5} steps {steps:5}: ARI {score:.3f}, loss {figures['validation_loss']:.4f}")

    RESULTS.mkdir(exist_ok=True)
    data = {"command": "python benchmarks/prior.py", "results": results}
    (RESULTS / "prior.json").write_text(json.dumps(data, indent=2) + "\n")
    lines = ["| steps | with the prior: ARI | loss | without: ARI | loss |", "|---|---|---|---|---|"]
    for steps in STEPS:
        one, other = (next(r for r in results if r["prior"] is p and r["steps"] == steps) for p in (True, False))
        lines.append(
            f"| {steps} | {one['ari']:.3f} | {one['validation_loss']:.4f} | "
            f"{other['ari']:.3f} | {other['validation_loss']:.4f} |"
        )
    (RESULTS / "prior.md").write_text("\n".join(lines) + "\n")

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.5))
    for prior, label in ((True, "blows spread like heat"), (False, "no prior")):
        chosen = [r for r in results if r["prior"] is prior]
        axes.plot([r["seconds"] for r in chosen], [r["ari"] for r in chosen], "o-", label=label)
    axes.set(xscale="log", xlabel="training, s", ylabel="ARI, validation", ylim=(0, 1), title="bunny")
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(RESULTS / "prior.png", dpi=110)


if __name__ == "__main__":
    main()
