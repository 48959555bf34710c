"""From a body's cells to its lattice, with the duration of the contacts that strike it. Offline only.

``structural`` and ``sequential`` build theirs here.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import FloatArray
from ..common.contact import ContactLaw
from ..solids.solid import Solid
from ..solids.surface import Surface
from .lattice import Lattice
from .lattice_faces import cell_faces
from .lattice_options import LatticeOptions

STILL = 0.02  # speed number of contacts so long that the body's own duration can be worked out with it
FALLS = 20  # over which that duration's median is taken


def vertex_compliances(surface: Surface, lattice: Lattice) -> FloatArray:
    """Compute how far each vertex of a body gives way to a unit force along its normal (``ContactCompliance``).

    Parameters
    ----------
    surface : Surface
        The body's, with V vertices.
    lattice : Lattice
        Of the body.

    Returns
    -------
    ndarray of float64, shape (V,)
        In 1 / (E L), without the motion of the body as a whole.
    """
    cells = lattice.cells.vertex_cells(len(surface.vertices))
    return lattice.compliances(cells, surface.vertices, -surface.trimesh.vertex_normals)


def lattice_of(surface: Surface, cells: Solid, options: LatticeOptions) -> Lattice:
    """Join the cells of a body with springs.

    Parameters
    ----------
    surface : Surface
        The body's.
    cells : Solid
        Of the body.
    options : LatticeOptions
        What follows from the material; where it does not give the speed number, that of the median contact over
        falls in random directions onto the lowest vertex is taken.

    Returns
    -------
    Lattice
        Of the body.
    """
    faces = cell_faces(cells)
    if options.speed_number > 0.0:
        return Lattice(cells, faces, options.speed_number)
    still = Lattice(cells, faces, STILL)
    up = np.random.default_rng(0).standard_normal((FALLS, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    lowest = np.argmin(up @ surface.vertices.T, axis=1)
    at = cells.vertex_cells(len(surface.vertices))[lowest]
    compliance = still.compliances(at, surface.vertices[lowest], up)
    ratios = []
    for k, vertex in enumerate(lowest.tolist()):
        mass = still.effective_mass(still.force(int(at[k]), surface.vertices[vertex], up[k]))
        law = ContactLaw(options.hertz, float(compliance[k]))
        # The pulse is half a swing of a mass on a spring: with pi / t for its frequency the peak force is m v pi / t.
        force = float(law.peak_force(0.5 * mass * options.approach_speed**2))
        ratios.append(force / (mass * options.approach_speed))
    return Lattice(cells, faces, float(np.median(ratios)))
