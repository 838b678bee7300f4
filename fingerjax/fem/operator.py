"""What the stiffness does to a displacement, without ever forming it: gather, strain, stress, accumulate.

    K(lambda, mu) u = sum over elements of  integral  grad N . (lambda tr(eps) I + 2 mu eps),   eps = sym grad u

The stiffness is affine in the Lame parameters of the layers, so they enter per element inside compiled code, and the derivative of
`K u` with respect to them is the same operator with other numbers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .body import Body

Lame = Float[Array, "2 layers"]


def displacement_gradient(body: Body, u: Float[Array, "nodes 3"]) -> Float[Array, "elements points 3 3"]:
    """du_i/dx_j at every quadrature point."""
    # e element, q point, a node, i displacement, k reference axis, j space
    reference = jnp.einsum("qak,eai->eqik", body.slopes, u[body.tets])
    return jnp.einsum("eqik,eqkj->eqij", reference, jnp.broadcast_to(body.inverse, (*body.weight.shape, 3, 3)))


def stress(body: Body, lame: Lame, gradient: Float[Array, "elements points 3 3"]) -> Float[Array, "elements points 3 3"]:
    """Cauchy stress at every quadrature point, MPa."""
    lam, mu = lame[:, body.layer]
    trace = jnp.trace(gradient, axis1=2, axis2=3)
    symmetric = gradient + jnp.swapaxes(gradient, 2, 3)
    return (lam[:, None] * trace)[..., None, None] * jnp.eye(3) + mu[:, None, None, None] * symmetric


def internal_force(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """Nodal forces, N, that hold the displacement `u`, mm; on supports these are the reactions."""
    return nodal_forces(body, stress(body, lame, displacement_gradient(body, u)))


def nodal_forces(body: Body, stress: Float[Array, "elements points 3 3"]) -> Float[Array, "nodes 3"]:
    """Nodal forces, N, in balance with a stress, MPa, at every quadrature point."""
    weighted = stress * body.weight[..., None, None]
    reference = jnp.einsum("eqij,eqkj->eqik", weighted, jnp.broadcast_to(body.inverse, (*body.weight.shape, 3, 3)))
    forces = jnp.einsum("qak,eqik->eai", body.slopes, reference)
    return body.incidence.accumulate(forces.reshape(-1, 3))


def apply(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """`internal_force` between nodes that are free to move: zero in, and zero out, on supports."""
    free = body.free[:, None]
    return free * internal_force(body, lame, free * u)


def strain_energy(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """Elastic energy, N mm."""
    gradient = displacement_gradient(body, u)
    return 0.5 * jnp.sum(body.weight[..., None, None] * stress(body, lame, gradient) * gradient)


def diagonal_blocks(body: Body, lame: Lame) -> Float[Array, "nodes 3 3"]:
    """The 3 x 3 block of the stiffness at each node; the identity on supports."""
    lam, mu = lame[:, body.layer]
    slope = jnp.einsum("qak,eqkj->eqaj", body.slopes, jnp.broadcast_to(body.inverse, (*body.weight.shape, 3, 3)))
    outer = jnp.einsum("eq,eqai,eqaj->eaij", body.weight, slope, slope)
    square = jnp.trace(outer, axis1=2, axis2=3)[..., None, None] * jnp.eye(3)
    blocks = (lam + mu)[:, None, None, None] * outer + mu[:, None, None, None] * square
    summed = jax.vmap(body.incidence.accumulate, in_axes=1, out_axes=1)(blocks.reshape(-1, 3, 3))
    free = body.free[:, None, None]
    return free * summed + (1 - free) * jnp.eye(3)
