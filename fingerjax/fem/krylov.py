"""Preconditioned conjugate gradients with a stop on the relative norm and a residual that is measured, not carried along."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Field = Float[Array, "nodes 3"]


class Solution(eqx.Module):
    """One displacement and how it was reached.

    `residual` is the norm of `load - K u` recomputed at the end, relative to the load; `converged` compares that with the tolerance.
    """

    displacement: Float[Array, "*batch nodes 3"]
    iterations: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]
    converged: Bool[Array, "*batch"]


class _State(eqx.Module):
    u: Field
    r: Field
    p: Field
    rz: Float[Array, ""]
    step: Int[Array, ""]


def conjugate_gradients(
    apply: Callable[[Field], Field],
    precondition: Callable[[Field], Field],
    load: Field,
    *,
    start: Field | None = None,
    tolerance: float,
    max_steps: int,
) -> Solution:
    """Solve `K u = load` for a symmetric positive definite `K` (Hestenes & Stiefel, 1952), from `start`, zero where None.

    Stops when the norm of the residual falls to `tolerance` times that of the load, or after `max_steps`. A load of zero is answered
    with zero. Lineax's own stop compares entry by entry and would call a load that is zero on most nodes converged at once.
    """
    scale = jnp.linalg.norm(load)
    goal = tolerance * scale
    zero = jnp.zeros_like(load)
    begin = (zero, load) if start is None else (start, load - apply(start))
    first = _State(*begin, zero, jnp.ones(()), jnp.asarray(0))

    def running(state: _State) -> Bool[Array, ""]:
        return (jnp.linalg.norm(state.r) > goal) & (state.step < max_steps)

    # The first direction comes from the same line as the others, so that the preconditioner is compiled once.
    def advance(state: _State) -> _State:
        z = precondition(state.r)
        rz = jnp.vdot(state.r, z)
        p = z + (rz / state.rz) * state.p
        Kp = apply(p)
        alpha = rz / jnp.vdot(p, Kp)
        return _State(state.u + alpha * p, state.r - alpha * Kp, p, rz, state.step + 1)

    final = jax.lax.while_loop(running, advance, first)
    residual = jnp.linalg.norm(load - apply(final.u)) / jnp.where(scale > 0, scale, 1.0)
    # The recurrence drifts from the truth by rounding; ten times the goal is drift, more is failure.
    return Solution(final.u, final.step, residual, residual <= 10 * tolerance)
