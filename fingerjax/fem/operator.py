"""What the stiffness does to a displacement, without ever forming it: gather, strain, stress, accumulate.

    K(lambda, mu) u = sum over elements of  integral  grad N . (lambda tr(eps) I + 2 mu eps),   eps = sym grad u

With `dilatation="mean"`, tr(eps) stands for its mean over the element in the first term: pressure is then constant in each element.

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


def dilatation(body: Body, gradient: Float[Array, "elements points 3 3"]) -> Float[Array, "elements points"]:
    """Change of volume that the tissue resists by Lame's first parameter: at every point, or the mean of the element at all of its."""
    trace = jnp.trace(gradient, axis1=2, axis2=3)
    if body.dilatation == "pointwise":
        return trace
    mean = jnp.sum(body.weight * trace, axis=1) / jnp.sum(body.weight, axis=1)
    return jnp.broadcast_to(mean[:, None], trace.shape)


def stress(body: Body, lame: Lame, gradient: Float[Array, "elements points 3 3"]) -> Float[Array, "elements points 3 3"]:
    """Cauchy stress at every quadrature point, MPa."""
    lam, mu = lame[:, body.layer]
    symmetric = gradient + jnp.swapaxes(gradient, 2, 3)
    return (lam[:, None] * dilatation(body, gradient))[..., None, None] * jnp.eye(3) + mu[:, None, None, None] * symmetric


def internal_force(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """Nodal forces, N, that hold the displacement `u`, mm; on supports these are the reactions.

    Between two products with the reference gradients, which are one dense matrix for all elements, everything runs along the elements.
    """
    points, corners = body.slopes.shape[:2]
    reference = jnp.swapaxes(body.slopes, 1, 2).reshape(3 * points, corners)
    moved = jnp.swapaxes(u[body.tets.T], 1, 2)  # a node, i direction, e element
    gradient = (reference @ moved.reshape(corners, -1)).reshape(points, 3, 3, -1)  # q point, k reference axis, i, e
    pulled = _pulled_back(body, lame, gradient).reshape(3 * points, -1)
    forces = (reference.T @ pulled).reshape(corners, 3, -1)
    return body.incidence.accumulate(jnp.transpose(forces, (2, 0, 1)).reshape(-1, 3))


def _pulled_back(body: Body, lame: Lame, gradient: Float[Array, "points 3 3 elements"]) -> Float[Array, "points 3 3 elements"]:
    """Stress times weight, seen along the reference axes (q, k, i, e), from the displacement's reference gradient."""
    inverse, axes = body.inverse_along, range(3)
    volumetric, shear = (part[body.layer] * body.weight_along for part in lame)
    G = [[sum(gradient[:, k, i] * inverse[:, k, j] for k in axes) for j in axes] for i in axes]
    trace = G[0][0] + G[1][1] + G[2][2]
    if body.dilatation == "mean":
        trace = jnp.sum(body.weight_along * trace, axis=0) / jnp.sum(body.weight_along, axis=0)
    pressure = volumetric * trace
    S = [[shear * (G[i][j] + G[j][i]) + (pressure if i == j else 0.0) for j in axes] for i in axes]
    return jnp.stack([jnp.stack([sum(S[i][j] * inverse[:, k, j] for j in axes) for i in axes], axis=1) for k in axes], axis=1)


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
    volumetric = outer
    if body.dilatation == "mean":
        total = jnp.einsum("eq,eqai->eai", body.weight, slope)
        volumetric = jnp.einsum("eai,eaj->eaij", total, total) / jnp.sum(body.weight, axis=1)[:, None, None, None]
    blocks = lam[:, None, None, None] * volumetric + mu[:, None, None, None] * (outer + square)
    summed = jax.vmap(body.incidence.accumulate, in_axes=1, out_axes=1)(blocks.reshape(-1, 3, 3))
    free = body.free[:, None, None]
    return free * summed + (1 - free) * jnp.eye(3)
