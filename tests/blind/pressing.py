"""Ways of pressing on a finger: clean contact, contact that sticks, and what an instrument reads of either.

Every way answers `press(indenter, at, travel)`. Contact is that of `touch`: points of the skin, a penalty raised until it is idle. What the
skin does besides, of its own accord, enters as a free displacement that shifts the gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from .bricks import Array
from .touch import Body, Indenter, overlap, raise_penalty

TOLERANCE = 2e-4
"""Relative change of the force at which the penalty counts as idle."""


@dataclass(frozen=True)
class Felt:
    """One press: normal force N of the whole finger, u_y mm of the skin's midline (w,), tensor strains (receptors, 6)."""

    force: float
    deflection: Array
    strain: Array

    @classmethod
    def none(cls, body: Body) -> Felt:
        """Not touched."""
        count = len(body.watched)
        return cls(0.0, np.zeros(count), np.zeros(((len(body.readings) - count) // 6, 6)))


class Pressing(Protocol):
    """A finger that can be pressed: `travel` mm from first contact, the indenter's origin at z = `at`."""

    body: Body

    def rest(self) -> None: ...

    def press(self, indenter: Indenter, at: float, travel: float) -> Felt: ...


@dataclass(frozen=True)
class Plan:
    """Contact points under one indenter in one place: rows (q, m) onto the pad, the height (q,) of the indenter above the skin at first
    contact (<= 0), areas (q,) mm2."""

    rows: sp.csr_matrix
    above: Array
    area: Array

    @classmethod
    def of(cls, body: Body, indenter: Indenter, at: float) -> Plan:
        points, above = overlap(body, indenter, at, 3, 1)
        there = np.isfinite(above)
        return cls(points.rows[there], above[there], points.area[there])

    def near(self, travel: float) -> Plan:
        """Points that can come into contact: skin bulges onto an indenter by less than the travel."""
        chosen = self.above > -2.0 * travel
        return Plan(self.rows[chosen], self.above[chosen], self.area[chosen])


def held(body: Body, plan: Plan, travel: float, free: Array | None = None) -> Array:
    """Nodal forces (m,) N along y on the pad that keep the skin out of the indenter; `free` (m,) mm is how the pad moves without them."""
    near = plan.near(travel)
    gap = near.above + travel - (0.0 if free is None else near.rows @ free)
    nodes = np.unique(near.rows.indices)
    _, pressure, _ = raise_penalty(body.compliance[np.ix_(nodes, nodes)], near.rows[:, nodes], gap, near.area, TOLERANCE)
    nodal = near.rows.T @ pressure
    if np.any(nodal[body.border] != 0.0):
        raise RuntimeError(f"contact at a travel of {travel:g} mm reached skin that was not made touchable")
    return nodal


def read(body: Body, nodal: Array, besides: Array | float = 0.0) -> Felt:
    """What forces (m,) on the pad make instruments read; `besides` (r,) is added to the readings."""
    seen = body.readings @ nodal + besides
    count = len(body.watched)
    return Felt(float(nodal.sum()) * body.symmetry, seen[:count], seen[count:].reshape(-1, 6))


class Plain:
    """Linear tissue without friction or adhesion."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self._plans: dict[tuple[Indenter, float], Plan] = {}

    def plan(self, indenter: Indenter, at: float) -> Plan:
        """Contact points, found once for each indenter and place."""
        key = (indenter, at)
        if key not in self._plans:
            self._plans[key] = Plan.of(self.body, indenter, at)
        return self._plans[key]

    def rest(self) -> None:
        """Let go of the finger, as between two recordings; only friction remembers what was before."""

    def press(self, indenter: Indenter, at: float, travel: float) -> Felt:
        return read(self.body, held(self.body, self.plan(indenter, at), travel))


class Sticky(Plain):
    """Skin that is drawn to the indenter: a traction `strength` MPa where they touch, which dies off over a gap of `range` mm.

        attraction = strength exp(-gap / range)

    An exponential law of separation (Rose, Ferrante and Smith 1981 have its like); contact and attraction are found in turn.
    """

    def __init__(self, body: Body, strength: float, range: float) -> None:
        super().__init__(body)
        self.strength, self.range = strength, range

    def press(self, indenter: Indenter, at: float, travel: float) -> Felt:
        plan, load, before = self.plan(indenter, at), np.zeros(len(self.body.pad)), np.inf
        near = plan.near(travel)
        for _ in range(80):
            nodal = held(self.body, plan, travel, self.body.compliance @ load)
            force = float((nodal + load).sum())
            if abs(force - before) < 1e-4 * abs(force):
                return read(self.body, nodal + load)
            opening = near.rows @ (self.body.compliance @ (nodal + load)) - near.above - travel
            pull = near.area * self.strength * np.exp(-np.maximum(opening, 0.0) / self.range)
            load, before = 0.5 * (load - near.rows.T @ pull), force
        raise RuntimeError("contact and attraction do not agree after 80 turns; take a weaker attraction or a longer range")
