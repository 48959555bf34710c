"""Pictures of datasets and fractures, and the drawing of meshes that all charts share. Offline only.

The command line and the other modules of studies use it.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import DatasetError, MissingExtraError
from ..common.files import write_beside
from ..common.impulse import Impulse
from ..fracture.asset import BreakableAsset
from ..fracture.result import Fracture

if TYPE_CHECKING:
    from ..data.samples import Samples

try:
    import matplotlib
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
except ImportError as error:
    raise MissingExtraError("matplotlib", "plot") from error


COLUMNS, ROWS = 4, 3  # of samples on a sheet
CHOICE = 10  # samples that are read for each that is drawn, so that every kind of impact can be among them
APART = 0.4  # by how much pieces are moved apart, as a fraction of their distance from the body's centre of mass
LIGHT = np.array([0.3, 0.5, 0.81])  # direction to the light in the frame of the picture: right, up, towards the eye
AMBIENT = 0.35  # brightness of a face that the light does not reach


def picture_sheet(path: str | Path, out: str | Path, seed: int = 0) -> None:
    """Draw samples of a dataset that break the body: pieces and distance field, seen from where the body was hit.

    Parameters
    ----------
    path : str or Path
        The dataset.
    out : str or Path
        The PNG file to write.
    seed : int
        Seed of the choice of samples.

    Raises
    ------
    DatasetError
        If no sample breaks the body.
    """
    from ..data.dataset import Dataset
    from ..data.samples import Samples
    from ..geometry.sampling import SurfacePoints

    with Dataset(path) as dataset:
        breaking = [
            block.take(np.flatnonzero(block.labels.any(axis=1)))
            for block in _first_breaking(dataset.blocks(skip_damaged=True))
        ]
        if not breaking:
            raise DatasetError(f"{path}: no sample breaks the body; there is nothing to draw")
        samples = Samples.join(breaking)
        rng = np.random.default_rng(seed)
        shown = samples.take(_of_every_kind(samples.kind, COLUMNS * ROWS, rng))
        vertices, faces = dataset.surface.vertices, dataset.surface.faces
        pieces = shown.labels[:, dataset.cells.vertex_cells(len(vertices))]
        fields = dataset.fields(shown.labels)[:, : len(vertices)]
        cap = float(dataset.header["cap"])
        name = Path(dataset.surface.name).stem
        kinds = dataset.header["sampling"]["kinds"]
        reference = dataset.header.get("ratio_to", "threshold")
    points = SurfacePoints(vertices, faces)
    figure = Figure(figsize=(4.2 * COLUMNS, 2.5 * ROWS), layout="constrained")
    axes = figure.subplots(ROWS, 2 * COLUMNS, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for k in range(len(shown)):
        used = shown.severities[k] > 0  # of the impulses that an impact may have
        contacts = points.at(shown.faces[k, used], shown.barycentric[k, used])
        outward = points.normals[shown.faces[k, used]].mean(axis=0)
        frame = view_frame(outward)
        left, right = axes[2 * k], axes[2 * k + 1]
        piece = np.array([np.bincount(row).argmax() for row in pieces[k][faces]])
        colours = matplotlib.colormaps["tab20"](piece % 20)
        draw_mesh(left, vertices, faces, colours, frame)
        draw_mesh(right, vertices, faces, matplotlib.colormaps["viridis"](fields[k][faces].mean(axis=1) / cap), frame)
        for axis in (left, right):
            _draw_arrows(axis, contacts, shown.directions[k, used], frame)
        count = shown.labels[k].max() + 1
        left.set_title(f"{kinds[shown.kind[k]]}, {shown.ratio[k]:.1f} × {reference}, {count} pieces", fontsize=8)
        right.set_title("distance to the nearest crack", fontsize=8)
    figure.suptitle(name, fontsize=9)
    write_beside(Path(out), as_png(figure, 100))


def picture_fractures(
    asset: BreakableAsset, impacts: Sequence[tuple[Sequence[Impulse], Fracture]], out: str | Path
) -> None:
    """Draw fractures of an asset in rows: distance field and impulses, pieces, pieces apart, and their convex parts.

    Parameters
    ----------
    asset : BreakableAsset
        The asset.
    impacts : sequence of tuple
        The impulses of each impact, and the fracture that they cause.
    out : str or Path
        The PNG file to write.
    """
    titles = "distance to the nearest crack", "pieces", "pieces apart", "convex parts of the pieces"
    figure = Figure(figsize=(3.4 * len(titles), 3.2 * len(impacts)), layout="constrained")
    rows = figure.subplots(len(impacts), len(titles), squeeze=False)
    palette = matplotlib.colormaps["tab20"](np.arange(20))
    for axes, (impulses, fracture) in zip(rows, impacts, strict=True):
        frame = view_frame(-np.sum([impulse.direction for impulse in impulses], axis=0))
        distance = fracture.udf[asset.faces].mean(axis=1) / max(float(fracture.udf.max()), 1e-300)
        draw_mesh(axes[0], asset.vertices, asset.faces, matplotlib.colormaps["viridis"](distance), frame)
        contacts = np.array([impulse.point for impulse in impulses])
        arrows = asset.size * np.array([impulse.direction for impulse in impulses])
        _draw_arrows(axes[0], contacts, arrows, frame)
        apart = [APART * (piece.center_of_mass - asset.center_of_mass) for piece in fracture.pieces]
        surfaces = [(piece.vertices, piece.faces) for piece in fracture.pieces]
        _draw_all(axes[1], surfaces, palette, frame)
        moved = [(vertices + offset, faces) for (vertices, faces), offset in zip(surfaces, apart, strict=True)]
        _draw_all(axes[2], moved, palette, frame)
        hulls = [
            (vertices + offset, faces)
            for piece, offset in zip(fracture.pieces, apart, strict=True)
            for vertices, faces in piece.hulls
        ]
        _draw_all(axes[3], hulls, palette, frame)
        for axis, title in zip(axes, titles, strict=True):
            axis.set_axis_off()
            axis.set_title(title, fontsize=8)
        total = sum(impulse.magnitude for impulse in impulses)
        axes[0].set_title(f"{total:.3g} N·s, severity {fracture.severity:.2g}: {titles[0]}", fontsize=8)
        axes[1].set_title(f"{len(fracture.pieces)} pieces", fontsize=8)
    figure.suptitle(f"{asset.name}, {asset.size:.3g} m of {asset.material.name}, {asset.mass:.3g} kg", fontsize=9)
    write_beside(Path(out), as_png(figure, 110))


def _draw_all(axis: Any, meshes: Sequence[tuple[FloatArray, IntArray]], palette: FloatArray, frame: FloatArray) -> None:
    """Draw closed meshes, each in a colour of its own."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    vertices = np.vstack([vertices for vertices, _ in meshes])
    faces = np.vstack([faces + start for (_, faces), start in zip(meshes, starts, strict=False)])
    owner = np.repeat(np.arange(len(meshes)), [len(faces) for _, faces in meshes])
    draw_mesh(axis, vertices, faces, palette[owner % len(palette)], frame)


