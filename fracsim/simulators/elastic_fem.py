"""TODO simulators.elastic_fem."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.linalg import qr
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError, MissingExtraError
from ..fracture.rule import Interfaces, effective_opening
from ..solids.lattice import FACETS
from ..solids.solid import Solid, sum_by_index
from ..solids.surface import Surface
from .diffusion import PATCH_RADIUS

try:
    from skfem import Basis, ElementTetP2, ElementVector, MeshTet
    from skfem.models.elasticity import lame_parameters, linear_elasticity
    from skfem.models.poisson import mass
except ImportError as error:
    raise MissingExtraError("scikit-fem", "elastic") from error


POISSON = 0.25  # of glass and ceramics
LAMBDA, MU = lame_parameters(1.0, POISSON)
ENVELOPE = 1e-3  # of the largest extent: how far the mesh's surface may stray from the body's
EDGE = 0.05  # of the largest extent: half a contact patch; thin walls get the smaller elements that they need
NEAREST = 16  # tetrahedra first searched for a point; more where none of them holds it
BLOCK = 256  # right-hand sides or points worked on at a time


# fTetWild talks through the standard output whatever it is told and leaves a file in the working directory, so it
# works in a process and a directory of its own.
_WILD = """
import sys
import numpy as np
import wildmeshing
given = np.load("surface.npz")
wild = wildmeshing.Tetrahedralizer(epsilon=float(given["epsilon"]), edge_length_r=float(given["edge"]), max_threads=1)
wild.set_log_level(6)
wild.set_mesh(given["vertices"], given["faces"])
wild.tetrahedralize()
points, tetrahedra = wild.get_tet_mesh()[:2]
np.savez("solid.npz", points=points, tetrahedra=tetrahedra)
"""


def mesh_edge(surface: Surface) -> float:
    """The length of tetrahedra that resolves a surface: EDGE, or half of its walls' mean chord 4 V/A if less."""
    mesh = surface.trimesh
    return min(EDGE, 2.0 * float(mesh.volume) / float(mesh.area))


def tetrahedralise(surface: Surface, edge: float | None = None) -> MeshTet:
    """Tetrahedra that fill a surface to within ENVELOPE, of about ``edge`` (Hu et al. 2020, fTetWild).

    edge: in units of the largest extent, by default ``mesh_edge``. fTetWild draws lots: the same surface gives a
    slightly different mesh each time. Raises MissingExtraError without wildmeshing, BakeError if it fails.
    """
    if importlib.util.find_spec("wildmeshing") is None:
        raise MissingExtraError("wildmeshing", "elastic")
    edge = mesh_edge(surface) if edge is None else edge
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))  # what fTetWild measures lengths in
    with tempfile.TemporaryDirectory() as folder:
        np.savez(
            Path(folder) / "surface.npz",
            vertices=surface.vertices,
            faces=surface.faces.astype(np.int32),
            epsilon=ENVELOPE / diagonal,
            edge=edge / diagonal,
        )
        run = subprocess.run([sys.executable, "-c", _WILD], cwd=folder, capture_output=True, text=True)
        if run.returncode != 0:
            raise BakeError(f"{surface.name}: fTetWild failed ({run.stderr.strip()[-200:] or run.returncode})")
        with np.load(Path(folder) / "solid.npz") as solid:
            points, tetrahedra = solid["points"].astype(np.float64), solid["tetrahedra"].astype(np.int64)
    if len(tetrahedra) == 0:
        raise BakeError(f"{surface.name}: no tetrahedron fits inside; check that its faces point outward")
    return _largest_part(points, tetrahedra)


def _largest_part(points: FloatArray, tetrahedra: IntArray) -> MeshTet:
    """The largest part that hangs together by faces: one that hangs by an edge is a hinge and has no stiffness."""
    facets = np.sort(tetrahedra[:, FACETS].reshape(-1, 3), axis=1)
    order = np.lexsort(facets.T)
    same = (facets[order][1:] == facets[order][:-1]).all(axis=1)
    left, right = order[:-1][same] // 4, order[1:][same] // 4
    count = len(tetrahedra)
    _, part = connected_components(sp.coo_matrix((np.ones(len(left)), (left, right)), shape=(count, count)))
    tetrahedra = tetrahedra[part == np.argmax(np.bincount(part))]
    used, tetrahedra = np.unique(tetrahedra, return_inverse=True)
    return MeshTet(points[used].T.copy(), tetrahedra.reshape(-1, 4).T.copy())


