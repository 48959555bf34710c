"""How exact the labels are: which part of the body each surface vertex, and each point of a thin wall, is on.

python benchmarks/labels.py         # writes benchmarks/results/labels.{json,md,png}; about a minute

The parts of the simulator's body are the surface's own inside, so labels need no mapping. Held against two
mappings that use a proxy, as the thesis does: a vertex takes the label of the nearest cell centroid, or of the
nearest vertex of a cage (a quarter of the vertices, moved 2 % of the size outward). Three checks: parts add up
to the body; moved a little inward, each vertex lies in the part it is labelled with, by the winding number of
that part's own closed surface; and a ray through the vase's wall goes in and comes out on the same piece,
unless a crack passes within a wall's thickness.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from udf import CELLS, FRACTURES, MESHES, RESULTS, SEED, fractures

from fracsim.geometry.complex import CellComplex
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.geodesics import crack_segments
from fracsim.solids.solid import Solid
from fracsim.solids.surface import read_surface, refine

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

INWARD = 1e-6  # of the size: how far vertices are moved before they are asked for again
RAYS = 4000
SHARE, OFFSET = 4, 0.02  # the cage: one vertex in SHARE, OFFSET of the size outward
OURS, CENTROID, CAGE = "ours", "nearest cell centroid", "nearest cage vertex"


# ------------------------------------------------------------------------------------------ the parts themselves


def additivity(simulator: ModalSimulator) -> dict[str, float]:
    """How far the parts' volumes and outer faces are from the body's, relative."""
    parts, mesh = simulator.cells, simulator.surface.trimesh
    outer = parts.source >= 0
    p, q, r = np.moveaxis(parts.points[parts.triangles[outer]], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(q - p, r - p), axis=1)
    per_face = np.bincount(parts.source[outer], area, minlength=len(mesh.faces))
    # Volumes again, from the closed surfaces that pieces are read off.
    volumes, _, _ = CellComplex(parts.points, parts.triangles, parts.sides).moments()
    return {
        "volume": float(abs(parts.volumes.sum() / mesh.volume - 1)),
        "volume_of_surfaces": float(abs(volumes.sum() / mesh.volume - 1)),
        "area": float(abs(area.sum() / mesh.area - 1)),
        "worst_face": float(np.abs(per_face / mesh.area_faces - 1).max()),
    }


def winding(points: FloatArray, vertices: FloatArray, faces: IntArray) -> FloatArray:
    """How often a closed surface winds around each point (van Oosterom and Strackee 1983): 1 inside, 0 outside."""
    result = np.empty(len(points))
    for start in range(0, len(points), 64):
        arm = vertices - points[start : start + 64, None]  # (N, P, 3)
        length = np.linalg.norm(arm, axis=2)
        a, b, c = (arm[:, faces[:, k]] for k in range(3))
        x, y, z = (length[:, faces[:, k]] for k in range(3))
        up = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("nfi,nfi->nf", *pair) for pair in ((a, b), (b, c), (c, a)))
        result[start : start + 64] = np.arctan2(up, x * y * z + ab * z + bc * x + ca * y).sum(axis=1) / (2 * np.pi)
    return result


def containment(simulator: ModalSimulator) -> dict[str, float]:
    """Asks every part's closed surface which vertices, moved inward, it holds."""
    parts, mesh = simulator.cells, simulator.surface.trimesh
    points = simulator.surface.vertices - INWARD * mesh.vertex_normals  # weighted by angle
    label = parts.vertex_cells(len(points))
    complex_ = CellComplex(parts.points, parts.triangles, parts.sides)
    holders = np.zeros(len(points), dtype=np.int64)
    right = np.zeros(len(points), dtype=bool)
    for part in range(len(parts.volumes)):
        vertices, faces, _ = complex_.surface(np.arange(len(parts.volumes)) == part)
        near = np.flatnonzero(((points >= vertices.min(axis=0)) & (points <= vertices.max(axis=0))).all(axis=1))
        held = near[winding(points[near], vertices, faces) > 0.5]
        holders[held] += 1
        right[held] |= label[held] == part
    return {
        "agree": float(right.mean()),
        "in_no_part": float((holders == 0).mean()),
        "in_two": float((holders > 1).mean()),
    }


