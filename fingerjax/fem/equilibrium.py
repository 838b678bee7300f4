"""Where a body of nonlinear tissue comes to rest: Newton's method, in as many steps of the load as it needs.

    f(u) = p,        K(u) du = p - f(u),        K = df/du

A load step begins with the tangent's answer to all of it; iterations are shortened until the energy falls enough (Armijo, 1966). Where a
law does not hold its energy is no number, and where nothing falls there is no use in going on: the load step is then halved. What pushes
is an object: nodal forces here, an indenter in `contact.strained`. At the equilibrium, the implicit rule

    K du = - (df/dtheta) dtheta

says how everything moves with the material, for one solve each.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._results import RESULTS
from .body import Body
from .carried import admissible
from .cholesky import Indefinite
from .energy import internal_force, smallest_volume, total_energy
from .krylov import Field
from .operator import Lame
from .solver import AbstractSolver, Fields
from .stiffness import Tangent, tangent
from .tissue import AbstractTissue

ENOUGH = 1e-4  # share of the fall promised by the slope that an iteration must bring (Nocedal & Wright, 2006, section 3.1)
SLACK = 1e-8  # share of the energy below which a rise is the solver's tolerance, not the wrong way
SHORTEST = 2.0**-8  # share of an iteration below which the load step is cut instead


class State(eqx.Module):
    """Displacements (n, 3), mm, the nodal forces (n, 3), N, that push, and an indenter's travel, mm.

    `detail` is whatever else the load knows of it: a contact.
    """

    displacement: Float[Array, "*batch nodes 3"]
    force: Float[Array, "*batch nodes 3"]
    travel: Float[Array, "*batch"]
    detail: Any = None

    def towards(self, other: State, share: float) -> State:
        """A part of the way to another state."""
        if share == 1.0:
            return other
        parts = (self.displacement, other.displacement), (self.force, other.force), (self.travel, other.travel)
        u, force, travel = (a + share * (b - a) for a, b in parts)
        return State(u, force, travel, self.detail)


class Tissue(eqx.Module):
    """A body, the law of its tissue, the Lame parameters (2, layers), MPa, and the solver that undoes its tangents."""

    body: Body
    law: AbstractTissue
    lame: Lame
    solver: AbstractSolver

    def at_rest(self) -> State:
        """Nothing pushes, nothing moved."""
        return State(jnp.zeros(self.body.nodes.shape), jnp.zeros(self.body.nodes.shape), jnp.zeros(()))

    def near(self, state: State, force: Field) -> Near:
        """The tissue linearised where it bears an internal force (n, 3), N."""
        return Near(tangent(self.body, self.law, self.lame, state.displacement), force, self.solver)


class Near(eqx.Module):
    """Tissue near a state: its tangent there, and the internal force (n, 3), N."""

    tangent: Tangent
    force: Field
    solver: AbstractSolver

    def undo(self, loads: Fields) -> Fields | None:
        """Displacements (m, n, 3), mm, under small loads, N; None where the tangent has no answer."""
        found = self.solver.undo(self.tangent, loads)
        return found.displacement if bool(found.converged.all()) else None


class AbstractLoading(eqx.Module):
    """What pushes."""

    @property
    @abstractmethod
    def moves(self) -> bool:
        """Whether it imposes a motion, not a force: the first answer to a load step must then be taken whole."""

    @abstractmethod
    def answer(self, near: Near, state: State, start: State, share: float) -> State | None:
        """Where linearised tissue rests under a share of the way from the load of `start` to this one; None where it cannot be told."""

    @abstractmethod
    def work(self, state: State, goal: State) -> Float[Array, ""]:
        """Work, N mm, of the goal's load on a state, linear in the state: at rest, energy less work is stationary."""

    @abstractmethod
    def respond(self, near: Near, state: State, loads: Fields) -> State | None:
        """How an equilibrium changes, to first order, under each of a few more small loads (d, n, 3), N; None where it cannot be told."""

    def settled(self, state: State) -> bool:
        """Whether what the load knows of the state is decided."""
        return True


class NodalForces(AbstractLoading):
    """Nodal forces (n, 3), N, that keep their size and direction. On a rigid bone they push the bone."""

    force: Field

    @property
    def moves(self) -> bool:
        return False

    def answer(self, near: Near, state: State, start: State, share: float) -> State | None:
        now = start.force + share * (self.force - start.force)
        step = near.undo((now - near.force)[None])
        return None if step is None else State(state.displacement + step[0], now, state.travel)

    def work(self, state: State, goal: State) -> Float[Array, ""]:
        return jnp.vdot(goal.force, state.displacement)

    def respond(self, near: Near, state: State, loads: Fields) -> State | None:
        moved = near.undo(loads)
        return None if moved is None else State(moved, jnp.zeros_like(loads), jnp.zeros(len(loads)))


class Newton(eqx.Module):
    """How equilibrium is looked for.

    - `tolerance`: on the norm of the force that is left over, relative to that of the load.
    - `iterations`: more than these in one load step, and it is halved. `steps`: load steps to begin with.
    - `smallest`: share of the whole load; where steps must be smaller, the search ends.
    """

    tolerance: float = eqx.field(static=True, default=1e-9)
    iterations: int = eqx.field(static=True, default=25)
    steps: int = eqx.field(static=True, default=1)
    smallest: float = eqx.field(static=True, default=2.0**-7)


