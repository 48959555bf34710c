"""Calibrate the modal simulator on an everyday object: from what height does a dropped mug break?

python benchmarks/calibration.py            # writes benchmarks/results/calibration.{json,md,png}

A ceramic mug of 0.1 m falls in random orientations onto a rigid floor, its lowest point takes the impact of a
rigid body, and the simulator says at which speed the mug would break: lose a tenth of its mass or more, a
smaller chip being no break. GAUGE of simulators.diffusion is right when half of the falls break it from below the
geometric mean of 0.2 m, which a mug survives, and 1 m, which it does not. The same is tabulated for every preset.
"""

from __future__ import annotations

import json
from pathlib import Path

import manifold3d
import numpy as np
import trimesh

from fracsim.common.material import PRESETS
from fracsim.fracture.rule import components, load_ratios, weakest_cut
from fracsim.simulators.diffusion import GAUGE
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.surface import read_surface

RESULTS = Path(__file__).parent / "results"
MESHES = Path(__file__).parent.parent / "meshes"
GRAVITY = 9.81
FALLS = 2000
RANGE = (0.2, 1.0)  # m
INTACT = 0.9  # of the mass: what a chipped mug keeps at least


def mug() -> trimesh.Trimesh:
    """A mug of 0.1 m height, 0.08 m across, wall 4 mm, with a handle."""
    body = manifold3d.Manifold.cylinder(0.1, 0.04, circular_segments=48)
    hollow = manifold3d.Manifold.cylinder(0.1, 0.036, circular_segments=48).translate((0, 0, 0.006))
    ring = manifold3d.CrossSection.circle(0.005, 16).translate((0.024, 0))
    handle = manifold3d.Manifold.revolve(ring, 40).rotate((90, 0, 0)).translate((0.045, 0, 0.05))
    solid = (body + handle) - hollow
    out = solid.refine_to_length(0.006).to_mesh64()
    return trimesh.Trimesh(out.vert_properties[:, :3], out.tri_verts.astype(np.int64), process=False)


def critical_speeds(mesh: trimesh.Trimesh, restitution: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Per fall, the landing speeds that chip and that break the mesh, over GAUGE times the critical velocity."""
    surface = read_surface(mesh)
    simulator = ModalSimulator.build(surface, SimulatorOptions(), np.random.default_rng(0))
    interfaces, volumes = simulator.interfaces, simulator.cells.volumes
    pairs = interfaces.pairs
    body = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    inverse = np.linalg.inv(body.moment_inertia / body.volume)  # per unit mass
    rng = np.random.default_rng(1)
    up = rng.standard_normal((FALLS, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    lowest = np.argmin(up @ surface.vertices.T, axis=1)
    arm = np.cross(surface.vertices[lowest] - body.center_mass, up)
    effective = 1.0 / (1.0 + np.einsum("ni,ij,nj->n", arm, inverse, arm))  # of the mass
    rows = simulator.impact_field[lowest]
    drive = load_ratios(rows[:, None], up[:, None], ((1 + restitution) * effective)[:, None], interfaces)
    chip = 1.0 / weakest_cut(drive, pairs, len(volumes))
    # Damage only ever grows with speed, so bisect for where the largest piece falls below INTACT.
    low, high = chip, np.full_like(chip, 1.0 / drive.min())
    for _ in range(30):
        middle = np.sqrt(low * high)
        label = components(drive * middle[:, None] < 1.0, pairs, len(volumes))
        share = np.zeros(label.shape)
        np.add.at(share, (np.arange(FALLS)[:, None], label), volumes / volumes.sum())
        broken = share.max(axis=1) <= INTACT
        low, high = np.where(broken, low, middle), np.where(broken, middle, high)
    return chip, high


def main() -> None:
    objects = {"mug": (0.1, mug())}
    for name in ("bunny", "chair", "vase"):
        objects[name] = (0.3, trimesh.load_mesh(MESHES / f"{name}.obj", process=False))
    speeds = {name: critical_speeds(mesh) for name, (_, mesh) in objects.items()}
    rows = []
    for name, (size, _) in objects.items():
        for material in PRESETS.values():
            chip, broken = (
                np.percentile((speed * GAUGE * material.critical_velocity) ** 2 / (2 * GRAVITY), (10, 50, 90))
                for speed in speeds[name]
            )
            rows.append({"object": name, "size": size, "material": material.name, "chip": chip.tolist()})
            rows[-1] |= {"critical_velocity": material.critical_velocity, "break": broken.tolist()}
    middle = float(np.sqrt(RANGE[0] * RANGE[1]))
    ceramic = next(row for row in rows if row["object"] == "mug" and row["material"] == "ceramic")
    wanted = GAUGE * float(np.sqrt(middle / ceramic["break"][1]))
    result = {
        "command": "python benchmarks/calibration.py",
        "gauge": GAUGE,
        "gauge_that_centres_the_range": wanted,
        "falls": FALLS,
        "heights": rows,
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "calibration.json").write_text(json.dumps(result, indent=2) + "\n")
    lines = [
        f"Heights in m from which objects chip (first piece off) and break (a tenth of the mass off), in {FALLS}",
        "random falls onto a rigid floor: 10 % / half / 90 % of the falls. `python benchmarks/calibration.py`,",
        f"GAUGE = {GAUGE:g}; {wanted:.3g} would put the ceramic mug's median break at {middle:.2f} m exactly.",
        "",
        "| object | material | critical velocity, m/s | chips | breaks |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        chip, broken = (" / ".join(f"{height:.2g}" for height in row[key]) for key in ("chip", "break"))
        name = f"{row['object']}, {row['size']} m"
        lines.append(f"| {name} | {row['material']} | {row['critical_velocity']:.2f} | {chip} | {broken} |")
    (RESULTS / "calibration.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4))
    ceramic_velocity = GAUGE * PRESETS["ceramic"].critical_velocity
    for (name, (size, _)), color in zip(objects.items(), ("C0", "C1", "C2", "C3"), strict=True):
        for speed, style, what in zip(speeds[name], ("--", "-"), ("chips", "breaks"), strict=True):
            heights = np.sort((speed * ceramic_velocity) ** 2 / (2 * GRAVITY))
            label = f"{name}, {size} m, {what}"
            axes.semilogx(heights, np.linspace(0, 100, FALLS), style, color=color, label=label)
    axes.axvspan(*RANGE, alpha=0.15, color="grey", label="where a mug should break")
    axes.set(xlabel="drop height, m", ylabel="share of falls, %", title="ceramic, random falls", xlim=(1e-3, 1e2))
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(RESULTS / "calibration.png", dpi=110)


if __name__ == "__main__":
    main()
