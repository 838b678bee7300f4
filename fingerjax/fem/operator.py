"""What the stiffness does to a displacement, without ever forming it: gather, strain, stress, accumulate.

    K(lambda, mu) u = sum over elements of  integral  grad N . (lambda tr(eps) I + 2 mu eps),   eps = sym grad u

With `dilatation="mean"`, tr(eps) stands for its mean over the element in the first term: pressure is then constant in each element.

The stiffness is affine in the Lame parameters of the layers, so they enter per element inside compiled code, and the derivative of
`K u` with respect to them is the same operator with other numbers.
"""

from __future__ import annotations

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
    """Nodal forces, N, that hold the displacement `u`, mm; on supports these are the reactions. Linear in the moduli.

    Between two products with the reference gradients, which are one dense matrix for all elements, everything runs along the elements;
    each direction is an array of its own, since XLA leaves a loop over two joined dimensions unvectorised.
    """
    points, corners = body.slopes.shape[:2]
    reference = jnp.swapaxes(body.slopes, 1, 2).reshape(3 * points, corners)
    moved = jnp.moveaxis(u[body.tets.T], 2, 0)  # i direction, a node, e element
    gradient = [(reference @ each).reshape(points, 3, -1) for each in moved]  # of each direction i: q, k reference axis, e
    forces = [reference.T @ pulled.reshape(3 * points, -1) for pulled in _pulled_back(body, lame, gradient)]
    elastic = accumulate(body, jnp.swapaxes(jnp.stack(forces, axis=2), 0, 1))
    springs = body.springs
    return elastic if springs is None else elastic + springs.force(springs.at(lame, fixed=False), u)


def spring_force(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """Nodal forces, N, of all springs beside the elements, those among them that do not follow the moduli too."""
    springs = body.springs
    return jnp.zeros_like(u) if springs is None else springs.force(springs.at(lame), u)


def _pulled_back(body: Body, lame: Lame, gradient: list[Float[Array, "points 3 elements"]]) -> list[Float[Array, "points 3 elements"]]:
    """Stress times weight, seen along the reference axes (q, k, e) for each direction i, from the displacement's reference gradient."""
    inverse, axes = body.inverse_along, range(3)
    volumetric, shear = (part[body.layer] * body.weight_along for part in lame)
    G = [[sum(gradient[i][:, k] * inverse[:, k, j] for k in axes) for j in axes] for i in axes]
    trace = G[0][0] + G[1][1] + G[2][2]
    if body.dilatation == "mean":
        trace = jnp.sum(body.weight_along * trace, axis=0) / jnp.sum(body.weight_along, axis=0)
    S = [[shear * (G[i][j] + G[j][i]) + (volumetric * trace if i == j else 0.0) for j in axes] for i in axes]
    return [sum(S[i][j][:, None] * inverse[:, :, j] for j in axes) for i in axes]


def accumulate(body: Body, rows: Float[Array, "elements corners 3"]) -> Float[Array, "nodes 3"]:
    """The sum at each node of what its elements give it."""
    return jnp.zeros((len(body.free), 3), rows.dtype).at[body.tets].add(rows)


def nodal_forces(body: Body, stress: Float[Array, "elements points 3 3"]) -> Float[Array, "nodes 3"]:
    """Nodal forces, N, in balance with a stress, MPa, at every quadrature point."""
    weighted = stress * body.weight[..., None, None]
    reference = jnp.einsum("eqij,eqkj->eqik", weighted, jnp.broadcast_to(body.inverse, (*body.weight.shape, 3, 3)))
    return accumulate(body, jnp.einsum("qak,eqik->eai", body.slopes, reference))


def apply(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """`internal_force` between nodes that are free to move: zero in, and zero out, on supports."""
    moves = body.moves
    return moves * internal_force(body, lame, moves * u)


def strain_energy(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """Elastic energy, N mm."""
    gradient = displacement_gradient(body, u)
    return 0.5 * jnp.sum(body.weight[..., None, None] * stress(body, lame, gradient) * gradient)
