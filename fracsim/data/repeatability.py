"""How well a simulator agrees with itself when an impact is moved a little, or the body is cut another way.

It is a figure of the simulator: nothing that learns from it can be asked to do better. ``writing`` puts it into the
header of every dataset, and baking into the metadata of every asset. Offline only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import MissingExtraError
from ..geometry.frames import tangent_basis
from ..geometry.locate import closest_on_surface
from ..geometry.sampling import CONE, SEVERITY, SurfacePoints, cone
from ..metrics import ari, volume_ari
from ..simulators import simulator_class
from ..simulators.base import FractureSimulator, Impacts, Progress, no_progress
from ..simulators.capabilities import reference_factors
from ..simulators.registry import SimulatorOptions, make_simulator
from ..solids.interior import sample_interior
from ..solids.surface import Surface
from .samples import checked
from .workers import run_blocks

try:
    from threadpoolctl import threadpool_limits
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error

SHIFTS = (0.01, 0.03)  # of the largest extent that an impact is moved by; it is turned by as many radians
IMPACTS = 40  # that are moved
GROUP = 10  # impacts that are drawn together
POINTS = 4000  # inside the body, at which two tilings of it are compared


@dataclass(frozen=True, eq=False)
class _Pair:
    """A simulator, and the same of another tiling.

    Attributes
    ----------
    simulator : FractureSimulator
        Of C cells.
    other : FractureSimulator or None
        Of other cells, of the same surface.
    cells, other_cells : ndarray of int64, shape (P,)
        The cell of either that each of P points inside the body lies in.
    volumes : ndarray of float64, shape (P,)
        What each point stands for.
    """

    simulator: FractureSimulator
    other: FractureSimulator | None
    cells: IntArray
    other_cells: IntArray
    volumes: FloatArray

    @classmethod
    def of(cls, simulator: FractureSimulator, other: FractureSimulator | None, rng: np.random.Generator) -> _Pair:
        if other is None:
            return cls(simulator, None, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
        points, volumes = sample_interior(simulator.surface, POINTS, rng)
        cells, other_cells = simulator.cells.cells_at(points), other.cells.cells_at(points)
        inside = (cells >= 0) & (other_cells >= 0)  # but for rounding, all of them
        return cls(simulator, other, cells[inside], other_cells[inside], volumes[inside])


@dataclass(frozen=True, eq=False)
class _Group:
    """What GROUP impacts say.

    Attributes
    ----------
    breaks : ndarray of bool, shape (N,)
        Which break the body.
    moved : ndarray of float64, shape (N, len(SHIFTS), 2)
        ARI at the vertices and by volume, between an impact and the same moved by each shift.
    tilings : ndarray of float64, shape (N, 2)
        The same between two tilings; not a number where there is only one.
    shares : ndarray of float64, shape (N, 2)
        The share of the body that its largest piece has, in either tiling.
    """

    breaks: BoolArray
    moved: FloatArray
    tilings: FloatArray
    shares: FloatArray


def repeatability(
    simulator: FractureSimulator,
    seed: int = 0,
    other: FractureSimulator | None = None,
    count: int = IMPACTS,
    workers: int = 1,
    backend: str = "joblib",
    progress: Progress = no_progress,
) -> dict[str, float]:
    """Measure how well a simulator repeats itself.

    Single impacts are drawn as samples are, but 1 to 5 times as severe as it takes, and those that break the body
    count. Each is asked again, as severe, after its point has moved by 1 % and by 3 % of the size in a random direction
    along the surface and its direction has turned by as much, in radians.

    Parameters
    ----------
    simulator : FractureSimulator
        The simulator.
    seed : int
        Of the impacts.
    other : FractureSimulator, optional
        The same of another seed, so that the same surface is cut into other cells.
    count : int
        Impacts, rounded up to whole groups of 10.
    workers, backend
        See ``workers.run_blocks``; they do not change the figures.
    progress : callable
        Hears the stage "repeatability" and the share of it that is done.

    Returns
    -------
    dict of str to float
        ``impacts``, how many of them broke the body, and means over these: ``ari_moved_1_percent`` at the vertices and
        ``volume_ari_moved_1_percent``, the same for 3 %; with another tiling ``ari_other_tiling``,
        ``volume_ari_other_tiling``, and ``largest_share_correlation``, Pearson's, of the largest pieces' shares of the
        volume. Means over no impact are left out, and so is the correlation of what does not vary.
    """
    pair = _Pair.of(simulator, other, np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,))))
    numbers = list(range(-(-count // GROUP)))
    groups = []
    for group in run_blocks(_measured, pair, seed, numbers, workers, backend):
        groups.append(group)
        progress("repeatability", len(groups) / len(numbers))
    breaks = np.concatenate([group.breaks for group in groups])
    figures: dict[str, float] = {"impacts": int(breaks.sum())}
    if not breaks.any():
        return figures
    moved, tilings, shares = (
        np.concatenate([getattr(group, name) for group in groups])[breaks] for name in ("moved", "tilings", "shares")
    )
    for k, shift in enumerate(SHIFTS):
        for kind, name in enumerate(("ari", "volume_ari")):
            figures[f"{name}_moved_{100 * shift:.0f}_percent"] = float(moved[:, k, kind].mean())
    if other is not None:
        figures["ari_other_tiling"], figures["volume_ari_other_tiling"] = tilings.mean(axis=0).tolist()
        if (np.ptp(shares, axis=0) > 0.0).all():
            figures["largest_share_correlation"] = float(np.corrcoef(shares.T)[0, 1])
    return figures


def repeatability_of(
    simulator: FractureSimulator,
    options: SimulatorOptions | None,
    seed: int,
    workers: int = 1,
    backend: str = "joblib",
    progress: Progress = no_progress,
) -> dict[str, float]:
    """Measure how well a simulator repeats itself, its tiling included where it can be built again.

    Parameters
    ----------
    simulator : FractureSimulator
        The simulator.
    options : SimulatorOptions or None
        What it was built from; None for one that is not registered.
    seed : int
        What it was built from. The other tiling has the next seed.
    workers, backend
        See ``workers.run_blocks``; they do not change the figures.
    progress : callable
        Hears the stage "repeatability" and the share of it that is done.

    Returns
    -------
    dict of str to float
        As of ``repeatability``.
    """
    progress("repeatability", 0.0)
    other = None
    if options is not None and simulator_class(options.name).repeatable:
        other = make_simulator(simulator.surface, options, seed + 1)
    return repeatability(simulator, seed, other, IMPACTS, workers=workers, backend=backend, progress=progress)


def moved(surface: Surface, impacts: Impacts, shift: float, rng: np.random.Generator) -> Impacts:
    """Move single impacts along a surface, each in a random direction, and turn them.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    impacts : Impacts
        N impacts of one contact each.
    shift : float
        By how much, in units of the largest extent, before the point is brought back to the nearest one of the
        surface; and by how many radians.
    rng : numpy.random.Generator
        Where randomness comes from.

    Returns
    -------
    Impacts
        Of the same severities.
    """
    points = SurfacePoints(surface.vertices, surface.faces)
    face, direction = impacts.faces[:, 0], impacts.directions[:, 0]
    where = points.at(face, impacts.barycentric[:, 0]) + shift * _across(points.normals[face], rng)
    face, barycentric = closest_on_surface(where, surface.vertices, surface.faces)
    turned = np.cos(shift) * direction + np.sin(shift) * _across(direction, rng)
    return Impacts(face[:, None], barycentric[:, None], turned[:, None], impacts.severities)


def _across(axes: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw unit vectors (N, 3), each at right angles to an axis."""
    turn = rng.uniform(0.0, 2.0 * np.pi, len(axes))[:, None]
    first, second = tangent_basis(axes)
    return np.asarray(np.cos(turn) * first + np.sin(turn) * second)


