"""The same indentation by another program: scikit-fem's elements and assembly, and a penalty at quadrature points."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import skfem
from skfem.helpers import ddot, eye, sym_grad, trace

from fingerjax.contact.indenter import AbstractIndenter
from fingerjax.fem.element import EDGES
from fingerjax.finger import Finger

try:
    import pypardiso
except ImportError:  # the extra `direct`
    pypardiso = None

POINTS = 2  # order of the rule on a facet: three points, as many as a facet can bear without being over-constrained
RAISED = 10.0  # by what the penalty grows from one round to the next
IDLE = 5e-4  # change of force from one round to the next at which the penalty is no longer felt


def straightened(finger: Finger) -> Finger:
    """The finger with its midsides on the chords: what both programs can mesh alike."""
    nodes = finger.nodes.copy()
    nodes[finger.tets[:, 4:]] = 0.5 * (nodes[finger.tets[:, EDGES[:, 0]]] + nodes[finger.tets[:, EDGES[:, 1]]])
    return dataclasses.replace(finger, nodes=nodes)


@dataclass
class Penalty:
    """A finger of straight elements, with bone and nail held, in scikit-fem: elastic moduli of each layer, MPa."""

    finger: Finger
    youngs_modulus: np.ndarray
    poisson_ratio: np.ndarray

    def __post_init__(self) -> None:
        bare = self.finger.without_bone()
        used, corners = np.unique(bare.tets[:, :4], return_inverse=True)
        mesh = skfem.MeshTet(bare.nodes[used].T.copy(), corners.reshape(-1, 4).T.copy())
        self.corner = used
        self.basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
        E, nu = self.youngs_modulus[bare.layer], self.poisson_ratio[bare.layer]
        points = self.basis.X.shape[-1]
        lam, mu = (np.repeat(each[:, None], points, 1) for each in (E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))))
        self.K = _stiffness.assemble(self.basis, lam=lam, mu=mu).tocsr()
        self.free = self._free(bare)
        self.quadrature(bare)

    def _free(self, bare: Finger) -> np.ndarray:
        """Unknowns that are not at a held node, found by their place."""
        held = {tuple(np.round(place, 9)) for place in bare.nodes[bare.nail | bare.bone]}
        places = np.round(self.basis.doflocs.T, 9)
        return np.array([tuple(place) not in held for place in places])

    def quadrature(self, bare: Finger) -> None:
        """Points on the skin: interpolation of u_y from unknowns, x, y, z, and area in the x-z plane."""
        mesh = self.basis.mesh
        corners = {frozenset(facet) for facet in bare.skin[:, :3].tolist()}
        boundary = mesh.boundary_facets()
        skin = boundary[[frozenset(self.corner[mesh.facets[:, facet]].tolist()) in corners for facet in boundary]]
        facets = skfem.FacetBasis(mesh, self.basis.elem, facets=skin, intorder=POINTS)
        place = np.asarray(facets.global_coordinates())
        down = -np.asarray(facets.normals)[1]
        self.at = place.reshape(3, -1)
        self.area = np.where(down > 0.17, facets.dx * down, 0.0).ravel()
        rows = np.arange(self.area.size).reshape(facets.dx.shape)
        parts = [
            (np.asarray(facets.basis[i][0])[1].ravel(), rows.ravel(), np.repeat(facets.element_dofs[i], rows.shape[1]))
            for i in range(facets.Nbfun)
        ]
        data, row, column = (np.concatenate(each) for each in zip(*parts, strict=True))
        self.reads = sp.csr_matrix((data, (row, column)), shape=(self.area.size, self.K.shape[0]))
        self.reads.eliminate_zeros()  # unknowns along x and z, and off the skin

    def press(self, indenter: AbstractIndenter, origin: tuple[float, float], travel: float, lowest: float) -> tuple[float, np.ndarray]:
        """Force, N, and pressure (q,), MPa, at every point, with the penalty raised until the force no longer changes.

        `lowest`: y, mm, at which the indenter first touches.
        """
        x, y, z = self.at
        gap = lowest + travel + np.asarray(indenter.surface(x - origin[0], z - origin[1])) - y
        near = (self.area > 0) & np.asarray(indenter.covers(x - origin[0], z - origin[1])) & (gap > -travel)
        A, gap, area = self._compliance(near), gap[near], self.area[near]
        bears, force, stiff = np.zeros(len(gap)), 0.0, 1.0
        while True:
            bears = _rest(A, gap, stiff * area, bears)
            before, force = force, float(bears.sum())
            if abs(force - before) < IDLE * force:
                pressure = np.zeros(near.size)
                pressure[near] = bears / area
                return force, pressure
            stiff *= RAISED

    def _compliance(self, near: np.ndarray) -> np.ndarray:
        """(q, q) mm/N: what the marked points move by along y under unit forces along y on each of them."""
        reads = self.reads[near][:, self.free]
        touched = np.unique(reads.indices)
        load = np.zeros((reads.shape[1], len(touched)))
        load[touched, np.arange(len(touched))] = 1.0
        K = self.K[self.free][:, self.free]
        answer = pypardiso.spsolve(K, load) if pypardiso is not None else spla.splu(K.tocsc()).solve(load)
        only = reads[:, touched]
        return np.asarray(only @ (only @ answer[touched].T).T)


def _rest(A: np.ndarray, gap: np.ndarray, weight: np.ndarray, bears: np.ndarray) -> np.ndarray:
    """Newton's method on the energy f'Af/2 + sum w max(gap - A f, 0)^2/2 in the points' forces f, N; steps halved while it grows."""

    def energy(f: np.ndarray) -> float:
        moved = A @ f
        return 0.5 * float(f @ moved) + 0.5 * float(weight @ np.maximum(gap - moved, 0.0) ** 2)

    for _ in range(200):
        active = gap - A @ bears > 0
        goal = np.zeros(len(gap))
        goal[active] = np.linalg.solve(A[np.ix_(active, active)] + np.diag(1 / weight[active]), gap[active])
        if np.array_equal(gap - A @ goal > 0, active):
            return goal
        share, before = 1.0, energy(bears)
        while energy(bears + share * (goal - bears)) > before and share > 1e-4:
            share *= 0.5
        bears = bears + share * (goal - bears)
    raise RuntimeError("the penalty's contact did not settle; take a finer mesh")


@skfem.BilinearForm
def _stiffness(u, v, w):
    strain = sym_grad(u)
    return ddot(w["lam"] * eye(trace(strain), 3) + 2.0 * w["mu"] * strain, sym_grad(v))
