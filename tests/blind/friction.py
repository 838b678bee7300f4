"""Coulomb friction between skin and indenter, followed step by step as the indenter goes down.

In each step normal contact is kept by a penalty, and sliding costs (friction x normal force) x (sqrt(s^2 + e^2) - e) with s the slip
since the step before: a smooth stand-in for Coulomb's law that is a convex problem for given normal forces. Normal forces and slip are
found in turn (Panagiotopoulos 1975). Sliding is along x and z; the pad is nearly level where it is touched.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from .bricks import Array, Bricks, SlabFactor, strain_rows
from .flesh import Flesh, factored, midline
from .pressing import Felt, Plain, Plan, read
from .touch import Body, Indenter, condense_factored

SMOOTH = 2e-3
"""e, mm."""
STEP = 0.15
"""Largest step of the indenter, mm."""


class Rubbing(Plain):
    """A linear flesh under rough indenters. Presses of one indenter in one place must come in order of travel, each from the last."""

    def __init__(self, flesh: Flesh, friction: float) -> None:
        mesh, factor = factored(flesh)
        receptors = tuple(flesh.receptor(n) for n in range(len(flesh.receptors)))
        super().__init__(condense_factored(mesh, factor, flesh.touchable, watched=midline(mesh), receptors=receptors))
        self.friction = friction
        self.compliance, self.readings = _sideways(self.body, factor, receptors)
        self._last: dict[tuple[Indenter, float], tuple[float, Array]] = {}

    def rest(self) -> None:
        """The indenter is lifted: what slid comes back."""
        self._last = {}

    def press(self, indenter: Indenter, at: float, travel: float) -> Felt:
        depth, forces = self._last.get((indenter, at), (0.0, np.zeros((3, len(self.body.pad)))))
        if travel < depth:
            raise ValueError(f"a travel of {travel:g} mm after one of {depth:g}; friction remembers: press in order")
        stops = np.linspace(depth, travel, 2 + int((travel - depth) / STEP))[1:]
        for stop in stops if travel > depth else ():
            forces = self._step(self.plan(indenter, at), float(stop), forces)
        self._last[indenter, at] = (travel, forces)
        normal = read(self.body, forces[1])
        besides = self.readings @ forces.ravel() - self.body.readings @ forces[1]
        whole = read(self.body, forces[1], besides)
        return Felt(normal.force, whole.deflection, whole.strain)

    def _step(self, plan: Plan, travel: float, forces: Array) -> Array:
        """Forces (3, m) after the indenter has gone down to `travel`, from those before."""
        near, count = plan.near(travel), len(self.body.pad)
        nodes = np.unique(near.rows.indices)
        rows = near.rows[:, nodes].tocsr()
        moves = [np.flatnonzero(np.diag(self.compliance)[n * count + nodes] > 0) for n in range(3)]
        taken = np.concatenate([n * count + nodes[moves[n]] for n in range(3)])
        stiffness = la.inv(self.compliance[np.ix_(taken, taken)])
        map_ = sp.block_diag([rows[:, moves[n]] for n in range(3)]).tocsr()  # displacements of points from those of nodes
        before = map_ @ (self.compliance[taken] @ forces.ravel())
        points = len(near.area)
        hold = 30.0 * 4.0**5 / (_load_compliance(self.compliance, nodes + count, rows, near.area) * near.area.sum()) * near.area
        gap, u, press = near.above + travel, self.compliance[taken] @ forces.ravel(), np.zeros(points)
        for _ in range(30):
            u = _slide(stiffness, map_, gap, hold, self.friction * press, before, u)
            found = hold * np.maximum(gap - (map_ @ u)[points : 2 * points], 0.0)
            change = np.abs(found - press).sum()
            press = found
            if change < 1e-3 * press.sum():
                out = np.zeros(3 * count)
                out[taken] = stiffness @ u
                return out.reshape(3, count)
        raise RuntimeError(f"normal forces and slip do not agree at a travel of {travel:g} mm; take smaller steps or less friction")


def _load_compliance(compliance: Array, dof: Array, rows: sp.csr_matrix, area: Array) -> float:
    load = rows.T @ (area / area.sum())
    return float(load @ compliance[np.ix_(dof, dof)] @ load)


def _slide(stiffness: Array, map_: sp.csr_matrix, gap: Array, hold: Array, bound: Array, before: Array, u: Array) -> Array:
    """Displacements u that minimise u'Su/2 + sum hold max(gap - y, 0)^2/2 + sum bound (sqrt(s^2 + e^2) - e), by Newton with halving."""
    q = len(gap)

    def parts(v: Array) -> tuple[Array, Array, Array]:
        moved = map_ @ v
        slip = np.stack([(moved - before)[:q], (moved - before)[2 * q :]])
        return gap - moved[q : 2 * q], slip, np.sqrt((slip**2).sum(0) + SMOOTH**2)

    def energy(v: Array) -> float:
        over, _, size = parts(v)
        return 0.5 * float(v @ stiffness @ v) + 0.5 * float(hold @ np.maximum(over, 0.0) ** 2) + float(bound @ (size - SMOOTH))

    now = energy(u)
    for _ in range(100):
        over, slip, size = parts(u)
        active = over > 0.0
        force = np.concatenate([bound * slip[0] / size, -hold * np.maximum(over, 0.0), bound * slip[1] / size])
        slope = stiffness @ u + map_.T @ force
        curve = bound / size
        xx, zz, xz = (curve * (np.eye(2)[a, b] - slip[a] * slip[b] / size**2) for a, b in ((0, 0), (1, 1), (0, 1)))
        middle = sp.bmat([[sp.diags(xx), None, sp.diags(xz)], [None, sp.diags(hold * active), None], [sp.diags(xz), None, sp.diags(zz)]])
        step = -la.solve(stiffness + (map_.T @ middle @ map_).toarray(), slope, assume_a="pos", check_finite=False)
        share, gain = 1.0, float(slope @ step)
        if -gain < 1e-12 * max(abs(now), 1e-12):
            return u
        while (then := energy(u + share * step)) > now + 1e-4 * share * gain and share > 1e-6:
            share *= 0.5
        u, now = u + share * step, min(then, now)
    raise RuntimeError("slip did not settle in 100 Newton steps")


def _sideways(body: Body, factor: SlabFactor, receptors: tuple[tuple[float, float, float], ...]) -> tuple[Array, Array]:
    """Compliance (3m, 3m) and readings (r, 3m) of the pad under forces along x, y and z, in that order."""
    mesh, count = body.mesh, len(body.pad)
    dof = np.concatenate([3 * body.pad + n for n in range(3)])
    rows = [_unit(mesh, dof), _unit(mesh, 3 * body.watched + 1), *(strain_rows(mesh, np.array(p))[0] for p in receptors)]
    seen = sp.vstack(rows).tocsr()
    found = []
    for part in np.array_split(np.arange(3 * count), 1 + 3 * count // 250):
        found.append(seen @ factor.solve(_unit(mesh, dof[part]).T.toarray()))
    both = np.concatenate(found, axis=1)
    return 0.5 * (both[: 3 * count] + both[: 3 * count].T), both[3 * count :]


def _unit(mesh: Bricks, dof: Array) -> sp.csr_matrix:
    return sp.csr_matrix((np.ones(len(dof)), (np.arange(len(dof)), dof)), shape=(len(dof), 3 * len(mesh.nodes)))
