"""Pictures of how things break: ``python benchmarks/lattice_pictures.py`` (about 3 minutes).

A mug, a bunny, a vase, a plate and a rod of ceramic are struck by hard things, each at one place and at twice the
impulse that breaks it by the structural simulator. Above is what that simulator does, below the sequential one under
the same impulse; the pieces are moved apart. Writes benchmarks/results/lattice_pictures.png.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import trimesh
from things import thing

import fracsim
from fracsim.common.arrays import FloatArray

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.colors import LightSource, to_rgb
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

RESULTS = Path(__file__).parent / "results"
# m, where it is struck (of the bounding box, 0 to 1) and the way it is seen from (elevation and azimuth, degrees)
BODIES = {
    "mug": (0.1, (0.5, 0.0, 0.6), (25, -60)),
    "bunny": (0.3, (0.3, 0.5, 1.0), (15, -70)),
    "vase": (0.3, (0.5, 0.0, 0.5), (15, -70)),
    "plate": (0.27, (0.0, 0.5, 0.9), (55, -60)),
    "rod": (0.2, (0.5, 0.0, 0.5), (15, -60)),
}
HARD = 2.0  # times what breaks the body
APART = 0.25  # of the distance from the middle, by which pieces are moved
TONES = pyplot.get_cmap("tab20").colors
LIGHT = LightSource(azdeg=315, altdeg=50)


def struck(vertices: FloatArray, faces: Any, place: tuple[float, float, float]) -> fracsim.Impulse:
    """Make an impulse of 1 N·s against the face nearest to a place."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    low, high = mesh.bounds
    face = int(np.argmin(np.linalg.norm(mesh.triangles_center - (low + np.array(place) * (high - low)), axis=1)))
    return fracsim.Impulse(mesh.triangles_center[face], -mesh.face_normals[face], 1.0)


def draw(axes: Any, fracture: Any, impulse: fracsim.Impulse, view: tuple[float, float]) -> None:
    """Draw pieces moved apart, and the impulse."""
    middle = np.mean([piece.vertices.mean(axis=0) for piece in fracture.pieces], axis=0)
    order = np.argsort([-piece.mass for piece in fracture.pieces])
    points = []
    for rank, k in enumerate(order.tolist()):
        piece = fracture.pieces[k]
        moved = piece.vertices + APART * (piece.vertices.mean(axis=0) - middle)
        tone = np.array(to_rgb("0.85") if rank == 0 else TONES[(rank - 1) % len(TONES)])
        corners = moved[piece.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
        shade = 0.45 + 0.55 * LIGHT.shade_normals(normal, fraction=1.0)[:, None]
        axes.add_collection3d(Poly3DCollection(corners, facecolors=np.clip(shade * tone, 0, 1), linewidths=0))
        points.append(moved)
    every = np.vstack(points)
    size = 0.55 * float(np.ptp(every, axis=0).max())
    center = (every.min(axis=0) + every.max(axis=0)) / 2
    start = impulse.point - 0.6 * size * impulse.direction
    axes.quiver(*start, *(0.5 * size * impulse.direction), color="crimson", linewidth=1.5)
    for name, value in zip("xyz", center, strict=True):
        getattr(axes, f"set_{name}lim")(value - size, value + size)
    axes.set_box_aspect((1, 1, 1), zoom=1.5)
    axes.view_init(*view)
    axes.set_axis_off()


def main() -> None:
    figure = pyplot.figure(figsize=(2.4 * len(BODIES), 5.2))
    for column, (name, (size, place, view)) in enumerate(BODIES.items()):
        mesh = thing(name, size)
        impulse = None
        for row, kind in enumerate(("structural", "sequential")):
            simulator = fracsim.Simulator(mesh, kind, material="ceramic", seed=0)
            if impulse is None:
                impulse = struck(simulator.vertices, simulator.faces, place)
                impulse = impulse.times(HARD * simulator.critical_factor(impulse))
            fracture = simulator.fracture(impulse)
            axes = figure.add_subplot(2, len(BODIES), 1 + column + row * len(BODIES), projection="3d")
            draw(axes, fracture, impulse, view)
            axes.set_title(f"{name}, {kind}: {len(fracture.masses)}", fontsize=9, y=0.97)
            print(name, kind, fracture.shares.round(2).tolist(), flush=True)
    figure.subplots_adjust(0, 0, 1, 0.96, 0, 0.02)
    figure.savefig(RESULTS / "lattice_pictures.png", dpi=90)


if __name__ == "__main__":
    main()
