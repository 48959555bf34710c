"""A fracture simulator for users: a mesh, a material and impulses in SI units go in, and pieces in SI units come out.

``fracsim.Simulator`` is the ground truth itself, offline: what datasets are drawn from and assets learn. The other
rooms ask simulators directly, in units of the body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError
from ..common.impulse import Impulse, as_impulses
from ..common.material import Material, as_material
from ..common.progress import Stages
from ..fracture.severity import MassProperties, SeverityScale
from ..geometry.complex import mass_of_moments
from ..geometry.locate import closest_on_surface
from ..geometry.sampling import CONE, SurfacePoints, cone, ratios
from ..solids.surface import Surface, read_surface, refine
from . import SIMULATORS
from .base import ContactCompliance, FractureSimulator, Impacts, interfaces_between
from .capabilities import reference_factors, severity_kind_of
from .diffusion import GAUGE
from .registry import SimulatorOptions, make_simulator, options_for_body
from .simulated_fracture import SimulatedFracture

if TYPE_CHECKING:
    import trimesh

STEPS = 20  # of the search for the factor on impulses that act together; three are mostly enough
AGREEMENT = 1e-4  # relative, to which that factor is found


class Simulator:
    """A body of some shape and material that a registered simulator breaks.

    Parameters
    ----------
    source : path, trimesh.Trimesh or Surface
        A watertight mesh of one component, in m. Edges longer than 0.08 of the size are split first, as when baking; a
        ``solids.surface.Surface`` is taken as it is.
    simulator : str
        A registered simulator: "structural", "sequential", "modal", "elastic", "radial", or one of your own.
    material : str or Material
        What it is made of.
    seed : int
        Places the cells. The same seed gives the same simulator, of those that repeat themselves.
    progress : bool
        Whether to show a bar for each stage, on standard error.
    **options
        Of the simulator, such as ``cells``. Those that are not given follow from the material and the size where the
        simulator depends on them, or keep their defaults.

    Attributes
    ----------
    surface : Surface
        Its surface, with V vertices and F faces, of largest extent 1.
    material : Material
        Its material.
    options : SimulatorOptions
        What the simulator was built with.
    seed : int
        As given.
    simulator : FractureSimulator
        The simulator itself, which speaks of severities and of lengths in units of the largest extent.

    Raises
    ------
    MeshError
        If the mesh is missing, unreadable, or not watertight.
    BakeError
        If no simulator has that name, it has no such option, or it cannot work with the body.
    MaterialError
        If there is no such material.

    Examples
    --------
    >>> import fracsim, trimesh
    >>> rod = trimesh.creation.cylinder(radius=0.01, height=0.2, sections=16)
    >>> simulator = fracsim.Simulator(rod, "modal", material="ceramic", cells=400, modes=3)
    >>> impulse = fracsim.Impulse(point=(0.01, 0.0, 0.0), direction=(-1.0, 0.0, 0.0), magnitude=1.0)
    >>> critical = impulse.times(simulator.critical_factor(impulse))
    >>> len(simulator.fracture(critical.times(0.9)).masses), len(simulator.fracture(critical.times(1.1)).masses)
    (1, 2)
    """

    def __init__(
        self,
        source: str | Path | trimesh.Trimesh | Surface,
        simulator: str = "structural",
        material: str | Material = "ceramic",
        seed: int = 0,
        progress: bool = False,
        **options: Any,
    ) -> None:
        self.material = as_material(material)
        self.surface = source if isinstance(source, Surface) else refine(read_surface(source))
        self.options: SimulatorOptions = options_for_body(simulator, self.material, self.surface.scale, **options)
        self.seed = seed
        with Stages(progress) as stage:
            self.simulator: FractureSimulator = make_simulator(self.surface, self.options, seed, stage)

    @classmethod
    def of_bake(
        cls,
        vertices: FloatArray,
        faces: IntArray,
        scale: float,
        offset: FloatArray,
        name: str,
        material: Material,
        metadata: Mapping[str, Any],
    ) -> Self:
        """Make the simulator again that an asset was baked from; ``BreakableAsset.simulator`` calls it.

        Parameters
        ----------
        vertices, faces, scale, offset, name
            As of ``solids.surface.Surface``: the asset's own surface.
        material : Material
            The asset's.
        metadata : mapping
            The asset's. It holds the seed and the options, what followed from the material of the bake included.

        Returns
        -------
        Simulator
            It answers with the same bits, of simulators that repeat themselves.

        Raises
        ------
        BakeError
            If the simulator has no registered name here, or the asset does not say what it was.
        """
        simulator = metadata.get("simulator")
        if simulator not in SIMULATORS:
            raise BakeError(
                f"{name}: was baked from a simulator that is not registered here ({simulator}); register it first"
            )
        options = metadata.get("simulator_options")
        if options is None:  # of a bake before they were kept: those that any simulator has
            kept = metadata.get("options", {})
            names = ("cells", "modes", "min_piece_volume_fraction")
            if not {*names} <= set(kept):
                raise BakeError(f"{name}: does not say how its simulator was made; bake it again")
            options = {option: kept[option] for option in names} | kept.get("simulator_settings", {})
        values = {option: value for option, value in options.items() if option != "name"}
        surface = Surface(vertices, faces, scale, offset, name)
        return cls(surface, simulator, material, int(metadata.get("seed", 0)), **values)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.surface.name!r}, {self.options.name!r}, material={self.material.name!r}, "
            f"seed={self.seed})"
        )

    # The body

    @property
    def size(self) -> float:
        """m, its largest extent."""
        return self.surface.scale

    @cached_property
    def vertices(self) -> FloatArray:
        """(V, 3) m, of its surface, where the mesh has them."""
        return np.asarray(self.surface.vertices * self.surface.scale + self.surface.offset)

    @property
    def faces(self) -> IntArray:
        """(F, 3) indices of vertices, outward."""
        return self.surface.faces

    @property
    def mass(self) -> float:
        """Mass, kg."""
        return self._body.mass

    @property
    def center_of_mass(self) -> FloatArray:
        """(3,) m."""
        return self._body.center

    @cached_property
    def _body(self) -> MassProperties:
        """How it resists impulses."""
        zeroth, first, second = (moment.sum(axis=0) for moment in self.simulator.cells.moments())
        placed = self.material.density, self.size, self.surface.offset
        properties = mass_of_moments(float(zeroth), first, second, *placed)
        return MassProperties(*properties[1:])

    @cached_property
    def _severity(self) -> SeverityScale:
        """What turns impulses into severities."""
        shape: FloatArray = np.zeros(len(self.surface.vertices))
        if isinstance(self.simulator, ContactCompliance):
            shape = self.simulator.compliance
        return SeverityScale.of(severity_kind_of(self.simulator), GAUGE, shape, self.material, self.size, self.mass)

    @cached_property
    def _points(self) -> SurfacePoints:
        return SurfacePoints(self.surface.vertices, self.surface.faces)

    # Breaking it

    def impacts(self, impulses: Impulse | Sequence[Impulse]) -> Impacts:
        """Bring impulses to the surface and to severities.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in its own frame (m, N·s). The nearest point of the surface counts.

        Returns
        -------
        Impacts
            One impact, as the simulator takes it.

        Raises
        ------
        ImpulseError
            If no impulse is given.
        """
        together = as_impulses(impulses)
        where = np.array([impulse.point for impulse in together])
        local = (where - self.surface.offset) / self.size
        face, barycentric = closest_on_surface(local, self.surface.vertices, self.faces)
        points = self._points.at(face, barycentric) * self.size + self.surface.offset
        severities = self._severity.severities(together, self.faces[face], barycentric, points, self._body)
        directions = np.array([impulse.direction for impulse in together])
        return Impacts(face[None], barycentric[None], directions[None], severities[None])

    def fracture(self, impulses: Impulse | Sequence[Impulse]) -> SimulatedFracture:
        """Break the whole body.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in its own frame (m, N·s).

        Returns
        -------
        SimulatedFracture
            The pieces; a single one where nothing breaks.

        Raises
        ------
        ImpulseError
            If no impulse is given.
        """
        together = as_impulses(impulses)
        impacts, cells = self.impacts(together), self.simulator.cells
        labels = np.zeros(len(cells.volumes), dtype=np.int64)
        if impacts.severities.any():
            labels = self.simulator.fracture(impacts).labels[0]
        interfaces = interfaces_between(cells)
        cracks = labels[interfaces.pairs[:, 0]] != labels[interfaces.pairs[:, 1]]
        volumes = cells.volumes * self.size**3
        return SimulatedFracture(
            labels=labels[cells.vertex_cells(len(self.surface.vertices))],
            cell_labels=labels,
            volumes_of=volumes,
            masses=np.asarray(np.bincount(labels, volumes) * self.material.density, dtype=np.float64),
            broken_area=float(interfaces.projected[cracks].sum()) * self.size**2,
            critical_factor=self.critical_factor(together),
            severity=float(impacts.severities.sum()),
            cells=cells,
            scale=self.size,
            offset=self.surface.offset,
        )

    def critical_factor(self, impulses: Impulse | Sequence[Impulse]) -> float:
        """Find how many times stronger impulses must be to break the body.

        Parameters
        ----------
        impulses : Impulse or sequence of Impulse
            What acts on it together, in its own frame (m, N·s).

        Returns
        -------
        float
            The least factor on all magnitudes at which the body comes apart; infinite where none does.

        Raises
        ------
        ImpulseError
            If no impulse is given.

        Notes
        -----
        The force of an impulse of unknown duration grows with its 6/5th power or less, so the factor on severities is
        put through the contact law. Of several impulses each asks for its own factor; their mean, by severity, is
        taken, and the search goes on from there.
        """
        together = as_impulses(impulses)
        factor = 1.0
        for _ in range(STEPS):
            impacts = self.impacts([impulse.times(factor) for impulse in together])
            if not impacts.severities.any():
                return np.inf
            severer = float(self.simulator.thresholds(impacts)[0])
            if not np.isfinite(severer):
                return np.inf
            step = self._factor_on_impulses(together, factor, impacts, severer)
            factor *= step
            if abs(step - 1.0) < AGREEMENT or len(together) == 1:
                break
        return factor

    def _factor_on_impulses(
        self, impulses: Sequence[Impulse], factor: float, impacts: Impacts, severer: float
    ) -> float:
        """Turn a factor on severities into one on impulses, which are ``factor`` times the ones given."""
        face, barycentric, directions, severities = (part[0] for part in vars(impacts).values())
        points = self._points.at(face, barycentric) * self.size + self.surface.offset
        magnitudes = np.array([impulse.magnitude for impulse in impulses]) * factor
        wanted = self._severity.magnitudes(
            severer * severities, self.faces[face], barycentric, points, directions, self._body
        )
        lasting = np.array([impulse.duration is not None for impulse in impulses])
        counts = severities > 0.0
        each = np.full(len(impulses), severer)  # in proportion, where the duration is known
        by_law = counts & ~lasting
        each[by_law] = wanted[by_law] / magnitudes[by_law]
        return float(np.exp(np.average(np.log(each), weights=severities)))

    def sample_impulses(self, count: int, seed: int | np.random.Generator) -> list[Impulse]:
        """Draw single impulses that break it about as often as not.

        Points are uniform over the area and directions lie in a cone about the inward normal. Severities are 0.3 to 5
        times what breaks the body there, or opens a first crack where the simulator finds that sooner.

        Parameters
        ----------
        count : int
            How many, at least 1.
        seed : int or numpy.random.Generator
            Where randomness comes from.

        Returns
        -------
        list of Impulse
            In its own frame (m, N·s).

        Raises
        ------
        BakeError
            If the count is below 1.
        """
        if count < 1:
            raise BakeError(f"a count of impulses must be at least 1, got {count}")
        rng = np.random.default_rng(seed)
        face, barycentric = self._points.draw(count, rng)
        directions = cone(-self._points.normals[face], CONE, rng)
        ratio = ratios(count, rng)
        unit = Impacts(face[:, None], barycentric[:, None], directions[:, None], np.ones((count, 1)))
        severities = ratio * reference_factors(self.simulator, unit)
        points = self._points.at(face, barycentric) * self.size + self.surface.offset
        magnitudes = self._severity.magnitudes(
            severities, self.faces[face], barycentric, points, directions, self._body
        )
        return [Impulse(*impact) for impact in zip(points, directions, magnitudes.tolist(), strict=True)]

    def describe(self) -> dict[str, Any]:
        """Say what it was made from, so that it can be made again.

        Returns
        -------
        dict
            Plain data: the mesh's name, size, material, seed, and the simulator's options.
        """
        return {
            "mesh": self.surface.name,
            "size": self.size,
            "material": self.material.to_dict(),
            "seed": self.seed,
            "options": asdict(self.options),
        }