class Equilibrium(eqx.Module):
    """How the search ended. Where `result` is not ok, the state is the last equilibrium on the way, at the share `reached` of the load.

    - `energy`: N mm. `residual`: norm of the force left over at the state, relative to the load's. `smallest_volume`: least det F.
    - `iterations`: in all; `steps`: load steps that were completed; `cuts`: that were halved.
    - `history`: residuals in the last load step, completed or not.
    """

    state: State
    energy: Float[Array, ""]
    residual: Float[Array, ""]
    smallest_volume: Float[Array, ""]
    reached: float = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    cuts: int = eqx.field(static=True)
    history: tuple[float, ...] = eqx.field(static=True)
    result: RESULTS = eqx.field(static=True)


class _Measured(eqx.Module):
    """What is recomputed at every state: energy, internal force, residual."""

    energy: Float[Array, ""]
    force: Field
    residual: Float[Array, ""]

    @property
    def sound(self) -> bool:
        return bool(jnp.isfinite(self.energy) & jnp.all(jnp.isfinite(self.force)))


@eqx.filter_jit
def _measured(tissue: Tissue, state: State) -> _Measured:
    body, law, lame = tissue.body, tissue.law, tissue.lame
    force = internal_force(body, law, lame, state.displacement)
    scale = jnp.linalg.norm(admissible(body, state.force))
    left = jnp.linalg.norm(admissible(body, state.force - force))
    return _Measured(total_energy(body, law, lame, state.displacement), force, left / jnp.where(scale > 0, scale, 1.0))


def find(tissue: Tissue, loading: AbstractLoading, newton: Newton | None = None, start: State | None = None) -> Equilibrium:
    """The equilibrium under a load, followed from `start` (at rest where None). Outside of compiled code only.

    A load step that fails is halved; after one that does not, the next is twice as long again.
    """
    newton = Newton() if newton is None else newton
    start = tissue.at_rest() if start is None else start
    state, reached, step = start, 0.0, 1.0 / newton.steps
    iterations, steps, cuts, result = 0, 0, 0, RESULTS.successful
    history: tuple[float, ...] = ()
    while reached < 1.0 and result.ok:
        to = min(1.0, reached + step)
        found, history, ended = _load_step(tissue, loading, newton, state, start, to)
        iterations += len(history)
        if ended.ok:
            state, reached, steps, step = found, to, steps + 1, min(2 * step, 1.0 / newton.steps)
        else:
            cuts, step = cuts + 1, step / 2
            result = ended if step < newton.smallest else RESULTS.successful
    at, least = _measured(tissue, state), smallest_volume(tissue.body, state.displacement)
    return Equilibrium(state, at.energy, at.residual, least, reached, iterations, steps, cuts, history, result)


def _load_step(
    tissue: Tissue, loading: AbstractLoading, newton: Newton, state: State, start: State, share: float
) -> tuple[State, tuple[float, ...], RESULTS]:
    """Newton's iterations at one share of the load, from the equilibrium before; their residuals, and how they ended."""
    at = _measured(tissue, state)
    history: list[float] = []
    for iteration in range(newton.iterations):
        try:
            goal = loading.answer(tissue.near(state, at.force), state, start, share)
        except Indefinite:
            goal = None
        if goal is None:
            return state, tuple(history), RESULTS.no_equilibrium
        if not loading.settled(goal):
            return state, tuple(history), RESULTS.contact_did_not_settle
        taken = _as_far_as_sound(tissue, loading, state, at, goal, whole=loading.moves and iteration == 0)
        if taken is None:
            return state, tuple(history), RESULTS.no_equilibrium
        state, at = taken
        history.append(float(at.residual))
        if state is goal and history[-1] <= newton.tolerance:
            return state, tuple(history), RESULTS.successful
    return state, tuple(history), RESULTS.no_equilibrium


def _as_far_as_sound(
    tissue: Tissue, loading: AbstractLoading, state: State, at: _Measured, goal: State, *, whole: bool
) -> tuple[State, _Measured] | None:
    """The goal of an iteration, or a part of the way there at which the energy has fallen enough; None where there is none."""
    promised = jnp.vdot(at.force, goal.displacement - state.displacement) - (loading.work(goal, goal) - loading.work(state, goal))
    before, share = at.energy - loading.work(state, goal), 1.0
    while share >= (1.0 if whole else SHORTEST):
        there = state.towards(goal, share)
        now = _measured(tissue, there)
        fall = now.energy - loading.work(there, goal) - before
        if now.sound and (whole or fall <= ENOUGH * share * promised + SLACK * now.energy):
            return there, now
        share /= 2
    return None


def slopes(
    tissue: Tissue,
    loading: AbstractLoading,
    state: State,
    material: Callable[[Float[Array, " d"]], tuple[AbstractTissue, Lame]],
    values: Float[Array, " d"],
) -> State:
    """How an equilibrium changes with the parameters of its material, for a load that stays: a state's slopes, (d, n, 3), (d, n, 3), (d,).

    `material` makes the law and the Lame parameters of `values`, those of the equilibrium. One solve for each parameter. NaN where the
    tangent has no answer.
    """
    force, slope = _forces(tissue.body, material, values, state.displacement)
    try:
        found = loading.respond(tissue.near(state, force), state, -slope)
    except Indefinite:
        found = None
    return State(jnp.nan * slope, jnp.nan * slope, jnp.nan * values) if found is None else found


@eqx.filter_jit
def _forces(body: Body, material: Callable, values: Float[Array, " d"], u: Field) -> tuple[Field, Float[Array, "d nodes 3"]]:
    def force(values: Float[Array, " d"]) -> Field:
        law, lame = material(values)
        return internal_force(body, law, lame, u)

    return force(values), jnp.moveaxis(jax.jacfwd(force)(values), -1, 0)
