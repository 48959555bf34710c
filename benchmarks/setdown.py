"""Does anything break when it is set down? ``python benchmarks/setdown.py [--quick]`` (about 8 minutes).

Things of 0.1 and 0.3 m, of stone, ceramic, glass and plaster, are let go upright 5 mm above a stone floor in PyBullet.
The contacts that the world predicts until they stand, all of them within 10 ms acting together, are put to the
structural simulator of that very body. The table has the largest share of its breaking load that each body takes: below
1 nothing breaks. The bodies themselves are as stiff as that simulator says, and
unbreakable, so that every contact is seen. Writes
benchmarks/results/setdown.{json,md,png}, or, with ``--quick`` (one small plate), only prints.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from things import MESHES, TIME_STEP, world_on

import fracsim
from fracsim.baking import BakeOptions
from fracsim.common.material import PRESETS
from fracsim.fracture.arrays import SimulatorRecord
from fracsim.fracture.asset import BreakableAsset
from fracsim.learning.field import FieldOptions
from fracsim.learning.options import TrainingOptions
from fracsim.physics.impact_solver import IMPACT_WINDOW

RESULTS = Path(__file__).parent / "results"
BODIES = ("bunny", "chair", "vase", "mug", "plate")
SIZES = (0.1, 0.3)  # m
MATERIALS = ("stone", "ceramic", "glass", "plaster")
FLOOR = "stone"
HEIGHT = 0.005  # m
DURATION = 0.5  # s, by which everything stands or lies
UNBREAKABLE = 1e4  # times as strong


def asset_of(name: str) -> BreakableAsset:
    """Load what is shipped, and bake the rest as fast as can be: only shape and mass matter here."""
    if (MESHES / f"{name}.frac").exists():
        return fracsim.load(name)
    training = TrainingOptions("adamw", 3e-3, 1e-3, "cosine", batch=256, steps=50)
    model = FieldOptions(eigenfunctions=24, training=training)
    options = BakeOptions(cells=800, modes=3, samples=500, evaluated=50, workers=1, model=model)
    return fracsim.bake(MESHES / f"{name}.obj", options=options)


def contacts(asset: BreakableAsset) -> list[tuple[float, fracsim.Impulse]]:
    """Let an asset go above the floor: the time of each predicted contact, s, and its impulse in the asset's frame."""
    client, world = world_on(FLOOR)
    lowest = asset.vertices[:, 2].min()
    world.add(asset, (0, 0, HEIGHT - lowest), (0, 0, 0, 1))
    now, seen = [0.0], []
    world.on_contact(lambda contact: seen.append((now[0] + contact.delay, contact.impulse)))
    for _ in range(round(DURATION / TIME_STEP)):
        if world.step():
            raise RuntimeError(f"{asset.name} broke, though it is unbreakable")
        now[0] += TIME_STEP
    client.disconnect()
    return seen


def worst_share(simulator: Any, seen: list[tuple[float, fracsim.Impulse]]) -> float:
    """Put what acts together to a simulator: the largest share of the breaking load."""
    largest = 0.0
    for time, _ in seen:
        together = [impulse for when, impulse in seen if time <= when < time + IMPACT_WINDOW]
        largest = max(largest, 1.0 / simulator.critical_factor(together))
    return largest


def measure(name: str, sizes: tuple[float, ...], materials: tuple[str, ...]) -> list[dict[str, Any]]:
    """Set one thing down in every size and material."""
    asset = asset_of(name)
    rows = []
    for size in sizes:
        for material in materials:
            real = PRESETS[material]
            strong = replace(
                real, tensile_strength=UNBREAKABLE * real.tensile_strength, youngs_modulus=real.youngs_modulus
            )
            body = asset.scaled(size / asset.size).with_material(strong)
            mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
            simulator = fracsim.Simulator(mesh, "structural", material=material, seed=0)
            body = replace(
                body,
                arrays=replace(body.arrays, compliance=simulator.simulator.compliance[: body.vertex_count]),
                baked_from=SimulatorRecord("structural", 1.0, 1.0, False, "force"),
            )
            seen = contacts(body)
            rows.append(
                {
                    "body": name,
                    "size": size,
                    "material": material,
                    "contacts": len(seen),
                    "largest_share": worst_share(simulator, seen),
                }
            )
            print(rows[-1], flush=True)
    return rows


def write(rows: list[dict[str, Any]], command: str) -> None:
    """Write the figures, a table and a plot."""
    data = {"command": command, "height": HEIGHT, "floor": FLOOR, "rows": rows}
    (RESULTS / "setdown.json").write_text(json.dumps(data, indent=1) + "\n")
    lines = [
        f"Largest share of the load that breaks it, when set down upright from {1000 * HEIGHT:g} mm onto {FLOOR}; "
        f"from 1 on it breaks. `{command}`",
        "",
        "| body | size | " + " | ".join(MATERIALS) + " |",
        "|---" * (2 + len(MATERIALS)) + "|",
    ]
    for name in BODIES:
        for size in SIZES:
            shares = {r["material"]: r["largest_share"] for r in rows if r["body"] == name and r["size"] == size}
            cells = [f"{shares[m]:.2f}" if shares[m] < 1 else f"**{shares[m]:.2f}**" for m in MATERIALS]
            lines.append(f"| {name} | {size} m | " + " | ".join(cells) + " |")
    broken = sum(row["largest_share"] >= 1.0 for row in rows)
    lines += ["", f"{broken} of {len(rows)} break."]
    (RESULTS / "setdown.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3))
    for k, material in enumerate(MATERIALS):
        values = [row["largest_share"] for row in rows if row["material"] == material]
        axes.plot(np.arange(len(values)) + 0.15 * (k - 1.5), values, "o", markersize=4, label=material)
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    labels = [f"{name}\n{size:g} m" for name in BODIES for size in SIZES]
    axes.set_xticks(range(len(labels)), labels, fontsize=6)
    axes.set(ylabel="share of the breaking load", ylim=(0, None))
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(RESULTS / "setdown.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one plate; nothing is written")
    if parser.parse_args().quick:
        measure("plate", SIZES[:1], ("glass",))
        return
    rows = [row for name in BODIES for row in measure(name, SIZES, MATERIALS)]
    write(rows, "python benchmarks/setdown.py")


if __name__ == "__main__":
    main()
