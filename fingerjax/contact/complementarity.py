"""Unilateral contact between a linear body and a rigid shape, solved exactly.

Find forces f >= 0 with gaps  g = C f - (overlap + travel)  >= 0  and  f_j g_j = 0, where C is the compliance
between contact unknowns (symmetric positive definite). Either the travel is given, or the total force is and
the travel is found with it.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

PATIENCE = 8  # block exchanges without progress before single exchanges begin
TINY = 1e-12  # forces and gaps smaller than this share of the largest have no sign


class Complementary(eqx.Module):
    """Forces (k,) in N, gaps (k,) and travel in mm, the active set, solves taken, and whether it settled."""

    force: Float[Array, " k"]
    gap: Float[Array, " k"]
    travel: Float[Array, ""]
    active: Bool[Array, " k"]
    steps: Int[Array, ""]
    settled: Bool[Array, ""]


def complementary(
    compliance: Float[Array, "k k"],
    overlap: Float[Array, " k"],
    present: Bool[Array, " k"],
    *,
    travel: Float[Array, ""] | None = None,
    force: Float[Array, ""] | None = None,
    start: Bool[Array, " k"] | None = None,
    max_steps: int = 500,
) -> Complementary:
    """Solve the contact problem at a given `travel` in mm or a given total `force` in N.

    All violated members change sides together; where that makes no progress, one at a time, the last first,
    which is finite for every positive definite matrix (Judice & Pires 1994; Murty 1974). Under force control
    the travel follows from each active set at once; in the careful phase it waits until contact has settled
    at the last travel, and then moves by Newton's rule, which ends because force is a growing, piecewise
    linear function of travel.

    **Arguments:** `compliance` in mm/N; `overlap` in mm at no travel; `present` marks unknowns that exist;
    `start`, an active set to begin from. Derivatives, forward and reverse, go through one solve on the final
    active set, which is held.
    """
    problem = jax.lax.stop_gradient((compliance, overlap, travel, force))
    active, steps, settled = _settle(problem, present, start, max_steps)
    forces, gap, travel = _on(active, present, compliance, overlap, travel, force)
    return Complementary(forces, gap, travel, active, steps, settled)


def held(
    compliance: Float[Array, "k k"], overlap: Float[Array, " k"], travel: Float[ArrayLike, ""]
) -> Complementary:
    """The same with every unknown that the indenter overlaps glued to it: tension allowed, one solve."""
    active = jax.lax.stop_gradient(overlap + travel > 0)
    forces, gap, travel = _on(active, active, compliance, overlap, jnp.asarray(travel), None)
    return Complementary(forces, gap, travel, active, jnp.asarray(1), jnp.asarray(True))


def masked_solve(
    matrix: Float[Array, "k k"], active: Bool[Array, " k"], right: Float[Array, "k m"]
) -> Float[Array, "k m"]:
    """Solve the active block of a symmetric positive definite matrix; inactive rows give 0."""
    both = active[:, None] & active[None, :]
    block = jnp.where(both, matrix, jnp.eye(len(active)))
    factor = jax.scipy.linalg.cho_factor(jax.lax.stop_gradient(block), lower=True)
    masked = jnp.where(active[:, None], right, 0.0)
    # Cholesky itself is not differentiated: the linear solve is, which costs one more pair of triangular
    # solves.
    return jax.lax.custom_linear_solve(
        lambda x: block @ x, masked, lambda _, b: jax.scipy.linalg.cho_solve(factor, b), symmetric=True
    )


def _on(
    active: Bool[Array, " k"],
    present: Bool[Array, " k"],
    compliance: Float[Array, "k k"],
    overlap: Float[Array, " k"],
    travel: Float[Array, ""] | None,
    force: Float[Array, ""] | None,
    hold: Float[Array, ""] | None = None,
) -> tuple[Float[Array, " k"], Float[Array, " k"], Float[Array, ""]]:
    """Forces, gaps and travel when exactly `active` touch; `hold` keeps the travel though force is given."""
    both = masked_solve(compliance, active, jnp.stack([overlap, jnp.ones_like(overlap)], axis=1))
    if force is None:
        assert travel is not None
        now = travel
    else:
        wanted = (force - jnp.sum(both[:, 0])) / jnp.sum(both[:, 1])
        now = wanted if hold is None else jnp.where(jnp.isnan(hold), wanted, hold)
    forces = both[:, 0] + now * both[:, 1]
    gap = jnp.where(present, compliance @ forces - overlap - now, 0.0)
    return jnp.where(active, forces, 0.0), jnp.where(active, 0.0, gap), now


class _State(eqx.Module):
    active: Bool[Array, " k"]
    best: Int[Array, ""]
    patience: Int[Array, ""]
    hold: Float[Array, ""]  # travel kept in the careful phase, NaN before it
    steps: Int[Array, ""]
    done: Bool[Array, ""]


def _settle(
    problem: tuple[Float[Array, "k k"], Float[Array, " k"], Float[Array, ""] | None, Float[Array, ""] | None],
    present: Bool[Array, " k"],
    start: Bool[Array, " k"] | None,
    max_steps: int,
) -> tuple[Bool[Array, " k"], Int[Array, ""], Bool[Array, ""]]:
    """The active set, by exchanging violated members, the number of solves, and whether none is violated."""
    compliance, overlap, travel, force = problem
    k = overlap.shape[0]
    top = jnp.arange(k) == jnp.argmax(jnp.where(present, overlap, -jnp.inf))
    if start is None:
        start = present if travel is None else overlap + travel > 0
    state = _State(
        active=(start & present) | (top & present),
        best=jnp.asarray(k + 1),
        patience=jnp.asarray(PATIENCE),
        hold=jnp.asarray(jnp.nan),
        steps=jnp.asarray(0),
        done=~jnp.any(present),
    )

    def violated(state: _State) -> tuple[Bool[Array, " k"], Float[Array, " k"], Float[Array, ""]]:
        forces, gap, now = _on(state.active, present, compliance, overlap, travel, force, state.hold)
        tension = state.active & (forces < -TINY * jnp.max(jnp.abs(forces)))
        inside = present & ~state.active & (gap < -TINY * (jnp.max(jnp.abs(overlap)) + jnp.abs(now)))
        return tension | inside, forces, now

    def step(state: _State) -> _State:
        wrong, forces, now = violated(state)
        count = jnp.sum(wrong)
        better = count < state.best
        best = jnp.minimum(count, state.best)
        patience = jnp.where(better, PATIENCE, jnp.maximum(state.patience - 1, 0))
        last = wrong & (jnp.cumsum(wrong[::-1])[::-1] == 1)
        active = state.active ^ jnp.where(patience > 0, wrong, last)
        hold, done = state.hold, count == 0
        if force is not None:
            # An empty set carries no force; the careful phase is entered when blocks stop helping and left
            # only by Newton's rule.
            active = jnp.where(jnp.any(active), active, top)
            careful = ~jnp.isnan(hold)
            short = careful & (jnp.abs(jnp.sum(forces) - force) > 1e-11 * jnp.abs(force))
            _, _, wanted = _on(state.active, present, compliance, overlap, None, force)
            hold = jnp.where(done & short, wanted, jnp.where(~done & ~careful & (patience == 0), now, hold))
            best, done = jnp.where(done & short, k + 1, best), done & ~short
        return _State(active, best, patience, hold, state.steps + 1, done)

    state = jax.lax.while_loop(lambda s: ~s.done & (s.steps < max_steps), step, state)
    return state.active, state.steps, state.done
