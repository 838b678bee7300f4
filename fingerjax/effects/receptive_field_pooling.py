"""The afferent listens to endings spread over the skin, not to one."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from .effect import Amount, Effect, Size
from .needs import swept_rates
from .records import Felt


class ReceptiveFieldPooling(Effect):
    """What is felt is averaged with a Gaussian weight over the positions of the sweep: moving the stimulus stands for moving the ending."""

    name = "receptive_field_pooling"
    acts_on = "afferent"
    leaves = "Peaks and edges of the rate are rounded off: too low at the top, too high beside it."
    confused_with = "rate_saturation, receptor_depth."
    parameters = (Size("radius", "mm", 0.4, 0.0, 1.5, sign=1, step=0.4),)
    absent = staticmethod(swept_rates)

    def feel(self, felt: Felt, amount: Amount) -> Felt:
        context = felt.context
        position, radius = context.table["position"], amount["radius"]
        alike = context.trace[:, None] == context.trace[None, :]
        for name in ("depth", "force"):
            if name in context.table:
                alike &= jnp.abs(context.table[name][:, None] - context.table[name][None, :]) < 1e-9
        away = (position[:, None] - position[None, :]) / jnp.where(radius > 0, radius, 1.0)
        weight = jnp.where(alike, jnp.exp(-0.5 * away**2), 0.0)
        pooled = (weight @ felt.quantity) / jnp.sum(weight, axis=1)
        return dataclasses.replace(felt, quantity=jnp.where(radius > 0, pooled, felt.quantity))
