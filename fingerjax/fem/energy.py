"""The energy of a strained body under any tissue law, and its derivatives: the internal force, and the material's stiffness at each point.

    Pi(u) = sum over quadrature points of  w W(grad u)  +  u' S u / 2,     f = dPi/du,     K = d2Pi/du2

with the springs S of films, beds and fibres, which stay linear. The law is differentiated at each point, where it has nine arguments;
the sums over elements are those of the linear operator. Energy and force are asked for at every step of a search, so they are found
together, with arithmetic running along the points of all elements.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .body import Body
from .operator import Lame, accumulate, displacement_gradient, spring_force
from .tissue import AbstractTissue, volume_growth


def _everywhere(of_point: Callable[..., Array], body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Array:
    """A function of displacement gradient, Lame parameters and layer, at every quadrature point."""
    of_element = jax.vmap(of_point, in_axes=(0, None, None))
    return jax.vmap(of_element)(displacement_gradient(body, u), lame[:, body.layer].T, body.layer)


def density(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "elements points"]:
    """Energy per undeformed volume at every quadrature point, MPa."""
    return _everywhere(tissue.density, body, lame, u)


def total_energy(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """Elastic energy, N mm, at displacements (n, 3), mm, that of springs among it."""
    return jnp.sum(body.weight * density(body, tissue, lame, u)) + 0.5 * jnp.sum(u * spring_force(body, lame, u))


def internal_force(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """The slope of the energy: nodal forces, N, that hold the displacement `u`; on supports these are the reactions."""
    return energy_and_force(body, tissue, lame, u)[1]


def energy_and_force(
    body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]
) -> tuple[Float[Array, ""], Float[Array, "nodes 3"]]:
    """`total_energy` and `internal_force` in one pass."""
    (points, corners), elements, axes = body.slopes.shape[:2], len(body.layer), range(3)
    of_points = jax.vmap(jax.value_and_grad(tissue.density), in_axes=(2, 1, 0), out_axes=(0, 2))
    stored, stress = of_points(*_along(body, lame, u))
    weight, inverse = body.weight_along, body.inverse_along
    pull = jax.lax.optimization_barrier(stress.reshape(3, 3, points, elements) * weight)
    pulled = jnp.stack([jnp.stack([sum(pull[i, j] * inverse[:, k, j] for j in axes) for i in axes], axis=1) for k in axes], axis=1)
    forces = (_reference(body).T @ pulled.reshape(3 * points, -1)).reshape(corners, 3, elements)
    sprung = spring_force(body, lame, u)
    energy = jnp.sum(weight * stored.reshape(points, elements)) + 0.5 * jnp.sum(u * sprung)
    return energy, accumulate(body, jnp.transpose(forces, (2, 0, 1))) + sprung


def _reference(body: Body) -> Float[Array, "points_3 corners"]:
    return jnp.swapaxes(body.slopes, 1, 2).reshape(-1, body.slopes.shape[1])


def _along(body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> tuple[Float[Array, "3 3 p"], Float[Array, "2 p"], Int[Array, " p"]]:
    """Displacement gradient, Lame parameters and layer of all quadrature points, which come last: point by point, elements innermost."""
    (points, corners), axes = body.slopes.shape[:2], range(3)
    moved = jnp.swapaxes(u[body.tets.T], 1, 2)  # a node, i direction, e element
    seen = (_reference(body) @ moved.reshape(corners, -1)).reshape(points, 3, 3, -1)  # q point, k reference axis, i, e
    seen, inverse = jax.lax.optimization_barrier(seen), body.inverse_along
    gradient = jnp.stack([jnp.stack([sum(seen[:, k, i] * inverse[:, k, j] for k in axes) for j in axes]) for i in axes])
    layer = jnp.tile(body.layer, points)
    return jax.lax.optimization_barrier(gradient).reshape(3, 3, -1), lame[:, layer], layer


def moduli(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "elements points 3 3 3 3"]:
    """d stress_ij / d gradient_kl at every quadrature point, MPa: the first Piola-Kirchhoff stress's, geometric part included.

    One direction of the gradient after the other: four times as fast as `jax.hessian` of each point.
    """
    gradient, each, layer = _along(body, lame, u)

    def stress(gradient: Float[Array, "3 3 p"]) -> Float[Array, "3 3 p"]:
        return jax.vmap(jax.grad(tissue.density), in_axes=(2, 1, 0), out_axes=2)(gradient, each, layer)

    def towards(way: Float[Array, "3 3"]) -> Float[Array, "3 3 p"]:
        return jax.jvp(stress, (gradient,), (jnp.broadcast_to(way[..., None], gradient.shape),))[1]

    columns = jax.lax.map(towards, jnp.eye(9).reshape(9, 3, 3)).reshape(3, 3, 3, 3, -1, len(body.layer))
    return jnp.transpose(columns, (5, 4, 2, 3, 0, 1))


def smallest_volume(body: Body, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """The smallest det F at any quadrature point: how far tissue is squeezed, and below 0 where an element is turned inside out."""
    return 1.0 + jnp.min(jax.vmap(jax.vmap(volume_growth))(displacement_gradient(body, u)))