# ------------------------------------------------------------------------------------------------ other mappings


def farthest(points: FloatArray, count: int) -> IntArray:
    """``count`` points, each the farthest from those before it."""
    chosen = np.zeros(count, dtype=np.int64)
    distance = np.full(len(points), np.inf)
    for k in range(1, count):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[k - 1]], axis=1))
        chosen[k] = distance.argmax()
    return chosen


def mappings(simulator: ModalSimulator) -> dict[str, IntArray]:
    """(V,) the part of each vertex, by name of the way it is found."""
    vertices, mesh = simulator.surface.vertices, simulator.surface.trimesh
    cells = cKDTree(simulator.fine_cells.centroids)
    chosen = farthest(vertices, len(vertices) // SHARE)
    cage = vertices[chosen] + OFFSET * mesh.vertex_normals[chosen]
    of_cage = simulator.fine_to_cell[cells.query(cage)[1]]
    return {
        OURS: simulator.cells.vertex_cells(len(vertices)),
        CENTROID: simulator.fine_to_cell[cells.query(vertices)[1]],
        CAGE: of_cage[cKDTree(cage).query(vertices)[1]],
    }


# -------------------------------------------------------------------------------------------------- thin walls


def first_hits(origin: FloatArray, direction: FloatArray, corners: FloatArray) -> tuple[FloatArray, IntArray]:
    """The first triangle (F, 3, 3) before each ray (N,) and how far (Möller and Trumbore 1997); inf, -1 if none."""
    far, hit = np.full(len(origin), np.inf), np.full(len(origin), -1)
    p = corners[:, 0]
    e, f = corners[:, 1] - p, corners[:, 2] - p
    for start in range(0, len(origin), 64):
        rows = slice(start, start + 64)
        d = direction[rows, None]
        h = np.cross(d, f)
        det = np.einsum("nfi,fi->nf", h, e)
        s = origin[rows, None] - p
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("nfi,nfi->nf", s, h) / det
            q = np.cross(s, e)
            v = (q * d).sum(axis=2) / det
            t = np.einsum("nfi,fi->nf", q, f) / det
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-7), t, np.inf)
        hit[rows] = np.where(np.isfinite(t.min(axis=1)), t.argmin(axis=1), -1)
        far[rows] = t.min(axis=1)
    return far, hit


