"""The energy of a strained body under any tissue law, and its derivatives: the internal force, and the material's stiffness at each point.

    Pi(u) = sum over quadrature points of  w W(grad u),     f = dPi/du,     K = d2Pi/du2

The law is differentiated at each point, where it has nine arguments; the sums over elements are those of the linear operator.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .body import Body
from .operator import Lame, displacement_gradient, nodal_forces
from .tissue import AbstractTissue, volume_growth


def _everywhere(of_point: Callable[..., Array], body: Body, lame: Lame, u: Float[Array, "nodes 3"]) -> Array:
    """A function of displacement gradient, Lame parameters and layer, at every quadrature point."""
    of_element = jax.vmap(of_point, in_axes=(0, None, None))
    return jax.vmap(of_element)(displacement_gradient(body, u), lame[:, body.layer].T, body.layer)


def density(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "elements points"]:
    """Energy per undeformed volume at every quadrature point, MPa."""
    return _everywhere(tissue.density, body, lame, u)


def total_energy(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """Elastic energy, N mm, at displacements (n, 3), mm."""
    return jnp.sum(body.weight * density(body, tissue, lame, u))


def internal_force(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    """The slope of the energy: nodal forces, N, that hold the displacement `u`; on supports these are the reactions."""
    return nodal_forces(body, _everywhere(jax.grad(tissue.density), body, lame, u))


def moduli(body: Body, tissue: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "elements points 3 3 3 3"]:
    """d stress_ij / d gradient_kl at every quadrature point, MPa: the first Piola-Kirchhoff stress's, geometric part included."""
    return _everywhere(jax.hessian(tissue.density), body, lame, u)


def smallest_volume(body: Body, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """The smallest det F at any quadrature point: how far tissue is squeezed, and below 0 where an element is turned inside out."""
    return 1.0 + jnp.min(jax.vmap(jax.vmap(volume_growth))(displacement_gradient(body, u)))
