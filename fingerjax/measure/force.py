"""What a load cell reads: the normal force, positive in compression."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def normal_force(nodal_forces: Float[Array, "... p"]) -> Float[Array, "..."]:
    """Force in N along +y on the skin, the sum over the pad nodes."""
    return jnp.sum(nodal_forces, axis=-1)
