"""Skin that stiffens with strain, at small strain: the shear modulus of epidermis and dermis grows with the square of the strain.

    W = lambda/2 (tr e)^2 + mu e:e + mu stiffening/2 (d:d)^2        d: deviator of the strain e

so that the extra stress is 2 mu stiffening (d:d) d: a cubic law, not an exponential one. A step solves with a factor of fixed, stiffer
skin; contact is found anew in each, and Anderson's mixing speeds up the steps (Walker and Ni 2011). They run away where skin is more than
about twice as stiff as the factor's, as it is beside a sharp wedge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from .bricks import Array, Bricks, assemble_bricks, gradients, lame, strain_rows
from .flesh import Flesh, factored, midline
from .pressing import Felt, Plain, held, read
from .touch import Indenter, condense_factored

MEMORY = 8
STEPS = 150
SETTLED = 2e-5
"""Largest change in mm of any displacement, over the travel, at which the steps end."""


class Stiffening(Plain):
    """A flesh whose skin stiffens, pressed ever deeper: each press begins from the last one of the same indenter and place."""

    def __init__(self, flesh: Flesh, *, skin: float = 5.0) -> None:
        mesh, self.factor = factored(replace(flesh, stiffening=0.0), skin=skin)
        receptors = tuple(flesh.receptor(n) for n in range(len(flesh.receptors)))
        super().__init__(condense_factored(mesh, self.factor, flesh.touchable, watched=midline(mesh), receptors=receptors))
        self.flesh, self.mesh = flesh, mesh
        self._load = _rows(mesh, self.body.pad).T.tocsr()
        self._read = sp.vstack([_rows(mesh, midline(mesh)), *(strain_rows(mesh, np.array(p))[0] for p in receptors)]).tocsr()
        self._law(skin)
        self._last: dict[tuple[Indenter, float], Array] = {}

    def _law(self, skin: float) -> None:
        """What the skin's bricks need to give their stress, and the linear skin that the factor has too much of."""
        flesh, mesh = self.flesh, self.mesh
        self.skin = np.flatnonzero(mesh.layer < 2)
        self.gradient, self.weight = gradients(mesh.nodes[mesh.bricks[self.skin]], 3)
        modulus, poisson = np.asarray(flesh.moduli)[mesh.layer], np.asarray(flesh.poisson)[mesh.layer]
        self.shear = lame(modulus[self.skin], poisson[self.skin])[1]
        self.surplus = assemble_bricks(mesh, modulus * np.where(mesh.layer < 2, skin - 1.0, 0.0), poisson)

    def press(self, indenter: Indenter, at: float, travel: float) -> Felt:
        key = (indenter, at)
        plan, mixing = self.plan(indenter, at), Mixing(MEMORY)
        free = self._last.get(key, np.zeros(3 * len(self.mesh.nodes)))
        for _ in range(STEPS):
            nodal = held(self.body, plan, travel, free[3 * self.body.pad + 1])
            moved = free + self._solved(self._load @ nodal)
            target = self._solved(self.surplus @ moved - self.extra_force(moved))
            if np.abs(target - free).max() < SETTLED * travel:
                self._last[key] = target
                return read(self.body, nodal, self._read @ target)
            free = mixing(free, target)
        raise RuntimeError(f"stiffening skin has not settled after {STEPS} steps at a travel of {travel:g} mm; press in smaller steps")

    def _solved(self, load: Array) -> Array:
        return self.factor.solve(load[:, None])[:, 0]

    def extra_force(self, moved: Array) -> Array:
        """Nodal forces (3n,) N of the stress that stiffening adds, for displacements (3n,)."""
        bricks = self.mesh.bricks[self.skin]
        slope = np.einsum("eqaj,eai->eqij", self.gradient, moved.reshape(-1, 3)[bricks], optimize=True)
        strain = 0.5 * (slope + slope.swapaxes(-1, -2))
        strain = strain - np.trace(strain, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3.0
        size = (strain**2).sum((-1, -2))
        factor = 2.0 * self.flesh.stiffening * self.shear[:, None] * size * self.weight
        force = np.einsum("eq,eqij,eqaj->eai", factor, strain, self.gradient, optimize=True)
        out = np.zeros_like(moved).reshape(-1, 3)
        np.add.at(out, bricks, force)
        return out.ravel()


class Mixing:
    """Anderson mixing of a fixed-point iteration, with the last `memory` steps."""

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self.taken: list[tuple[Array, Array]] = []

    def __call__(self, at: Array, target: Array) -> Array:
        self.taken = [*self.taken[-self.memory :], (at, target - at)]
        if len(self.taken) == 1:
            return target
        steps = np.stack([a - b for (a, _), (b, _) in zip(self.taken[1:], self.taken[:-1], strict=True)], 1)
        changes = np.stack([a - b for (_, a), (_, b) in zip(self.taken[1:], self.taken[:-1], strict=True)], 1)
        share = np.linalg.lstsq(changes, target - at, rcond=1e-8)[0]
        return target - (steps + changes) @ share


def _rows(mesh: Bricks, nodes: Array) -> sp.csr_matrix:
    count = len(nodes)
    return sp.csr_matrix((np.ones(count), (np.arange(count), 3 * nodes + 1)), shape=(count, 3 * len(mesh.nodes)))