def to_segments(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Distance of each point (N, 3) to the nearest of the segments."""
    along = end - start
    arm = points[:, None] - start
    t = np.clip((arm * along).sum(axis=2) / (along**2).sum(axis=1), 0, 1)
    return np.linalg.norm(arm - t[:, :, None] * along, axis=2).min(axis=1)


def nearest_corner(simulator: ModalSimulator, faces: IntArray, points: FloatArray) -> IntArray:
    """The corner nearest to each point among those of its face: a wall may be thinner than its edges are long."""
    gap = np.linalg.norm(simulator.surface.vertices[faces] - points[:, None], axis=2)
    return np.take_along_axis(faces, gap.argmin(axis=1)[:, None], axis=1)[:, 0]


class Wall:
    """Rays through the wall of a body about the z axis, from random points of its outside, along the normal.

    entry, exit: (N, 3), where they go in and come out. thickness: (N,), between the two. parts: (N, 2), exactly
    those that the two lie on. nearest: (N, 2), the nearest corners of the input's faces there.
    """

    def __init__(self, simulator: ModalSimulator, rng: np.random.Generator) -> None:
        parts, vertices = simulator.cells, simulator.surface.vertices
        outer = np.flatnonzero(parts.source >= 0)
        corners = parts.points[parts.triangles[outer]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(normal, axis=1)
        faces = simulator.surface.faces[parts.source[outer]]
        normal = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        away = (corners.mean(axis=1)[:, :2] * normal[:, :2]).sum(axis=1)
        outside = np.where(away > 0, double, 0.0)
        start = rng.choice(len(outer), RAYS, p=outside / outside.sum())
        entry = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), RAYS), corners[start])
        thickness, end = first_hits(entry, -normal[start], corners)
        # Through the wall: out on the inner side, at no more than twice the usual depth (the foot is solid).
        through = (end >= 0) & (away[end] < 0)
        through &= thickness < 2 * np.median(thickness[through])
        self.entry, self.thickness = entry[through], thickness[through]
        self.exit = self.entry - self.thickness[:, None] * normal[start[through]]
        self.cells = parts.sides[outer][np.stack([start[through], end[through]], axis=1), 0]
        self.nearest = np.stack(
            [
                nearest_corner(simulator, faces[start[through]], self.entry),
                nearest_corner(simulator, faces[end[through]], self.exit),
            ],
            axis=1,
        )

    def agreement(self, solid: Solid, labels: IntArray, ends: IntArray) -> dict[str, float]:
        """How many rays go in and come out on one piece, in the mean over fractures; ends: (N, 2) their parts."""
        segments, between, _ = crack_segments(solid)
        outright, near, gaps = [], [], []
        for label in labels:
            same = label[ends[:, 0]] == label[ends[:, 1]]
            chosen = segments[label[between[:, 0]] != label[between[:, 1]]]
            start, end = solid.points[chosen[:, 0]], solid.points[chosen[:, 1]]
            gap = np.minimum(to_segments(self.entry[~same], start, end), to_segments(self.exit[~same], start, end))
            gap /= self.thickness[~same]
            outright.append(same.mean())
            near.append(1 - (gap > 1).sum() / len(same))
            gaps.append(gap)
        gap = np.concatenate(gaps)
        return {
            "agree": float(np.mean(outright)),
            "agree_or_near": float(np.mean(near)),
            "worst_fracture": float(np.min(near)),
            "disagreeing": len(gap),
            "gap_median": float(np.median(gap)),
            "gap_p99": float(np.quantile(gap, 0.99)),
            "gap_max": float(gap.max()),
        }


# ------------------------------------------------------------------------------------------------------ picture


def unrolled(simulator: ModalSimulator, columns: int = 240, rows: int = 220) -> tuple[IntArray, IntArray]:
    """Outer and inner wall seen along radii: the parts and the nearest vertices there, (2, rows, columns), or -1."""
    parts = simulator.cells
    outer = np.flatnonzero(parts.source >= 0)
    corners = parts.points[parts.triangles[outer]]
    low, high = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
    angle = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    direction = -np.stack([np.cos(angle), np.sin(angle), np.zeros(columns)], axis=1)
    part, vertex = np.full((2, 2, rows, columns), -1)
    for row, z in enumerate(np.linspace(-0.495, 0.495, rows)):
        here = np.flatnonzero((low <= z) & (high >= z))
        origin = -direction + [0, 0, z]
        for wall in range(2):
            far, hit = first_hits(origin, direction, corners[here])
            found = (hit >= 0) & (np.linalg.norm(origin[:, :2], axis=1) > far)  # not beyond the axis
            there = outer[here[hit[found]]]
            part[wall, row, found] = parts.sides[there, 0]
            origin = origin + np.where(np.isfinite(far), far, 0.0)[:, None] * direction
            vertex[wall, row, found] = nearest_corner(
                simulator, simulator.surface.faces[parts.source[there]], origin[found]
            )
    return part, vertex


def draw(simulator: ModalSimulator, labels: IntArray, of_vertex: dict[str, IntArray], result: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import ListedColormap

    part, vertex = unrolled(simulator)
    # A fracture into few enough pieces to tell apart, and enough of them to show.
    share = simulator.cells.volumes / simulator.cells.volumes.sum()
    label = min(labels, key=lambda row: abs(int((np.bincount(row, share) > 0.02).sum()) - 7))
    order = np.argsort(np.argsort(-np.bincount(label, simulator.cells.volumes)))
    label = order[label]
    colors = ListedColormap(np.vstack([pyplot.get_cmap("tab20").colors] * (1 + label.max() // 20))[: label.max() + 1])
    figure = pyplot.figure(figsize=(13, 7.2))
    grid = figure.add_gridspec(2, 5, width_ratios=(1, 1, 1, 0.18, 1), hspace=0.38, wspace=0.25)
    titles = {OURS: "ours", CENTROID: "nearest cell centroid", CAGE: "nearest cage vertex"}
    agree = {row["method"]: row for row in result["wall"]}
    for column, (method, title) in enumerate(titles.items()):
        seen = part if method == OURS else np.where(vertex >= 0, of_vertex[method][vertex], -1)
        image = np.ma.masked_array(label[seen], seen < 0)
        for wall, name in enumerate(("outer wall", "inner wall")):
            axes = figure.add_subplot(grid[wall, column])
            axes.imshow(
                image[wall],
                origin="lower",
                extent=(0, 360, 0, 1),
                aspect="auto",
                cmap=colors,
                vmin=-0.5,
                vmax=label.max() + 0.5,
                interpolation="nearest",
            )
            # Where the two walls say different things.
            differ = (image[0] != image[1]).filled(False) & (seen >= 0).all(axis=0)
            if wall:
                shade = np.zeros((*differ.shape, 4))
                shade[differ] = (0, 0, 0, 0.8)
                axes.imshow(shade, origin="lower", extent=(0, 360, 0, 1), aspect="auto", interpolation="nearest")
                axes.set_xlabel("around, °")
            text = f"{title}: {name}"
            if wall:
                text += f"\nblack: another piece outside ({differ.sum() / (seen >= 0).all(axis=0).sum():.1%})"
            axes.set_title(text, fontsize=8)
            axes.set_facecolor("0.9")
            axes.set(ylabel="height" if column == 0 else "", xticks=(0, 90, 180, 270, 360))
    axes = figure.add_subplot(grid[0, 4])
    names = [row["mesh"] for row in result["vertices"]]
    for k, method in enumerate((OURS, CENTROID, CAGE)):
        wrong = [max(100 * (1 - row[method]), 0.0) for row in result["vertices"]]
        bars = axes.bar(np.arange(len(names)) + 0.27 * (k - 1), wrong, 0.26, label=method)
        axes.bar_label(bars, [f"{w:.2g}" for w in wrong], fontsize=7)
    axes.set_xticks(range(len(names)), names)
    axes.set_title("vertices on the wrong piece, %", fontsize=9)
    axes.legend(fontsize=7)
    axes = figure.add_subplot(grid[1, 4])
    names = list(agree)
    apart = [100 * (1 - agree[m]["agree"]) for m in names]
    beyond = [100 * (1 - agree[m]["agree_or_near"]) for m in names]
    y = np.arange(len(names))[::-1]
    axes.barh(y + 0.2, apart, 0.38, color="0.6", label="disagree")
    axes.barh(y - 0.2, beyond, 0.38, color="C3", label="disagree with no crack\nwithin a wall's thickness")
    for at, a, b in zip(y, apart, beyond, strict=True):
        axes.text(a, at + 0.2, f" {a:.2f}", va="center", fontsize=7)
        axes.text(b, at - 0.2, f" {b:.2f}", va="center", fontsize=7)
    axes.set_yticks(y, [n.replace(", ", ",\n") for n in names], fontsize=7)
    axes.set(xlim=(0, 1.25 * max(apart)), ylim=(-1.6, len(names) - 0.5))
    axes.set_title("rays through the vase's wall, %", fontsize=9)
    axes.legend(fontsize=7, loc="lower right")
    figure.suptitle(
        f"Which piece is it: one fracture of the vase, its walls unrolled (left); {FRACTURES} fractures each (right)"
    )
    figure.savefig(RESULTS / "labels.png", dpi=110, bbox_inches="tight")


# --------------------------------------------------------------------------------------------------------- main


def write(result: dict) -> None:
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "labels.json").write_text(json.dumps(result, indent=2) + "\n")
    lines = [
        f"Labels of the parts and pieces, `python benchmarks/labels.py`, seed {SEED}.",
        "",
        "The parts make up the body, relative errors; and each vertex, moved 1e-6 of the size inward, lies within",
        "the part that it is labelled with, by the winding number of that part's closed surface.",
        "",
        "| mesh | parts | volume | outer area | worst face | vertices in their part | in no part | in two |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['mesh']} | {r['parts']} | {r['volume']:.0e} | {r['area']:.0e} | {r['worst_face']:.0e} | "
        f"{r['agree']:.2%} | {r['in_no_part']:.2%} | {r['in_two']:.2%} |"
        for r in result["parts"]
    ]
    lines += [
        "",
        f"Vertices on the right piece, over {FRACTURES} fractures (right part).",
        "",
        f"| mesh | {OURS} | {CENTROID} | {CAGE} |",
        "|---|---|---|---|",
    ]
    for r in result["vertices"]:
        cells = " | ".join(f"{r[m]:.2%} ({r[m + ', part']:.2%})" for m in (OURS, CENTROID, CAGE))
        lines.append(f"| {r['mesh']} | {cells} |")
    lines += [
        "",
        f"Rays through the vase's wall ({result['rays']:,} of them, {FRACTURES} fractures; the wall is",
        f"{result['thickness']:.3f} of the size): those that go in and come out on one piece, and those that do or",
        "have a crack within a wall's thickness of an end, as a crack inclined to the wall allows. Gap: from the",
        "disagreeing rays' nearer end to the nearest crack, in thicknesses. The last three rows read labels at the",
        "nearest corner of the face, which by itself costs up to half an edge (edges are 1.5 thicknesses long).",
        "",
        "| | agree | agree or near a crack | worst fracture | gap, median | 99 % | max |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in result["wall"]:
        lines.append(
            f"| {r['method']} | {r['agree']:.2%} | {r['agree_or_near']:.2%} | {r['worst_fracture']:.2%} | "
            f"{r['gap_median']:.2f} | {r['gap_p99']:.2f} | {r['gap_max']:.2f} |"
        )
    (RESULTS / "labels.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def main() -> None:
    result: dict = {"command": "python benchmarks/labels.py", "seed": SEED, "fractures": FRACTURES}
    result |= {"parts": [], "vertices": [], "wall": []}
    for name in ("bunny", "chair", "vase"):
        surface = replace(refine(read_surface(MESHES / f"{name}.obj")), name=name)
        simulator = ModalSimulator.build(surface, SimulatorOptions(cells=CELLS), np.random.default_rng(SEED))
        labels = fractures(simulator, FRACTURES, np.random.default_rng(SEED + 1))
        of_vertex = mappings(simulator)
        result["parts"].append(
            {"mesh": name, "parts": len(simulator.cells.volumes), **additivity(simulator), **containment(simulator)}
        )
        right = of_vertex[OURS]
        row: dict = {"mesh": name}
        for method, part in of_vertex.items():
            row[method] = float((labels[:, part] == labels[:, right]).mean())
            row[method + ", part"] = float((part == right).mean())
        result["vertices"].append(row)
    wall = Wall(simulator, np.random.default_rng(SEED + 2))
    result |= {"rays": len(wall.entry), "thickness": float(np.median(wall.thickness))}
    ends = {OURS + ", at the point": wall.cells}
    ends |= {method + ", at the vertex": part[wall.nearest] for method, part in of_vertex.items()}
    for method, part in ends.items():
        result["wall"].append({"method": method, **wall.agreement(simulator.cells, labels, part)})
    write(result)
    draw(simulator, labels, of_vertex, result)


if __name__ == "__main__":
    main()