def _measured(pair: _Pair, seed: int, group: int) -> _Group:
    """Draw a group of impacts, and compare what the simulators say of them."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2, group)))
    simulator, surface = pair.simulator, pair.simulator.surface
    points = SurfacePoints(surface.vertices, surface.faces)
    face, barycentric = points.draw(GROUP, rng)
    direction = cone(-points.normals[face], CONE, rng)
    impacts = Impacts(face[:, None], barycentric[:, None], direction[:, None], np.ones((GROUP, 1)))
    ratio = np.exp(rng.uniform(0.0, np.log(SEVERITY[1]), GROUP))
    with threadpool_limits(1):  # sums in one order, whatever the machine
        reference = reference_factors(simulator, impacts)
        impacts = impacts.times(ratio * reference)
        together = _joined([impacts, *(moved(surface, impacts, shift, rng) for shift in SHIFTS)])
        asked = checked(simulator, together, np.tile(reference, 1 + len(SHIFTS)), simulator.fracture(together))
        labels = asked.labels.reshape(1 + len(SHIFTS), GROUP, -1)
        others = None if pair.other is None else pair.other.fracture(impacts).labels
    count = len(surface.vertices)
    at_vertices = labels[:, :, simulator.cells.vertex_cells(count)]
    volumes = simulator.cells.volumes
    compared = np.array(
        [
            [(ari(at_vertices[0, n], row[n]), volume_ari(labels[0, n], whole[n], volumes)) for n in range(GROUP)]
            for row, whole in zip(at_vertices[1:], labels[1:], strict=True)
        ]
    ).swapaxes(0, 1)
    tilings, shares = np.full((GROUP, 2), np.nan), np.full((GROUP, 2), np.nan)
    if others is not None:
        assert pair.other is not None
        of_others = others[:, pair.other.cells.vertex_cells(count)]
        inside, other_inside = labels[0][:, pair.cells], others[:, pair.other_cells]
        for n in range(GROUP):
            by_volume = volume_ari(inside[n], other_inside[n], pair.volumes)
            tilings[n] = ari(at_vertices[0, n], of_others[n]), by_volume
            shares[n] = _largest(labels[0, n], volumes), _largest(others[n], pair.other.cells.volumes)
    return _Group(labels[0].any(axis=1), compared, tilings, shares)


def _joined(parts: list[Impacts]) -> Impacts:
    """Put impacts one after the other."""
    return Impacts(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def _largest(labels: IntArray, volumes: FloatArray) -> float:
    """Compute the largest piece's share of the volume."""
    return float(np.bincount(labels, volumes).max() / volumes.sum())
