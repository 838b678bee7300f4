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

    def press(self, indenter: AbstractIndenter, origin: tuple[float, float], travel: float, lowest: float) -> tuple[float, np.ndarray]:
        """Force, N, and pressure (q,), MPa, at every point, with the penalty raised until the force no longer changes.

        `lowest`: y, mm, at which the indenter first touches.
        """
        x, y, z = self.at
        gap = lowest + travel + np.asarray(indenter.surface(x - origin[0], z - origin[1])) - y
        near = (self.area > 0) & np.asarray(indenter.covers(x - origin[0], z - origin[1])) & (gap > -travel)
        touched = np.unique(self.reads[near].indices)
        S, reads, gap, area = self._seen_from(touched), self.reads[near][:, touched].toarray(), gap[near], self.area[near]
        u, force, stiff = np.zeros(len(touched)), 0.0, 1.0
        while True:
            u = _rest(S, reads, gap, stiff * area, u)
            overlap = np.maximum(gap - reads @ u, 0.0)
            before, force = force, float(stiff * area @ overlap)
            if abs(force - before) < IDLE * force:
                pressure = np.zeros(near.size)
                pressure[near] = stiff * overlap
                return force, pressure
            stiff *= RAISED

    def _seen_from(self, touched: np.ndarray) -> np.ndarray:
        """Stiffness of the whole body at some unknowns, the rest free to move."""
        number = np.cumsum(self.free) - 1
        load = np.zeros((int(self.free.sum()), len(touched)))
        load[number[touched], np.arange(len(touched))] = 1.0
        K = self.K[self.free][:, self.free]
        answer = pypardiso.spsolve(K, load) if pypardiso is not None else spla.splu(K.tocsc()).solve(load)
        return np.linalg.inv(answer[number[touched]])


def _rest(S: np.ndarray, reads: np.ndarray, gap: np.ndarray, weight: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Newton's method on the energy u'Su/2 + sum w max(gap - r u, 0)^2/2, steps halved while it grows."""

    def energy(v: np.ndarray) -> float:
        return 0.5 * float(v @ S @ v) + 0.5 * float(weight @ np.maximum(gap - reads @ v, 0.0) ** 2)

    for _ in range(100):
        active = gap - reads @ u > 0
        own = reads[active]
        goal = np.linalg.solve(S + own.T @ (weight[active, None] * own), own.T @ (weight[active] * gap[active]))
        if np.array_equal(gap - reads @ goal > 0, active):
            return goal
        share = 1.0
        while energy(u + share * (goal - u)) > energy(u) and share > 1e-4:
            share *= 0.5
        u = u + share * (goal - u)
    raise RuntimeError("the penalty's contact did not settle; take a finer mesh")


@skfem.BilinearForm
def _stiffness(u, v, w):
    strain = sym_grad(u)
    return ddot(w["lam"] * eye(trace(strain), 3) + 2.0 * w["mu"] * strain, sym_grad(v))
