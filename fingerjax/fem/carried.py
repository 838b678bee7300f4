"""A rigid bone that the tissue carries: six unknowns more, found by six more solves with the bone held.

Let R be the bone's rigid motions, and V = R - K_ff^-1 K_fb R the finger's displacement when the bone makes them and nothing else pushes.
Under loads F, and none on the bone itself but what the tissue brings there,

    u = u_held + V (V' K V)^-1 V' F

because the bone moves until the work of every rigid motion vanishes. Both solvers know held bones only, and need know no more.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .body import Body
from .krylov import Solution
from .stiffness import AbstractStiffness

Fields = Float[Array, "m nodes 3"]


@eqx.filter_jit
def bone_loads(stiffness: AbstractStiffness) -> Float[Array, "modes nodes 3"]:
    """What the bone's rigid motions ask of the tissue around it, N: `-K_fb R`."""
    body = stiffness.body
    if len(body.modes) == 0:
        return body.modes
    return -body.moves * jax.lax.map(stiffness, body.modes)


class Carriage(eqx.Module):
    """How the finger moves with its bone: `motions` V (modes, n, 3), mm, and `stiffness` V'KV (modes, modes), N/mm."""

    motions: Float[Array, "modes nodes 3"]
    stiffness: Float[Array, "modes modes"]

    def complete(self, held: Fields, work: Float[Array, "modes m"]) -> Fields:
        """Displacements with the bone carried, from those with it held and from the work of their loads on the motions."""
        if len(self.motions) == 0:
            return held
        flat = self.motions.reshape(len(self.motions), -1)
        return held + (self.gives(work).T @ flat).reshape(held.shape)

    def gives(self, work: Float[Array, "modes m"]) -> Float[Array, "modes m"]:
        """How far each motion is made by loads that do this work on it."""
        return jnp.linalg.solve(self.stiffness, work) if len(self.motions) else work


@eqx.filter_jit
def carriage(stiffness: AbstractStiffness, held: Fields) -> Carriage:
    """From the displacements (modes, n, 3) that `bone_loads` make with the bone held."""
    V = stiffness.body.modes + held
    if len(V) == 0:
        return Carriage(V, jnp.zeros((0, 0)))
    KV = jax.lax.map(stiffness, V)
    between = V.reshape(len(V), -1) @ KV.reshape(len(V), -1).T
    return Carriage(V, (between + between.T) / 2)


@eqx.filter_jit
def let_go(stiffness: AbstractStiffness, loads: Fields, held: Solution) -> Solution:
    """Displacements with the bone carried, from those with it held, which were found under m `loads` and then under `bone_loads`."""
    modes = len(stiffness.body.modes)
    if modes == 0:
        return held
    bone = carriage(stiffness, held.displacement[-modes:])
    work = bone.motions.reshape(modes, -1) @ loads.reshape(len(loads), -1).T
    return Solution(
        bone.complete(held.displacement[:-modes], work),
        jnp.maximum(held.iterations[:-modes], held.iterations[-modes:].max()),
        jnp.maximum(held.residual[:-modes], held.residual[-modes:].max()),
        held.converged[:-modes] & held.converged[-modes:].all(),
    )


def admissible(body: Body, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """The nearest displacement that leaves the nail alone and moves the bone as one piece; orthogonal, so also what of a load works."""
    own = body.moves * u
    if len(body.modes) == 0:
        return own
    flat = body.modes.reshape(len(body.modes), -1)
    return own + ((flat @ u.reshape(-1)) @ flat).reshape(u.shape)
