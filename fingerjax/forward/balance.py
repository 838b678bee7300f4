"""What statics says of every computed indentation, whoever computed it: work and energy, loads and reactions, Betti and Clapeyron.

Each check recomputes one thing from nodal forces and displacements alone, and compares it with what it must be. None trusts a flag.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact.indentation import Contact
from ..fem.body import Body
from ..fem.carried import admissible, bone_loads
from ..fem.columns import Columns
from ..fem.condensed import AbstractCondensed
from ..fem.operator import Lame, internal_force, strain_energy
from ..fem.stiffness import Elastic
from .model import Model
from .pressing import Known, Settled, pressed, settle
from .rigs import Rig
from .wiring import Values

SOLVED = 1e-8  # residual of a solve that ends well, relative to its own load
ALIKE = 1e-7  # works, which are second order in what solves leave
BALANCED = 1e-6  # forces and moments, which add up what is left at thousands of nodes
ROUNDING = 1e-12  # a scaled eigenvalue below this is not told from zero
MIXES = 4  # random loads under which both ways round are compared


@dataclass(frozen=True)
class Check:
    """One thing that must hold: `value` is at most `allowed`, or, with `at_least`, no less. A value that is not a number never holds."""

    what: str
    value: float
    allowed: float
    at_least: bool = False

    @property
    def ok(self) -> bool:
        return bool(self.value >= self.allowed if self.at_least else self.value <= self.allowed)


class AtRest(eqx.Module):
    """Indentations of one rig on one tissue, as they ended.

    - `load` (k, n, 3): nodal forces of the contacts, N. `displacement` (k, n, 3), mm.
    - `internal` (k, n, 3): nodal forces that hold the displacement, N. `energy` (k,): elastic, N mm.
    - `asked` (k,): norms of all that was solved for on the way, N: of each column's share, and of what each motion of a carried bone asks
      of the tissue. The contact's own load is less than these, and each of them left its residual.
    """

    load: Float[Array, "k n 3"]
    displacement: Float[Array, "k n 3"]
    internal: Float[Array, "k n 3"]
    energy: Float[Array, " k"]
    asked: Float[Array, " k"]


def at_rest(model: Model, condensed: AbstractCondensed, forces: Float[Array, "k m"]) -> AtRest:
    """The body under column forces, N: its displacements, and internal forces and energies recomputed from these element by element."""
    load = (model.columns.matrix() @ np.asarray(forces).T).T.reshape(len(forces), -1, 3)
    return _recomputed(model.body, condensed.held.lame, model.columns, forces, jnp.asarray(load), condensed.displacement(forces))


@eqx.filter_jit
def _recomputed(body: Body, lame: Lame, columns: Columns, forces: Array, load: Array, displacement: Array) -> AtRest:
    def one(u: Float[Array, "n 3"]) -> tuple[Array, Array]:
        return internal_force(body, lame, u), strain_energy(body, lame, u)

    asked = jnp.abs(forces) @ jnp.linalg.norm(columns.weight.reshape(columns.count, -1), axis=1)
    moved = jnp.abs(jnp.einsum("bni,kni->kb", body.modes, displacement))
    asked = asked + moved @ jnp.linalg.norm(bone_loads(Elastic(body, lame)).reshape(len(body.modes), displacement[0].size), axis=1)
    internal, energy = jax.lax.map(one, displacement)
    return AtRest(load, displacement, internal, energy, asked)


def energy_balance(name: str, state: AtRest) -> Check:
    """Work of the loads against twice the elastic energy (Clapeyron, 1833), relative to the work."""
    work = np.einsum("kni,kni->k", state.load, state.displacement)
    return Check(f"{name}: work of the loads is twice the energy", _worst(work - 2 * np.asarray(state.energy), work), ALIKE)


def reaction_balance(name: str, body: Body, state: AtRest) -> Check:
    """Forces and moments of the supports against those of the loads, relative; moments are divided by the size of the body."""
    applied = _resultants(body, np.asarray(state.load))
    reaction = _resultants(body, np.asarray(state.internal) * _supports(body))
    return Check(f"{name}: supports carry the load", _worst(reaction + applied, applied), BALANCED)


def equilibrium(name: str, body: Body, state: AtRest) -> Check:
    """What is left of load minus internal force wherever the body may move, a carried bone as one piece; relative to what was asked."""
    left = jax.vmap(lambda r: admissible(body, r))(state.load - state.internal)
    return Check(f"{name}: residual of the solve, recomputed", _worst(_flat(left), np.asarray(state.asked)[:, None]), SOLVED)


def contact_decided(name: str, contact: Contact) -> list[Check]:
    """No skin is pulled, none lies inside the indenter, and every contact was decided on skin that was prepared for it."""
    force, gap = np.asarray(contact.pressure), np.asarray(contact.gap)
    tension = np.maximum(-force.min(axis=1), 0.0) / _size(force)
    overlap = np.maximum(-gap.min(axis=1), 0.0) / _size(np.asarray(contact.travel)[:, None])
    open_ends = np.asarray(~contact.settled | contact.reached_edge).sum()
    return [
        Check(f"{name}: neither tension nor overlap", float(np.max([tension, overlap])), 1e-9),
        Check(f"{name}: contacts undecided, or at the edge of the pad", float(open_ends), 0.0),
    ]


def contact_compliance(name: str, rig: Rig, matrix: Float[Array, "m m"]) -> Check:
    """Smallest eigenvalue of what contact inverts, scaled to a diagonal of ones, over all poses: positive if the body is held."""
    smallest = []
    for columns, load, area in zip(rig.columns, rig.interface.load, rig.interface.area, strict=True):
        there = np.asarray(load)[:, np.asarray(area) > 0]
        C = there.T @ np.asarray(matrix)[np.ix_(np.asarray(columns), np.asarray(columns))] @ there
        scale = np.sqrt(np.abs(np.diagonal(C)))
        smallest.append(np.linalg.eigvalsh(C / np.outer(scale, scale))[0])
    return Check(f"{name}: smallest eigenvalue of the contact's compliance", float(np.min(smallest)), ROUNDING, at_least=True)


def reciprocity(name: str, model: Model, condensed: AbstractCondensed) -> list[Check]:
    """Random loads: each does the same work on the other's displacement (Betti, 1872), and the condensed matrix says the same."""
    mix = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], size=(2 * MIXES, model.columns.count)))
    state = at_rest(model, condensed, mix)
    work = np.asarray(mix @ model.columns.read(state.displacement).T)
    said = np.asarray(mix @ condensed.held.matrix @ mix.T)
    size = np.sqrt(np.outer(np.diagonal(work), np.diagonal(work)))
    return [
        Check(f"{name}: random loads work on each other alike", float(np.max(np.abs(work - work.T) / size)), ALIKE),
        Check(f"{name}: the condensed compliance says what solves say", float(np.max(np.abs(work - said) / size)), ALIKE),
        equilibrium(f"{name}, random loads", model.body, state),
    ]


