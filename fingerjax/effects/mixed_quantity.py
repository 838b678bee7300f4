"""The receptor feels not one quantity but a mixture of two."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..measure.receptor import maximum_compressive_strain
from .effect import Amount, Effect, Size
from .needs import rates
from .records import Felt


class MixedQuantity(Effect):
    """Strain energy density and maximum compressive strain, the second scaled to the largest of the first."""

    name = "mixed_quantity"
    acts_on = "afferent"
    leaves = "The rate's course over positions lies between those of two quantities."
    confused_with = "rate_power_law, rate_saturation."
    parameters = (Size("share", "1", 0.3, -0.2, 1.0),)
    absent = staticmethod(rates)

    def feel(self, felt: Felt, amount: Amount) -> Felt:
        other = maximum_compressive_strain(felt.receptor)
        top = jnp.max(jnp.abs(other))
        scaled = other * jnp.max(felt.quantity) / jnp.where(top > 0, top, 1.0)
        return dataclasses.replace(felt, quantity=felt.quantity + amount["share"] * (scaled - felt.quantity))
