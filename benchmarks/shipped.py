"""Tabulate what baking measured of the shipped assets: ``python benchmarks/shipped.py``.

Writes benchmarks/results/shipped.json, .md and .png. ``fracsim bake`` took the figures on the test split when it made
the assets; nothing is measured again here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import fracsim

RESULTS = Path(__file__).parent / "results"
NAMES = ("bunny", "chair", "vase")
SERIES = {"ari": "learned field, watershed", "ari_nearest_impulse": "nearest training impulse"}


def table(assets: dict[str, dict[str, Any]]) -> str:
    """Write the figures as Markdown, a row for each asset.

    Parameters
    ----------
    assets : dict
        The metadata of each asset, by its name.
    """
    lines = [
        "| | vertices | atoms | ARI | baseline | ARI ≥ 0.7 | baseline | AMAE | breaks or not | baseline |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, metadata in assets.items():
        test, counts = metadata["test"], metadata["counts"]
        lines.append(
            f"| {name} | {counts['vertices']} | {counts['atoms']} | **{test['ari']:.3f}** | "
            f"{test['ari_nearest_impulse']:.3f} | **{test['accepted']:.1%}** | "
            f"{test['accepted_nearest_impulse']:.1%} | "
            f"{test['amae']:.4f} | **{test['balanced_accuracy']:.1%}** | "
            f"{test['balanced_accuracy_nearest_impulse']:.1%} |"
        )
    return "\n".join(lines)


def draw(assets: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw a bar for each asset and series.

    Parameters
    ----------
    assets : dict
        The metadata of each asset, by its name.
    path : Path
        The PNG file to write.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.5))
    axes = figure.subplots()
    for offset, (key, label) in zip((-0.2, 0.2), SERIES.items(), strict=True):
        places = [k + offset for k in range(len(assets))]
        axes.bar(places, [metadata["test"][key] for metadata in assets.values()], 0.36, label=label)
    axes.set(xticks=range(len(assets)), xticklabels=assets, ylim=(0, 1), ylabel="ARI, held-out breaking impulses")
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Write the three files."""
    assets = {name: fracsim.load(name).metadata for name in NAMES}
    RESULTS.mkdir(exist_ok=True)
    data = {"command": "python benchmarks/shipped.py", "assets": assets}
    (RESULTS / "shipped.json").write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    (RESULTS / "shipped.md").write_text(table(assets) + "\n", encoding="utf-8")
    draw(assets, RESULTS / "shipped.png")
    print(table(assets))


if __name__ == "__main__":
    main()