def as_png(figure: Figure, dpi: int) -> bytes:
    """Render a figure.

    Parameters
    ----------
    figure : Figure
        The figure.
    dpi : int
        Pixels per inch.

    Returns
    -------
    bytes
        A PNG file.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _first_breaking(blocks: Iterator[Samples]) -> Iterator[Samples]:
    """Read blocks with samples that break the body, until there is enough choice for a sheet."""
    count = 0
    for block in blocks:
        breaking = int(block.labels.any(axis=1).sum())
        if breaking:
            yield block
        count += breaking
        if count >= CHOICE * COLUMNS * ROWS:
            return


def _of_every_kind(kind: IntArray, count: int, rng: np.random.Generator) -> IntArray:
    """Choose up to ``count`` random rows, as evenly from all kinds as possible; returns their indices, rising."""
    order = rng.permutation(len(kind))
    rank = np.empty(len(kind), dtype=np.int64)
    for each in np.unique(kind):
        rows = np.flatnonzero(kind[order] == each)
        rank[rows] = np.arange(len(rows))
    return np.sort(order[np.argsort(rank, kind="stable")[:count]])


def view_frame(outward: FloatArray) -> FloatArray:
    """Choose from where a body is seen: from the side that was hit, a little from above and aside, with z up.

    Parameters
    ----------
    outward : ndarray of float64, shape (3,)
        Direction from the body to whatever hit it; any length, 0 for none.

    Returns
    -------
    ndarray of float64, shape (3, 3)
        Rows: unit vectors to the right, up, and towards the eye.
    """
    up = np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(outward)
    eye = outward / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    side = np.cross(up, eye)
    side = side / np.linalg.norm(side) if np.linalg.norm(side) > 0.2 else np.array([1.0, 0.0, 0.0])
    eye = eye + 0.5 * side + 0.35 * up
    eye /= np.linalg.norm(eye)
    right = np.cross(up, eye)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 0.05 else side
    return np.stack([right, np.cross(eye, right), eye])


def draw_mesh(axis: Any, vertices: FloatArray, faces: IntArray, colours: FloatArray, frame: FloatArray) -> None:
    """Draw a closed mesh with one colour for each face, shaded by a light.

    Parameters
    ----------
    axis : matplotlib.axes.Axes
        Where it is drawn; its limits are set to the mesh.
    vertices : ndarray of float64, shape (V, 3)
        Positions.
    faces : ndarray of int64, shape (F, 3)
        Vertices of the triangles, anticlockwise seen from outside.
    colours : ndarray of float64, shape (F, 3) or (F, 4)
        Colours from 0 to 1; transparency is ignored.
    frame : ndarray of float64, shape (3, 3)
        What ``view_frame`` returns.
    """
    corner = (vertices @ frame.T)[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
    seen = np.flatnonzero(normal[:, 2] > 0)  # faces that look towards the eye
    seen = seen[np.argsort(corner[seen, :, 2].mean(axis=1))]  # far faces first, so that near ones cover them
    shade = AMBIENT + (1 - AMBIENT) * np.clip(normal[seen] @ LIGHT, 0, 1)
    colour = np.concatenate([colours[seen, :3] * shade[:, None], np.ones((len(seen), 1))], axis=1)
    axis.add_collection(
        PolyCollection(list(corner[seen][:, :, :2]), facecolors=colour, edgecolors=colour, linewidths=0.3)
    )
    margin = 0.15 * np.ptp(vertices, axis=0).max()
    low, high = corner[..., :2].min(axis=(0, 1)) - margin, corner[..., :2].max(axis=(0, 1)) + margin
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")


def _draw_arrows(axis: Any, contacts: FloatArray, directions: FloatArray, frame: FloatArray) -> None:
    """Draw impulses as arrows that end at their contacts (N, 3)."""
    tip = contacts @ frame[:2].T
    tail = (contacts - 0.2 * directions) @ frame[:2].T
    for start, end in zip(tail, tip, strict=True):
        axis.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "red", "lw": 1.5}, zorder=5)
    axis.plot(*tip.T, "o", color="red", ms=3, zorder=6)
