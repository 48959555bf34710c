"""A free elastic body by finite elements, which answers impacts with tractions. Offline only.

``elastic`` builds its simulator on it; the physics is described there.
"""

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


# fTetWild prints to the standard output at every log level and leaves a file in the working directory, so it
# works in a process and a directory of its own.
_WILD = """
import sys
import numpy as np
import wildmeshing
surface = np.load("surface.npz")
epsilon, edge = float(surface["epsilon"]), float(surface["edge"])
wild = wildmeshing.Tetrahedralizer(epsilon=epsilon, edge_length_r=edge, max_threads=1)
wild.set_log_level(6)
wild.set_mesh(surface["vertices"], surface["faces"])
wild.tetrahedralize()
points, tetrahedra = wild.get_tet_mesh()[:2]
np.savez("solid.npz", points=points, tetrahedra=tetrahedra)
"""


def mesh_edge(surface: Surface) -> float:
    """Choose how long the edges of tetrahedra must be to resolve a surface.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.

    Returns
    -------
    float
        EDGE, or half of its walls' mean chord 4 V/A if that is less; in units of the largest extent.
    """
    mesh = surface.trimesh
    return min(EDGE, 2.0 * float(mesh.volume) / float(mesh.area))


def tetrahedralise(surface: Surface, edge: float | None = None) -> MeshTet:
    """Fill a surface with tetrahedra, to within ENVELOPE (Hu et al. 2020, fTetWild).

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    edge : float, optional
        About how long their edges are, in units of the largest extent; ``mesh_edge`` by default.

    Returns
    -------
    skfem.MeshTet
        fTetWild takes random choices: the same surface gives a slightly different mesh each time.

    Raises
    ------
    BakeError
        If fTetWild fails, or no tetrahedron fits inside.
    MissingExtraError
        If wildmeshing is not installed.
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
    """Keep the largest part that is joined by faces: one that is joined by an edge is a hinge and has no stiffness."""
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
    """Find the tetrahedron that holds each point.

    Parameters
    ----------
    mesh : skfem.MeshTet
        Of T tetrahedra.
    points : ndarray of float64, shape (N, 3)
        In the mesh's units.

    Returns
    -------
    tets : ndarray of int64, shape (N,)
        The tetrahedra. A point outside of the mesh, by no more than its envelope, is moved to the tetrahedron that
        it is nearest to being in.
    local : ndarray of float64, shape (N, 3)
        The point's coordinates in it, in the order of the tetrahedron's corners.
    """
    corners = mesh.p.T[mesh.t.T]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    tree = cKDTree(corners.mean(axis=1))
    tets = np.zeros(len(points), dtype=np.int64)
    local = np.zeros((len(points), 4))
    pending = np.arange(len(points))
    nearest = min(NEAREST, len(corners))
    while len(pending):
        _, near = tree.query(points[pending], k=np.arange(1, nearest + 1))
        within = np.einsum("nkij,nkj->nki", inverse[near], points[pending, None] - corners[near, 0])
        within = np.concatenate([1.0 - within.sum(axis=2, keepdims=True), within], axis=2)
        best = np.argmax(within.min(axis=2), axis=1)
        rows = np.arange(len(pending))
        tets[pending], local[pending] = near[rows, best], within[rows, best]
        if nearest == len(corners) or nearest > 16 * NEAREST:
            break
        pending = pending[local[pending].min(axis=1) < -1e-9]
        nearest = min(4 * nearest, len(corners))
    local = np.maximum(local, 0.0)
    return tets, (local / local.sum(axis=1, keepdims=True))[:, 1:]


class ElasticBody:
    """A free elastic body that answers, for an impact anywhere, with the tractions on its interfaces.

    The elements are quadratic tetrahedra: S nodes, D = 3 S unknowns, node by node. The three components of the
    traction on each of I interfaces are linear functionals of the displacement. Stiffness being symmetric, each is
    solved for once as if it were a load (Maxwell-Betti reciprocity); then the answer to an impact in any place is a
    dot product.

    Parameters
    ----------
    surface : Surface
        Of largest extent 1.
    cells : Solid
        The atoms of a ModalSimulator of that surface.
    interfaces : Interfaces
        Between them.
    mesh : skfem.MeshTet, optional
        Of the same body; ``tetrahedralise`` makes one if None.
    edge : float, optional
        For ``tetrahedralise``.

    Attributes
    ----------
    interfaces : Interfaces
        The I interfaces.
    mesh : skfem.MeshTet
        The tetrahedra.
    nodes : ndarray of float64, shape (S, 3)
        Corners and edge midpoints of the tetrahedra.

    Raises
    ------
    BakeError
        If the interfaces are not those between the cells, or the body cannot be filled with tetrahedra.
    MissingExtraError
        If a mesh has to be made and wildmeshing is not installed.
    """

    def __init__(
        self,
        surface: Surface,
        cells: Solid,
        interfaces: Interfaces,
        mesh: MeshTet | None = None,
        edge: float | None = None,
    ) -> None:
        self.interfaces = interfaces
        triangles, self._interface = _interface_triangles(cells, interfaces)
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
        self._triangle_tractions, self._mean = self._functionals(basis, cells.points[triangles])

    @cached_property
    def _answers(self) -> FloatArray:
        """At each node and for each direction, the displacement that answers for each traction, (S, 9 I)."""
        functionals = sp.csr_matrix(self._mean @ self._triangle_tractions)
        answers = np.empty((3 * len(self.nodes), functionals.shape[0]))
        for start in range(0, answers.shape[1], BLOCK):
            block = slice(start, start + BLOCK)
            # Without momentum and angular momentum, so that the inertia that balances an impact does no work on
            # them and need not be worked out per impact.
            answers[:, block] = self._solve(functionals[block].toarray().T)
        return answers.reshape(len(self.nodes), -1)

    def patch(self, points: FloatArray) -> FloatArray:
        """Spread impacts of unit force over the nodes, in whatever direction.

        Parameters
        ----------
        points : ndarray of float64, shape (N, 3)
            Where they are.

        Returns
        -------
        ndarray of float64, shape (N, S)
            Nodal forces: a Gaussian over the body of standard deviation PATCH_RADIUS, as in ``impact_field``, taken
            for a function of the finite elements.
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
        """Balance unit impacts by the inertia of the rigid motion that they cause.

        Parameters
        ----------
        points : ndarray of float64, shape (N, 3)
            Where they are.
        directions : ndarray of float64, shape (N, 3)
            Unit vectors.

        Returns
        -------
        ndarray of float64, shape (D, N)
            Nodal forces without net force or torque: the impact's, and -ρ(a + α×r), a and α being the linear and
            angular acceleration of the rigid body.
        """
        impacts = np.einsum("ns,nk->skn", self.patch(points), directions).reshape(-1, len(points))
        return np.asarray(impacts - self._heavy @ np.linalg.solve(self._rigid.T @ self._heavy, self._rigid.T @ impacts))

    def displacements(self, points: FloatArray, directions: FloatArray) -> FloatArray:
        """Solve for the elastic displacements under ``loads``.

        Parameters
        ----------
        points : ndarray of float64, shape (N, 3)
            Where the impacts are.
        directions : ndarray of float64, shape (N, 3)
            Unit vectors.

        Returns
        -------
        ndarray of float64, shape (D, N)
            Displacements without any rigid motion.
        """
        return np.hstack(
            [
                self._solve(self.loads(points[start : start + BLOCK], directions[start : start + BLOCK]))
                for start in range(0, len(points), BLOCK)
            ]
        )

    def tractions_of(self, displacements: FloatArray) -> FloatArray:
        """Work out the tractions σ̄ n under displacements, σ̄ being the mean stress over an interface.

        Parameters
        ----------
        displacements : ndarray of float64, shape (D, N)
            Of N impacts.

        Returns
        -------
        ndarray of float64, shape (N, I, 3)
            The tractions.
        """
        return np.asarray(self._mean @ (self._triangle_tractions @ displacements)).T.reshape(
            -1, len(self.interfaces), 3
        )

    def root_mean_square_loads(self, displacements: FloatArray) -> FloatArray:
        """Work out how hard displacements load each interface, bending included.

        Parameters
        ----------
        displacements : ndarray of float64, shape (D, N)
            Of N impacts.

        Returns
        -------
        ndarray of float64, shape (N, I)
            The root mean square, over each interface, of ``fracture.rule.effective_opening`` triangle by triangle.
            Unlike the mean traction it sees bending, whose tension and compression cancel over a whole section.
        """
        normals = self.interfaces.normals[self._interface]
        result = np.empty((displacements.shape[1], len(self.interfaces)))
        for n, displacement in enumerate(displacements.T):
            tractions = np.asarray(self._triangle_tractions @ displacement).reshape(1, -1, 3)
            square = effective_opening(tractions, normals)[0] ** 2
            result[n] = np.sqrt(sum_by_index(self._interface, self._weight * square, len(self.interfaces)))
        return result

    def tractions(self, points: FloatArray) -> FloatArray:
        """Work out what turns the direction of a unit impact into tractions.

        Parameters
        ----------
        points : ndarray of float64, shape (N, 3)
            Where the impacts are.

        Returns
        -------
        ndarray of float64, shape (N, I, 3, 3)
            ``tractions(x)[0] @ d`` (I, 3) is what the second cell of each pair does to the first, per unit of area.
            Its component along the interface's normal, which points from the first to the second, is positive in
            tension.
        """
        result = np.empty((len(points), 3, len(self.interfaces), 3))
        for start in range(0, len(points), BLOCK):
            block = points[start : start + BLOCK]
            result[start : start + BLOCK] = (self.patch(block) @ self._answers).reshape(len(block), 3, -1, 3)
        return np.moveaxis(result, 1, 3)

    def _solve(self, loads: FloatArray) -> FloatArray:
        """Solve for the displacements (D, N) under balanced loads (D, N), without momentum and angular momentum."""
        result = np.zeros(loads.shape)
        result[self._free] = self._factor.solve(loads[self._free])
        inertia = self._rigid.T @ self._heavy
        return np.asarray(result - self._rigid @ np.linalg.solve(inertia, self._heavy.T @ result))

    def _functionals(self, basis: Basis, corner: FloatArray) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        """Assemble displacement to σ n at the centres of the interfaces' T triangles (3 T, D), and means (3 I, 3 T).

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
    """Collect the rigid motions of nodes: unit translations, and infinitesimal turns about the mean.

    Parameters
    ----------
    nodes : ndarray of float64, shape (S, 3)
        Where they are.

    Returns
    -------
    ndarray of float64, shape (3 S, 6)
        Their displacements in each.
    """
    arm = nodes - nodes.mean(axis=0)
    shifts = np.broadcast_to(np.eye(3), (len(nodes), 3, 3))
    turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
    return np.concatenate([shifts, turns], axis=2).reshape(-1, 6)


def rowwise(matrix: sp.csr_matrix, vectors: FloatArray) -> FloatArray:
    """Apply a matrix between nodes to each component of vectors on them.

    Parameters
    ----------
    matrix : scipy.sparse.csr_matrix, shape (S, S)
        Between nodes.
    vectors : ndarray of float64, shape (3 S, N)
        Node by node.

    Returns
    -------
    ndarray of float64, shape (3 S, N)
        The products.
    """
    return np.asarray(matrix @ vectors.reshape(matrix.shape[0], -1)).reshape(vectors.shape)


def _interface_triangles(cells: Solid, interfaces: Interfaces) -> tuple[IntArray, IntArray]:
    """Find the triangles (T, 3) between different cells and the interface (T,) that each belongs to."""
    between = (cells.sides >= 0).all(axis=1) & (cells.sides[:, 0] != cells.sides[:, 1])
    pairs, interface = np.unique(np.sort(cells.sides[between], axis=1), axis=0, return_inverse=True)
    if not np.array_equal(pairs, interfaces.pairs):
        raise BakeError("the interfaces are not those between the cells; take both from one simulator")
    return cells.triangles[between], interface.reshape(-1)
