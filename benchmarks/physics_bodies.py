"""The textbook specimens of ``physics.py``: bodies, how they are held and loaded, and what theory says of them.

Lengths are in units of the largest extent L, stresses in units of Young's modulus, and loads in strength times L², so
that a load factor says how many times a nominal load of 1 is applied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import trimesh

from fracsim.common.arrays import BoolArray, FloatArray
from fracsim.common.material import PRESETS, Material
from fracsim.geometry.locate import closest_on_triangles
from fracsim.simulators.lattice import Lattice
from fracsim.simulators.lattice_faces import cell_faces
from fracsim.simulators.lattice_options import LatticeOptions, material_options
from fracsim.solids.solid import Solid, relabel
from fracsim.solids.surface import Surface, read_surface
from fracsim.solids.voronoi import centroidal_seeds, solid_of_seeds, voronoi_solid

MESHES = Path(__file__).parent.parent / "meshes"
SLOW = 0.01  # the speed number of static loads: so slow that inertia only keeps a balanced body in place


def options_of(material: Material, size: float) -> LatticeOptions:
    """Work out the simulators' options of a body of a material, its largest extent in m."""
    return LatticeOptions(**material_options(material, size))


CERAMIC = options_of(PRESETS["ceramic"], 0.3)
GLASS = options_of(PRESETS["glass"], 0.3)
ALUMINA = options_of(
    Material("alumina", 3900.0, 210e6, 2500e6, 1e4, 26.8, youngs_modulus=335e9, poisson_ratio=0.25), 0.02
)
EGG_SIZE = 0.057  # m
EGG_MODULUS = 30e9  # Pa
EGG_MASS = 0.06  # kg, with what is in it
EGGSHELL = options_of(
    Material("eggshell", 2200.0, 20e6, 200e6, 3700.0, 3.0, youngs_modulus=EGG_MODULUS, poisson_ratio=0.3), EGG_SIZE
)


@dataclass(frozen=True, eq=False)
class Specimen:
    """A body in a testing machine.

    Attributes
    ----------
    surface : Surface
        Of the body.
    lattice : Lattice
        Of its N cells, with I faces between them. Cells in a clamp are joined to one rigid cell.
    forces : ndarray of float64, shape (6 N,)
        The load of factor 1 on the cells.
    options : LatticeOptions
        What follows from the material and the size.
    expected : float
        The factor at which theory breaks it; nan where theory says nothing of it.
    cracked : ndarray of bool, shape (I,)
        Faces that are broken before the load comes.
    point, direction : ndarray of float64, shape (3,)
        Where a striking load acts and whereto; the origin and zero for the others.
    """

    surface: Surface
    lattice: Lattice
    forces: FloatArray
    options: LatticeOptions
    expected: float
    cracked: BoolArray
    point: FloatArray
    direction: FloatArray

    @property
    def solid(self) -> Solid:
        """The cells."""
        return self.lattice.cells


Make = Callable[[int, int], Specimen]  # of a number of cells and a seed


def specimen(
    surface: Surface,
    lattice: Lattice,
    forces: FloatArray,
    options: LatticeOptions,
    expected: float,
    cracked: BoolArray | None = None,
    strike: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
) -> Specimen:
    """Put a specimen together; see its attributes."""
    point, direction = np.zeros((2, 3)) if strike is None else (np.asarray(part, dtype=float) for part in strike)
    if cracked is None:
        cracked = np.zeros(len(lattice.faces.areas), dtype=bool)
    return Specimen(surface, lattice, forces.ravel(), options, expected, cracked, point, direction)


def lattice_on(solid: Solid, speed_number: float = SLOW) -> Lattice:
    """Make the lattice of a solid."""
    return Lattice(solid, cell_faces(solid), speed_number)


def clamped(solid: Solid, chosen: BoolArray) -> tuple[Solid, int]:
    """Join cells (C,) in a clamp to one rigid cell; returns the solid and which cell that is."""
    label = np.where(chosen, 0, np.cumsum(~chosen))
    return relabel(solid, label), 0


# Loads