def balances(model: Model, values: Values) -> list[Check]:
    """Every check of this file at one set of values: of each tissue, and of each rig's indentations on it."""
    instruments = model.instruments
    bodies = [model.solver.condense(model.body, tissue.lame(), model.columns) for tissue in instruments.materials(values)]
    nowhere = jnp.zeros((len(bodies), 0, *bodies[0].held.lame.shape))
    known = settle(instruments.rigs, bodies, model.body, nowhere)
    names = ["/".join(label for _, label in labels) for labels in instruments.variants]
    found: list[Check] = []
    for tissue, condensed in zip(names, bodies, strict=True):
        found += reciprocity(" ".join(["tissue", tissue]).strip(), model, condensed)
    for rig, settled in zip(instruments.rigs, known.rigs, strict=True):
        name, contact = instruments.names[rig.measurement], _pressed(rig, settled, known)
        found += contact_decided(name, contact)
        for variant, condensed in enumerate(bodies):
            cases = np.flatnonzero(np.asarray(rig.variant) == variant)
            if len(cases):
                found += _of_rig(" ".join([name, names[variant]]).strip(), model, rig, condensed, contact, cases)
    return found


def _of_rig(name: str, model: Model, rig: Rig, condensed: AbstractCondensed, contact: Contact, cases: np.ndarray) -> list[Check]:
    forces = np.zeros((len(cases), model.columns.count))
    for row, case in enumerate(cases):
        np.add.at(forces[row], np.asarray(rig.columns[rig.pose[case]]), np.asarray(contact.nodal_forces[case]))
    state = at_rest(model, condensed, jnp.asarray(forces))
    return [
        energy_balance(name, state),
        reaction_balance(name, model.body, state),
        equilibrium(name, model.body, state),
        contact_compliance(name, rig, condensed.held.matrix),
    ]


@eqx.filter_jit
def _pressed(rig: Rig, settled: Settled, known: Known) -> Contact:
    return pressed(rig, settled, known, jnp.zeros((len(known.held), 0)))[0]


def _supports(body: Body) -> np.ndarray:
    """(n, 1 or 3) bool: nodes that do not move, at all or along x, y, z; a carried bone is no support."""
    carried = np.any(np.asarray(body.modes) != 0, axis=(0, 2))
    return (np.asarray(body.moves) == 0) & ~carried[:, None]


def _resultants(body: Body, force: np.ndarray) -> np.ndarray:
    """(k, 6): sum of nodal forces (k, n, 3), and of their moments about the middle over half the body's size."""
    nodes = np.asarray(body.nodes)
    arm = (nodes - nodes.mean(axis=0)) / (0.5 * np.ptp(nodes, axis=0).max())
    return np.concatenate([force.sum(axis=1), np.cross(arm, force).sum(axis=1)], axis=1)


def _flat(fields: Array) -> np.ndarray:
    return np.asarray(fields).reshape(len(fields), -1)


def _size(rows: np.ndarray) -> np.ndarray:
    """Norm of each row, 1 where it is zero: nothing pressed is in balance."""
    norm = np.linalg.norm(rows.reshape(len(rows), -1), axis=1)
    return np.where(norm == 0, 1.0, norm)


def _worst(difference: np.ndarray, whole: np.ndarray) -> float:
    """Largest norm of a row's difference over that of the whole."""
    return float(np.max(np.linalg.norm(difference.reshape(len(difference), -1), axis=1) / _size(whole)))
