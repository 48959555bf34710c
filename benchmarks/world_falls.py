"""Falls of a baked mug in PyBullet: ``python benchmarks/world_falls.py`` (about 8 minutes).

The mug of ``meshes/mug.obj``, 0.114 m with its handle, of ceramic, is baked from the structural simulator with today's
field model. It falls in random orientations onto floors of stone, wood, carpet and rubber (``World.set_material``). The
table has the share of falls in which it breaks within the first quarter of a second of contact. No number was fitted to
a height. Writes benchmarks/results/world_falls.{json,md,png}.
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import numpy as np
from scipy.spatial.transform import Rotation
from things import TIME_STEP, thing, world_on

import fracsim
from fracsim.baking import BakeOptions

matplotlib.use("Agg")
from matplotlib import pyplot

RESULTS = Path(__file__).parent / "results"
SIZE = 0.114  # m
FLOORS = ("stone", "wood", "carpet", "rubber")
HEIGHTS = (0.005, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)  # m
FALLS = 40
AFTERWARDS = 0.25  # s, from when it should have landed


def breaks(asset: fracsim.BreakableAsset, floor: str, height: float, turn: Rotation) -> bool:
    """Let an asset fall once."""
    client, world = world_on(floor)
    lowest = float(turn.apply(asset.vertices)[:, 2].min())
    world.add(asset, (0, 0, height - lowest), tuple(turn.as_quat()))
    steps = round((np.sqrt(2 * height / 9.81) + AFTERWARDS) / TIME_STEP)
    broke = any(world.step() for _ in range(steps))
    client.disconnect()
    return broke


def main() -> None:
    asset = fracsim.bake(thing("mug", SIZE), material="ceramic", options=BakeOptions(simulator="structural", workers=2))
    turns = [Rotation.random(random_state=k) for k in range(FALLS)]
    shares = {
        floor: [float(np.mean([breaks(asset, floor, height, turn) for turn in turns])) for height in HEIGHTS]
        for floor in FLOORS
    }
    test = asset.metadata["test"]
    data = {
        "command": "python benchmarks/world_falls.py",
        "heights": HEIGHTS,
        "shares": shares,
        "seconds": asset.metadata["seconds"],
        "test": test,
        "repeatability": asset.metadata["repeatability"],
    }
    (RESULTS / "world_falls.json").write_text(json.dumps(data, indent=1) + "\n")
    lines = [
        f"Share of {FALLS} falls in which a baked ceramic mug breaks. The bake took {data['seconds']['total']:.0f} s; "
        f"the model's ARI on held-out impacts is {test['ari']:.2f}, that of the nearest training impulse "
        f"{test['ari_nearest_impulse']:.2f}, and the simulator's own under a shift of 1 % "
        f"{asset.metadata['repeatability']['ari_moved_1_percent']:.2f}. `python benchmarks/world_falls.py`",
        "",
        "| floor | " + " | ".join(f"{height:g} m" for height in HEIGHTS) + " |",
        "|---" * (1 + len(HEIGHTS)) + "|",
    ]
    lines += [f"| {floor} | " + " | ".join(f"{share:.0%}" for share in shares[floor]) + " |" for floor in FLOORS]
    (RESULTS / "world_falls.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))

    figure, axes = pyplot.subplots(figsize=(5, 3))
    for floor in FLOORS:
        axes.semilogx(HEIGHTS, shares[floor], "o-", label=floor, markersize=4)
    axes.set(xlabel="height, m", ylabel="share that breaks", ylim=(-0.03, 1.03))
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(RESULTS / "world_falls.png", dpi=100)


if __name__ == "__main__":
    main()