def on_surface(lattice: Lattice, points: FloatArray, force: npt.ArrayLike) -> FloatArray:
    """Spread a force (3,), or forces (n, 3), evenly over points (n, 3) on the outside: (N, 6) on the cells."""
    cells = lattice.cells
    outer = np.flatnonzero(cells.sides[:, 1] < 0)
    corner = cells.points[cells.triangles[outer]]
    _, square = closest_on_triangles(points[:, None], corner[None])
    owner = cells.sides[outer[np.argmin(square, axis=1)], 0]
    each = np.broadcast_to(np.asarray(force, dtype=float), points.shape) / len(points)
    result = np.zeros((len(lattice), 6))
    np.add.at(result[:, :3], owner, each)
    np.add.at(result[:, 3:], owner, np.cross(points - cells.centroids[owner], each))
    return result


def on_cells(
    lattice: Lattice, chosen: BoolArray, force: npt.ArrayLike, moment: npt.ArrayLike, about: npt.ArrayLike
) -> FloatArray:
    """Grip cells (N,) with a force and a moment about a point: (N, 6), each cell by its volume."""
    centroids, volume = lattice.cells.centroids, np.where(chosen, lattice.cells.volumes, 0.0)
    share = volume / volume.sum()
    result = np.zeros((len(lattice), 6))
    result[:, :3] = share[:, None] * np.asarray(force, dtype=float)
    got = np.cross(centroids - np.asarray(about, dtype=float), result[:, :3]).sum(axis=0)
    result[:, 3:] = share[:, None] * (np.asarray(moment, dtype=float) - got)
    return result


def balanced(lattice: Lattice, forces: FloatArray) -> FloatArray:
    """Add to forces (N, 6) what inertia does to a free body that moves as a rigid one."""
    motions = lattice.rigid_motions
    pull = motions.T @ forces.ravel()
    inertia = lattice.mass_matrix @ (motions @ np.linalg.solve(lattice.rigid_mass, pull))
    return np.asarray(forces - inertia.reshape(-1, 6))