def locate(mesh: MeshTet, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """The tetrahedron (N,) that holds each point, and the point's coordinates in it (N, 3), in mesh.p's order.

    A point that the mesh leaves out, by no more than its envelope, is moved to the tetrahedron it is least
    outside of.
    """
    corners = mesh.p.T[mesh.t.T]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    tree = cKDTree(corners.mean(axis=1))
    tets = np.zeros(len(points), dtype=np.int64)
    local = np.zeros((len(points), 4))
    open_ = np.arange(len(points))
    nearest = min(NEAREST, len(corners))
    while len(open_):
        _, near = tree.query(points[open_], k=np.arange(1, nearest + 1))
        within = np.einsum("nkij,nkj->nki", inverse[near], points[open_, None] - corners[near, 0])
        within = np.concatenate([1.0 - within.sum(axis=2, keepdims=True), within], axis=2)
        best = np.argmax(within.min(axis=2), axis=1)
        rows = np.arange(len(open_))
        tets[open_], local[open_] = near[rows, best], within[rows, best]
        if nearest == len(corners) or nearest > 16 * NEAREST:
            break
        open_ = open_[local[open_].min(axis=1) < -1e-9]
        nearest = min(4 * nearest, len(corners))
    local = np.maximum(local, 0.0)
    return tets, (local / local.sum(axis=1, keepdims=True))[:, 1:]


class ElasticBody:
    """A free elastic body that answers, for an impact anywhere, with the tractions on its interfaces.

    Quadratic tetrahedra on ``mesh`` (made by fTetWild if not given): S nodes, D = 3 S unknowns, node by node. The
    three components of the traction on each of I interfaces are linear functionals of the displacement. Stiffness
    being symmetric, each is solved for once as if it were a load (Maxwell-Betti reciprocity), and then the
    answer to an impact in any place is a dot product.
    """

    def __init__(
        self,
        surface: Surface,
        parts: Solid,
        interfaces: Interfaces,
        mesh: MeshTet | None = None,
        edge: float | None = None,
    ) -> None:
        """surface: of largest extent 1. parts, interfaces: as of a ModalGenerator. mesh: of the same body, or else
        edge: see ``tetrahedralise``.

        Raises MissingExtraError without wildmeshing when a mesh has to be made, BakeError if the interfaces are
        not those between the parts.
        """
        self.interfaces = interfaces
        triangles, self._interface = _interface_triangles(parts, interfaces)
        self.mesh = tetrahedralise(surface, edge) if mesh is None else mesh
        basis = Basis(self.mesh, ElementVector(ElementTetP2()), intorder=4)
        scalar = basis.with_element(ElementTetP2())
        self.nodes: FloatArray = scalar.doflocs.T
        self._mass = sp.csr_matrix(mass.assemble(scalar))  # (S, S), of density 1
        stiffness = sp.csc_matrix(linear_elasticity(LAMBDA, MU).assemble(basis))
        self._rigid = rigid_motions(self.nodes)
        self._heavy = rowwise(self._mass, self._rigid)
        # Held at the six unknowns that pin the rigid motions best. Balanced loads leave no reaction there.
        _, _, pivots = qr(self._rigid.T, mode="economic", pivoting=True)
        self._free = np.setdiff1d(np.arange(basis.N), pivots[:6])
        self._factor = splu(
            stiffness[self._free][:, self._free],
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        self._triangle_tractions, self._mean = self._functionals(basis, parts.points[triangles])

    @cached_property
    def _answers(self) -> FloatArray:
        """(S, 9 I): at each node and for each direction, the displacement that answers for each traction."""
        functionals = sp.csr_matrix(self._mean @ self._triangle_tractions)
        answers = np.empty((3 * len(self.nodes), functionals.shape[0]))
        for start in range(0, answers.shape[1], BLOCK):
            block = slice(start, start + BLOCK)
            # Without momentum and angular momentum, so that the inertia that balances an impact does no work on
            # them and need not be worked out per impact.
            answers[:, block] = self._solve(functionals[block].toarray().T)
        return answers.reshape(len(self.nodes), -1)

    def patch(self, points: FloatArray) -> FloatArray:
        """(N, S) nodal forces of impacts of unit force at ``points`` (N, 3), in whatever direction.

        Each a Gaussian over the body of standard deviation PATCH_RADIUS, as in ``impact_field``, taken for a
        function of the finite elements.
        """
        result = np.empty((len(points), len(self.nodes)))
        for start in range(0, len(points), BLOCK):
            block = points[start : start + BLOCK]
            square = cdist(block, self.nodes, "sqeuclidean")
            shape = np.exp(-(square - square.min(axis=1, keepdims=True)) / (2 * PATCH_RADIUS**2))
            force = (self._mass @ shape.T).T
            result[start : start + BLOCK] = force / force.sum(axis=1, keepdims=True)
        return result

    def loads(self, points: FloatArray, directions: FloatArray) -> FloatArray:
        """(D, N) nodal forces of unit impacts at ``points`` (N, 3) along unit ``directions`` (N, 3), balanced.

        What balances them is -ρ(a + α×r), a and α being the linear and angular acceleration of the rigid body that
        the impact causes: no net force, no net torque.
        """
        impacts = np.einsum("ns,nk->skn", self.patch(points), directions).reshape(-1, len(points))
        return np.asarray(impacts - self._heavy @ np.linalg.solve(self._rigid.T @ self._heavy, self._rigid.T @ impacts))

    def displacements(self, points: FloatArray, directions: FloatArray) -> FloatArray:
        """(D, N) the elastic displacements under ``loads``, without any rigid motion."""
        return np.hstack(
            [
                self._solve(self.loads(points[start : start + BLOCK], directions[start : start + BLOCK]))
                for start in range(0, len(points), BLOCK)
            ]
        )

    def tractions_of(self, displacements: FloatArray) -> FloatArray:
        """(N, I, 3) the tractions σ̄ n under displacements (D, N); σ̄ is the stress's mean over the interface."""
        return np.asarray(self._mean @ (self._triangle_tractions @ displacements)).T.reshape(
            -1, len(self.interfaces), 3
        )

    def root_mean_square_drives(self, displacements: FloatArray) -> FloatArray:
        """(N, I) ``breaking.effective`` triangle by triangle and then the root mean square over each interface.

        Unlike the mean traction this sees bending, whose tension and compression cancel over a whole section.
        """
        normals = self.interfaces.normals[self._interface]
        result = np.empty((displacements.shape[1], len(self.interfaces)))
        for n, displacement in enumerate(displacements.T):
            tractions = np.asarray(self._triangle_tractions @ displacement).reshape(1, -1, 3)
            square = effective_opening(tractions, normals)[0] ** 2
            result[n] = np.sqrt(sum_by_index(self._interface, self._weight * square, len(self.interfaces)))
        return result

    def tractions(self, points: FloatArray) -> FloatArray:
        """(N, I, 3, 3) what turns the direction of a unit impact at each of ``points`` (N, 3) into tractions.

        ``tractions(x)[0] @ d`` (I, 3) is what the second part of each pair does to the first, per unit of area; its
        component along the interface's normal, which points from the first to the second, is positive in
        tension.
        """
        result = np.empty((len(points), 3, len(self.interfaces), 3))
        for start in range(0, len(points), BLOCK):
            block = points[start : start + BLOCK]
            result[start : start + BLOCK] = (self.patch(block) @ self._answers).reshape(len(block), 3, -1, 3)
        return np.moveaxis(result, 1, 3)

    def _solve(self, loads: FloatArray) -> FloatArray:
        """(D, N) the displacements under balanced loads (D, N), of no momentum and no angular momentum."""
        result = np.zeros(loads.shape)
        result[self._free] = self._factor.solve(loads[self._free])
        inertia = self._rigid.T @ self._heavy
        return np.asarray(result - self._rigid @ np.linalg.solve(inertia, self._heavy.T @ result))

    def _functionals(self, basis: Basis, corner: FloatArray) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        """(3 T, D), displacement to σ n at the centres of the interfaces' T triangles, and (3 I, 3 T), their means.

        The normal is the whole interface's: the triangles are only a staircase along the crack.
        """
        count = len(self.interfaces)
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        self._weight: FloatArray = area / sum_by_index(self._interface, area, count)[self._interface]
        normal = self.interfaces.normals[self._interface]
        tets, local = locate(self.mesh, corner.mean(axis=1))
        values, columns = [], []
        for k in range(basis.Nbfun):
            gradient = basis.elem.gbasis(basis.mapping, local.T[:, :, None], k, tind=tets)[0].grad[..., 0]
            gradient = np.moveaxis(gradient, 2, 0)  # (T, i, j): ∂u_i/∂x_j
            dilation = LAMBDA * np.trace(gradient, axis1=1, axis2=2)[:, None] * normal
            values.append(dilation + MU * np.einsum("tij,tj->ti", gradient + np.swapaxes(gradient, 1, 2), normal))
            columns.append(np.repeat(basis.element_dofs[k, tets], 3))
        rows = np.tile(np.arange(3 * len(tets)), len(values))
        tractions = sp.csr_matrix((np.ravel(values), (rows, np.concatenate(columns))), shape=(3 * len(tets), basis.N))
        mean = sp.csr_matrix((self._weight, (self._interface, np.arange(len(tets)))), shape=(count, len(tets)))
        return tractions, sp.csr_matrix(sp.kron(mean, sp.identity(3)))


def rigid_motions(nodes: FloatArray) -> FloatArray:
    """(3 S, 6) the displacements of nodes (S, 3) in unit translations and infinitesimal turns about the mean."""
    arm = nodes - nodes.mean(axis=0)
    shifts = np.broadcast_to(np.eye(3), (len(nodes), 3, 3))
    turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
    return np.concatenate([shifts, turns], axis=2).reshape(-1, 6)


def rowwise(matrix: sp.csr_matrix, vectors: FloatArray) -> FloatArray:
    """A matrix (S, S) between nodes applied to each component of vectors (3 S, N) on them."""
    return np.asarray(matrix @ vectors.reshape(matrix.shape[0], -1)).reshape(vectors.shape)


def _interface_triangles(parts: Solid, interfaces: Interfaces) -> tuple[IntArray, IntArray]:
    """The triangles (T, 3) between different parts and the interface (T,) that each belongs to."""
    between = (parts.sides >= 0).all(axis=1) & (parts.sides[:, 0] != parts.sides[:, 1])
    pairs, interface = np.unique(np.sort(parts.sides[between], axis=1), axis=0, return_inverse=True)
    if not np.array_equal(pairs, interfaces.pairs):
        raise BakeError("the interfaces are not those between the parts; take both from one simulator")
    return parts.triangles[between], interface.reshape(-1)
