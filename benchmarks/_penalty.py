"""The same indentation by another program: scikit-fem's elements and assembly, and a penalty on the gap.

The penalty acts either on the gap at the quadrature points of a facet, or on its average against the hat of each vertex, which is where
`fingerjax.contact` has its pressures. The first is another discretisation of contact, and agrees as far as both have converged; the second
is the same, and agrees as far as both programs are right.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import skfem
from skfem.helpers import ddot, eye, sym_grad, trace

from fingerjax.contact.shape import AbstractIndenter
from fingerjax.fem.element import EDGES
from fingerjax.finger import Finger

try:
    import pypardiso
except ImportError:  # the extra `direct`
    pypardiso = None

POINTS = 2  # order of the rule on a facet: three points, as many as a facet can bear without being over-constrained
FINE = 19  # order of the rule for averages, which an indenter's edge may cut: the highest there is
SLIVER = 0.02  # of a hat: with less of it under the indenter, it bears nothing
REACHED = 1.25  # of the travel: skin farther than that from the indenter is not looked at
RAISED = 10.0  # by what the penalty grows from one round to the next
IDLE = 5e-4  # change of force from one round to the next at which the penalty is no longer felt
TOGETHER = 256  # right-hand sides of one solve


def straightened(finger: Finger) -> Finger:
    """The finger with its midsides on the chords: what both programs can mesh alike."""
    nodes = finger.nodes.copy()
    nodes[finger.tets[:, 4:]] = 0.5 * (nodes[finger.tets[:, EDGES[:, 0]]] + nodes[finger.tets[:, EDGES[:, 1]]])
    return dataclasses.replace(finger, nodes=nodes)


@dataclass(frozen=True)
class Skin:
    """Points on the skin: x, y, z `at` (3, q), mm; `area` (q,) mm^2 in the x-z plane; `reads` (q, n), u_y from unknowns; `hats` (v, q)."""

    at: np.ndarray
    area: np.ndarray
    reads: sp.csr_matrix
    hats: sp.csr_matrix


@dataclass(frozen=True)
class Rested:
    """An indenter at rest: the force, N; points `at` (3, q), mm, with the force on each (q,), N, and the area that bears, mm^2."""

    force: float
    at: np.ndarray
    forces: np.ndarray
    bearing: float


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
        self.basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
        skin = {frozenset(facet) for facet in bare.skin[:, :3].tolist()}
        boundary = mesh.boundary_facets()
        self.facets = boundary[[frozenset(used[mesh.facets[:, facet]].tolist()) in skin for facet in boundary]]
        E, nu = self.youngs_modulus[bare.layer], self.poisson_ratio[bare.layer]
        points = self.basis.X.shape[-1]
        lam, mu = (np.repeat(each[:, None], points, 1) for each in (E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))))
        self.free = self._free(bare)
        self.K = _stiffness.assemble(self.basis, lam=lam, mu=mu).tocsr()[self.free][:, self.free]

    def _free(self, bare: Finger) -> np.ndarray:
        """Unknowns that are not at a held node, found by their place."""
        held = {tuple(np.round(place, 9)) for place in bare.nodes[bare.nail | bare.bone]}
        places = np.round(self.basis.doflocs.T, 9)
        return np.array([tuple(place) not in held for place in places])

    def skin(self, order: int) -> Skin:
        """The points of a rule of this order."""
        vector = skfem.FacetBasis(self.basis.mesh, self.basis.elem, facets=self.facets, intorder=order)
        down = -np.asarray(vector.normals)[1]
        reads = _values(vector, lambda values: values[1], len(self.free))[:, self.free]
        reads.eliminate_zeros()  # unknowns along x and z, and off the skin
        linear = skfem.FacetBasis(self.basis.mesh, skfem.ElementTetP1(), facets=self.facets, intorder=order)
        hats = _values(linear, lambda values: values, linear.N).T.tocsr()
        at = np.asarray(vector.global_coordinates()).reshape(3, -1)
        return Skin(at, np.where(down > 0.17, vector.dx * down, 0.0).ravel(), reads, hats)

    def press(self, indenter: AbstractIndenter, origin: tuple[float, float], travel: float, lowest: float, averaged: bool) -> Rested:
        """Press with a penalty on the gap at points, or averaged over hats, raised until the force no longer changes.

        `lowest`: y, mm, at which the indenter first touches.
        """
        skin = self.skin(FINE if averaged else POINTS)
        x, y, z = skin.at
        gap = lowest + travel + np.asarray(indenter.surface(x - origin[0], z - origin[1])) - y
        bears = skin.area * np.asarray(indenter.covers(x - origin[0], z - origin[1]))
        rows = sp.diags(bears).tocsr()
        if averaged:
            rows = (skin.hats @ rows).tocsr()
        share = np.asarray(rows.sum(axis=1)).ravel()
        near = (share > 0) & (share >= (SLIVER * (skin.hats @ skin.area) if averaged else 0.0))
        rows = sp.diags(1 / share[near]) @ rows[near]
        close = rows @ gap > (1 - REACHED) * travel
        rows, share = rows[close], share[near][close]
        forces = self._settled(self._compliance(rows @ skin.reads), rows @ gap, share)
        return Rested(float(forces.sum()), skin.at, rows.T @ forces, float(share[forces > 0].sum()))

    def _settled(self, A: np.ndarray, gap: np.ndarray, area: np.ndarray) -> np.ndarray:
        forces, stiff = np.zeros(len(gap)), 1.0
        while True:
            before, forces = forces.sum(), _rest(A, gap, stiff * area, forces)
            if abs(forces.sum() - before) < IDLE * forces.sum():
                return forces
            stiff *= RAISED

    def _compliance(self, reads: sp.csr_matrix) -> np.ndarray:
        """(q, q) mm/N: what each reading moves by under unit forces on each of them."""
        touched = np.unique(reads.indices)
        only = reads[:, touched]
        moved = [self._solve(touched[i : i + TOGETHER])[touched] for i in range(0, len(touched), TOGETHER)]
        return np.asarray(only @ (only @ np.hstack(moved).T).T)

    def _solve(self, loaded: np.ndarray) -> np.ndarray:
        """(n, k) mm/N: displacements under a unit force on each of these unknowns."""
        load = np.zeros((self.K.shape[0], len(loaded)))
        load[loaded, np.arange(len(loaded))] = 1.0
        moved = pypardiso.spsolve(self.K, load) if pypardiso is not None else self._factor.solve(load)
        return moved.reshape(load.shape)  # pypardiso flattens a single column

    @cached_property
    def _factor(self) -> spla.SuperLU:
        return spla.splu(self.K.tocsc())


def _values(basis: skfem.FacetBasis, part: Callable[[Any], Any], unknowns: int) -> sp.csr_matrix:
    """(q, n): a part of the basis functions at all points of the facets."""
    rows = np.arange(basis.dx.size).reshape(basis.dx.shape)
    found = [
        (np.asarray(part(np.asarray(basis.basis[i][0]))).ravel(), np.repeat(basis.element_dofs[i], rows.shape[1]))
        for i in range(basis.Nbfun)
    ]
    data, column = (np.concatenate(each) for each in zip(*found, strict=True))
    return sp.csr_matrix((data, (np.tile(rows.ravel(), basis.Nbfun), column)), shape=(rows.size, unknowns))


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