def bending_moments(lattice: Lattice, forces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Integrate balanced forces (N, 6) along x: places (N,) and bending moments there (N, 2) about y and z."""
    centroids = lattice.cells.centroids
    order = np.argsort(centroids[:, 0])
    about_origin = forces[:, 3:] + np.cross(centroids, forces[:, :3])
    force, moment = np.cumsum(forces[order, :3], axis=0), np.cumsum(about_origin[order], axis=0)
    x = centroids[order, 0]
    x = np.append(0.5 * (x[1:] + x[:-1]), x[-1])
    section = np.column_stack([x, np.zeros((len(x), 2))])
    return x, (moment - np.cross(section, force))[:, 1:]


def strip(x: float, z: float, width: float, length: float = 0.03) -> FloatArray:
    """Points across a beam at x, on its side at height z, along ``length``."""
    along, across = np.linspace(-0.5, 0.5, 7) * length, (np.arange(6) + 0.5) / 6 - 0.5
    grid = np.stack(np.meshgrid(x + along, across * width, indexing="ij"), -1).reshape(-1, 2)
    return np.column_stack([grid, np.full(len(grid), z)])


# Bars and beams: 1 x 0.1 x 0.1 along x

SIDE = 0.1
MODULUS = SIDE**3 / 6  # of the section
DOWN = np.array([0.0, 0.0, -1.0])


def beam(cells: int, seed: int) -> tuple[Surface, Solid]:
    """Make a square beam of ceramic."""
    surface = read_surface(trimesh.creation.box((1.0, SIDE, SIDE)))
    return surface, voronoi_solid(surface, cells, np.random.default_rng(seed))


def tension(cells: int, seed: int) -> Specimen:
    """A bar that is pulled apart by grips on its outer eighths. Theory: force = strength times area."""
    surface, solid = beam(cells, seed)
    lattice = lattice_on(solid)
    x = solid.centroids[:, 0]
    forces = sum(on_cells(lattice, side * x > 0.375, [side, 0, 0], np.zeros(3), np.zeros(3)) for side in (-1.0, 1.0))
    return specimen(surface, lattice, np.asarray(forces), CERAMIC, SIDE**2)


def cantilever(cells: int, seed: int) -> Specimen:
    """A beam that is clamped over a tenth of its length and pushed down at its end."""
    surface, solid = beam(cells, seed)
    clamp, end = -0.4, 0.45
    solid, held = clamped(solid, solid.centroids[:, 0] < clamp)
    lattice = lattice_on(solid)
    chosen = np.arange(len(lattice)) == held
    reach = np.array([end, 0.0, SIDE / 2]) - solid.centroids[held]
    forces = on_surface(lattice, strip(end, SIDE / 2, SIDE), DOWN)
    forces += on_cells(lattice, chosen, -DOWN, -np.cross(reach, DOWN), solid.centroids[held])
    # The outermost face of the clamp decides where it ends.
    faces = lattice.faces
    root = faces.centroids[(faces.pairs == held).any(axis=1), 0].mean()
    return specimen(surface, lattice, forces, CERAMIC, MODULUS / (end - float(root)))


def bent(inner: float) -> Make:
    """A beam on two supports at 0.05 from its ends, pushed down at two places ``inner`` apart, or at one."""

    def make(cells: int, seed: int) -> Specimen:
        surface, solid = beam(cells, seed)
        lattice = lattice_on(solid)
        half = SIDE / 2
        forces = sum(0.5 * on_surface(lattice, strip(side * 0.45, -half, SIDE), -DOWN) for side in (-1, 1))
        forces += sum(0.5 * on_surface(lattice, strip(side * inner / 2, half, SIDE), DOWN) for side in (-1, 1))
        # Spread over a length w, one force bends by w/8 less.
        arm = 0.45 - inner / 2 if inner else 0.45 - 0.03 / 4
        return specimen(surface, lattice, np.asarray(forces), CERAMIC, MODULUS / (0.5 * arm))

    return make


ROD_SPEED = 0.03  # the speed number of a hit that is slow against the rod's bending, as theory has it


def rod(place: float) -> Make:
    """The rod of the example meshes, flying free, hit square to its axis at a share of its length from its middle.

    Theory: the moment of the force against the inertia of a rigid rod (middle: F L / 8; end: 4/27 F L at a third).
    """

    def make(cells: int, seed: int) -> Specimen:
        mesh = trimesh.load_mesh(MESHES / "rod.obj", process=False)
        turned = trimesh.Trimesh(mesh.vertices[:, [2, 0, 1]], mesh.faces, process=False)
        surface = read_surface(turned)
        solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
        lattice = lattice_on(solid, ROD_SPEED)
        radius = 0.5 * surface.trimesh.extents[2]
        point = np.array([place, 0.0, radius])
        cell = owner(solid, point)
        forces = lattice.force(cell, point, DOWN).reshape(-1, 6)
        _, moments = bending_moments(lattice, balanced(lattice, forces))
        # A regular polygon of 12 corners: its second moment over the mean distance of its outermost fibre.
        sides = 12
        area, edge = sides / 2 * radius**2 * np.sin(2 * np.pi / sides), 2 * radius * np.sin(np.pi / sides)
        second = area * (6 * radius**2 - edge**2) / 24
        modulus = second / (radius * 0.5 * (1 + np.cos(np.pi / sides)))
        expected = float(modulus / np.linalg.norm(moments, axis=1).max())
        return specimen(surface, lattice, forces, CERAMIC, expected, strike=(point, DOWN))

    return make


def owner(solid: Solid, point: FloatArray) -> int:
    """Find the cell at a point of the outside."""
    outer = np.flatnonzero(solid.sides[:, 1] < 0)
    _, square = closest_on_triangles(point[None], solid.points[solid.triangles[outer]])
    return int(solid.sides[outer[np.argmin(square)], 0])


def pure_bending(cells: int, seed: int) -> Specimen:
    """A thin rod bent by moments on its ends. Theory: moment = strength times section modulus."""
    side = 0.02
    surface = read_surface(trimesh.creation.box((1.0, side, side)))
    solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
    lattice = lattice_on(solid)
    x = solid.centroids[:, 0]
    forces = sum(
        on_cells(lattice, edge * x > 0.45, np.zeros(3), [0, edge, 0], [edge * 0.5, 0, 0]) for edge in (-1.0, 1.0)
    )
    return specimen(surface, lattice, np.asarray(forces), CERAMIC, side**3 / 6)


# The notched strip: 20 x 6 mm, 1 mm thick, of alumina

STRIP = (1.0, 0.3, 0.05)


def edge_factor(share: float) -> float:
    """Y of K = Y stress sqrt(pi a) for an edge crack of a/W in tension (Brown and Srawley 1966)."""
    return float(np.polyval([30.39, -21.72, 10.55, -0.231, 1.12], share))


def notched(depth: float) -> Make:
    """The strip with an edge crack, of a depth in mm, in tension; cells are finer around its tip.

    The crack is a set of faces, so its depth is not quite the one asked for; theory is corrected by the edge factor
    and the square root of the depths' ratio.
    """
    wanted = depth / 20.0
    stress = {0.1: 149.9, 0.5: 64.2, 1.0: 41.2}[depth] / 210.0

    def make(cells: int, seed: int) -> Specimen:
        rng = np.random.default_rng(seed)
        surface = read_surface(trimesh.creation.box(STRIP))
        tip = np.array([0.0, wanted - STRIP[1] / 2])
        finest = wanted / 2.2
        wide = np.sqrt(STRIP[0] * STRIP[1] / cells)

        def size(points: FloatArray) -> FloatArray:
            """Give the cells' width: finest at the tip and along the crack, growing away from it."""
            nearest = np.column_stack([np.zeros(len(points)), np.minimum(points[:, 1], tip[1])])
            return np.minimum(finest + 0.3 * np.linalg.norm(points[:, :2] - nearest, axis=1), 2.0 * wide)

        # Samples as dense as the cells, by rejection; then Lloyd's iteration in the strip's plane.
        cloud = []
        while sum(map(len, cloud)) < 60 * cells:
            points = (rng.random((200_000, 3)) - 0.5) * STRIP
            cloud.append(points[rng.random(len(points)) < (finest / size(points)) ** 2])
        inside = np.concatenate(cloud)[: 60 * cells] * [1, 1, 0]
        begin = inside[rng.choice(len(inside), cells, replace=False)]
        weights = size(inside) ** -2.0  # beside the samples' own density: together size to the -4
        seeds = centroidal_seeds(begin, inside, weights)
        # A pair of rows of seeds on either side of the crack's plane, so that faces lie near it.
        solid = solid_of_seeds(surface, seeds, inside, rng)
        lattice = lattice_on(solid)
        faces = lattice.faces
        across = np.sign(solid.centroids[faces.pairs, 0])
        cracked = (across[:, 0] != across[:, 1]) & (faces.centroids[:, 1] < tip[1])
        corner = faces.corners + faces.centroids[:, None]
        got = float(corner[cracked, :, 1].max(initial=-STRIP[1] / 2) + STRIP[1] / 2)
        x = solid.centroids[:, 0]
        forces = sum(on_cells(lattice, side * x > 0.4, [side, 0, 0], np.zeros(3), np.zeros(3)) for side in (-1.0, 1.0))
        ratio = edge_factor(wanted / STRIP[1]) / edge_factor(got / STRIP[1]) * np.sqrt(wanted / max(got, 1e-9))
        expected = stress * ratio * STRIP[1] * STRIP[2]
        return specimen(surface, lattice, np.asarray(forces), ALUMINA, float(expected), cracked)

    return make


# Disc and ring, loaded along a diameter

ARC = 5.0  # degrees on either side of the diameter that a load is spread over


def arc(radius: float, width: float, angle: float) -> FloatArray:
    """Points on a cylinder about z around an angle in degrees."""
    angles = np.radians(angle + np.linspace(-ARC, ARC, 9))
    heights = ((np.arange(5) + 0.5) / 5 - 0.5) * width
    angle_of, z = (part.ravel() for part in np.meshgrid(angles, heights, indexing="ij"))
    return np.column_stack([radius * np.cos(angle_of), radius * np.sin(angle_of), z])


def disc(cells: int, seed: int) -> Specimen:
    """The Brazilian disc, pressed by two contacts. Theory: tension 2 P / (pi D t) across the diameter.

    The contacts are the simulators' own, as wide as 0.08 of the diameter; a real test's jaws are nearly so.
    """
    width = 0.1
    surface = read_surface(trimesh.creation.cylinder(0.5, width, sections=72))
    solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
    lattice = lattice_on(solid)
    forces = np.zeros(6 * len(lattice))
    for side in (-1.0, 1.0):
        point = np.array([side * 0.5, 0.0, 0.0])
        forces += lattice.force(owner(solid, point), point, -2.0 * point)
    return specimen(surface, lattice, forces, CERAMIC, float(np.pi * width / 2))


def ring(cells: int, seed: int) -> Specimen:
    """A ring, pressed by two arcs. Theory: a curved beam of moment P R / pi (1 - e / R) under the load.

    Timoshenko, *Strength of Materials II*, section 80.
    """
    inner, outer, width = 0.4, 0.5, 0.1
    surface = read_surface(trimesh.creation.annulus(inner, outer, width, sections=72))
    solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
    middle, neutral = (inner + outer) / 2, (outer - inner) / np.log(outer / inner)
    gap = middle - neutral
    stress = (middle - gap) / np.pi * (neutral - inner) / ((outer - inner) * width * gap * inner)
    # The moment's peak under the load is rounded off by the arc: P a / 4 for a force spread over 2 a.
    stress *= 1 - outer * np.radians(ARC) / 4 * np.pi / middle
    lattice = lattice_on(solid)
    forces = np.zeros((len(lattice), 6))
    for angle in (0.0, 180.0):
        points = arc(outer, width, angle)
        inward = -points * [1, 1, 0] / outer
        forces += on_surface(lattice, points, inward / abs(inward[:, 0].mean()))
    return specimen(surface, lattice, forces, CERAMIC, float(1 / stress))


# Plates and shells that are hit


PLATE_SPEED = 0.065  # the speed number of such a plate's falls onto what is hard, as ``lattice_of`` finds it
FRAME = 10.0  # times the plate's mass: that of the frame a plate is clamped in


class FramedLattice(Lattice):
    """A lattice whose cell 0 is a heavy frame."""

    @cached_property
    def mass_matrix(self) -> sp.csc_matrix:
        """(6 N, 6 N), the frame made FRAME times as heavy as the body."""
        mass = super().mass_matrix.tolil()
        mass[:6, :6] *= FRAME * self.cells.volumes.sum() / self.cells.volumes[0]
        return sp.csc_matrix(mass)


def plate(held: bool, thickness: float = 0.0133) -> Make:
    """A square glass plate, 4 mm of 0.3 m, hit in its centre, free or clamped in a heavy rigid frame of 0.05."""

    def make(cells: int, seed: int) -> Specimen:
        surface = read_surface(trimesh.creation.box((1.0, 1.0, thickness)))
        solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
        point = np.array([0.0, 0.0, thickness / 2])
        if held:
            solid, _ = clamped(solid, np.abs(solid.centroids[:, :2]).max(axis=1) > 0.45)
            lattice: Lattice = FramedLattice(solid, cell_faces(solid), PLATE_SPEED)
        else:
            lattice = lattice_on(solid, PLATE_SPEED)
        forces = lattice.force(owner(solid, point), point, DOWN)
        return specimen(surface, lattice, forces, GLASS, np.nan, strike=(point, DOWN))

    return make


EGG_SPEED = 0.14  # the speed number of the shell's falls onto what is hard, with the mass of the egg's inside
EGG_WIDTH, EGG_WALL = 0.77, 0.0065  # in units of the length: 44 mm and 0.37 mm


def egg(cells: int, seed: int) -> Specimen:
    """A closed thin shell, 57 mm by 44 mm, wall 0.37 mm, pressed on the ground upright."""
    ball = trimesh.creation.icosphere(4)
    scale = 0.5 * np.array([EGG_WIDTH, EGG_WIDTH, 1.0])
    vertices = np.vstack([ball.vertices * scale, ball.vertices * (scale - EGG_WALL)])
    faces = np.vstack([ball.faces, ball.faces[:, ::-1] + len(ball.vertices)])
    surface = Surface(vertices, faces.astype(np.int64), EGG_SIZE, np.zeros(3), "egg")
    solid = voronoi_solid(surface, cells, np.random.default_rng(seed))
    lattice = lattice_on(solid, EGG_SPEED)
    point, up = np.array([0.0, 0.0, -0.5]), -DOWN
    forces = lattice.force(owner(solid, point), point, up)
    return specimen(surface, lattice, forces, EGGSHELL, np.nan, strike=(point, up))
