"""The tissue beneath the skin changes its volume more, or less, than was taken for granted."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..fem.body import Material
from .effect import Amount, Effect, Size

LAYERS = (2, 3)


class DeepPoisson(Effect):
    """Poisson's ratio moves along ln(1 - 2 nu), in which the bulk modulus at given shear is even."""

    name = "deep_poisson"
    acts_on = "tissue"
    leaves = "Flat loads read too stiff beside sharp ones; the flanks of profiles bulge."
    confused_with = "bed_compliance, nail_compliance."
    parameters = (Size("log_compressibility", "1", 1.0, -2.3, 2.0),)

    def material(self, material: Material, amount: Amount) -> Material:
        ratio = material.poisson_ratio
        for layer in LAYERS:
            spare = (1 - 2 * ratio[layer]) * jnp.expm1(amount["log_compressibility"])
            ratio = ratio.at[layer].add(-0.5 * spare)
        return eqx.tree_at(lambda one: one.poisson_ratio, material, ratio)
