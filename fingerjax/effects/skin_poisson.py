"""Epidermis and dermis change their volume more, or less, than was taken for granted."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..fem.body import Material
from .effect import Amount, Effect, Size

LAYERS = (0, 1)


class SkinPoisson(Effect):
    """Poisson's ratio moves along ln(1 - 2 nu), in which the bulk modulus at given shear is even."""

    name = "skin_poisson"
    acts_on = "tissue"
    leaves = "The skin's bulge beside the load is too high or too low."
    confused_with = "receptor_depth, deep_poisson."
    parameters = (Size("log_compressibility", "1", 1.0, -2.3, 2.0),)

    def material(self, material: Material, amount: Amount) -> Material:
        ratio = material.poisson_ratio
        for layer in LAYERS:
            spare = (1 - 2 * ratio[layer]) * jnp.expm1(amount["log_compressibility"])
            ratio = ratio.at[layer].add(-0.5 * spare)
        return eqx.tree_at(lambda one: one.poisson_ratio, material, ratio)
