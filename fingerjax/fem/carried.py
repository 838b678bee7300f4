"""A rigid bone that the tissue carries: six unknowns more, found by six more solves with the bone held.

Let R be the bone's rigid motions, and V = R - K_ff^-1 K_fb R the finger's displacement when the bone makes them and nothing else pushes.
Under loads B, and none on the bone itself but what the tissue brings there,

    X = X_held + V (V' K V)^-1 V' B

because the bone moves until the work of every rigid motion vanishes. Both solvers know held bones only, and need know no more.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .body import Body
from .krylov import Solution
from .operator import Lame, internal_force


@runtime_checkable
class Loads(Protocol):
    """Loads that tell the work they do."""

    def read(self, u: Float[Array, "modes nodes 3"]) -> Float[Array, "modes m"]:
        """The work, N mm, of each load on each displacement."""
        ...


class NodalForces(eqx.Module):
    """Loads written out: (m, nodes, 3), N."""

    forces: Float[Array, "m nodes 3"]

    def read(self, u: Float[Array, "modes nodes 3"]) -> Float[Array, "modes m"]:
        return u.reshape(len(u), -1) @ self.forces.reshape(len(self.forces), -1).T


@eqx.filter_jit
def bone_loads(body: Body, lame: Lame) -> Float[Array, "modes nodes 3"]:
    """What the bone's rigid motions ask of the tissue around it, N: `-K_fb R`."""
    if len(body.modes) == 0:
        return body.modes
    return -body.free[:, None] * jax.lax.map(lambda mode: internal_force(body, lame, mode), body.modes)


@eqx.filter_jit
def let_go(body: Body, lame: Lame, loads: Loads, held: Solution) -> Solution:
    """Displacements with the bone carried, from those with it held, which were found under m `loads` and then under `bone_loads`."""
    modes = len(body.modes)
    if modes == 0:
        return held
    u, V = held.displacement[:-modes], body.modes + held.displacement[-modes:]
    KV = jax.lax.map(lambda v: internal_force(body, lame, v), V)
    flat = V.reshape(modes, -1)
    stiffness = flat @ KV.reshape(modes, -1).T
    motion = jnp.linalg.solve((stiffness + stiffness.T) / 2, loads.read(V))
    return Solution(
        u + (motion.T @ flat).reshape(u.shape),
        jnp.maximum(held.iterations[:-modes], held.iterations[-modes:].max()),
        jnp.maximum(held.residual[:-modes], held.residual[-modes:].max()),
        held.converged[:-modes] & held.converged[-modes:].all(),
    )


def admissible(body: Body, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """The nearest displacement that leaves the nail alone and moves the bone as one piece; orthogonal, so also what of a load works."""
    own = body.free[:, None] * u
    if len(body.modes) == 0:
        return own
    flat = body.modes.reshape(len(body.modes), -1)
    return own + ((flat @ u.reshape(-1)) @ flat).reshape(u.shape)
