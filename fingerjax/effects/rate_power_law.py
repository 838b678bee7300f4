"""Rate grows as a power of what is felt above threshold (Stevens 1957)."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from .effect import Amount, Effect, Size
from .needs import rates
from .records import Reading

TYPICAL = 50.0  # Hz: the rate that stays as it is


class RatePowerLaw(Effect):
    name = "rate_power_law"
    acts_on = "afferent"
    leaves = "Rates bend against what is felt: middling ones too high and large ones too low, or the other way round."
    confused_with = "rate_saturation, receptive_field_pooling, mixed_quantity."
    parameters = (Size("exponent_beyond_one", "1", 0.3, -0.7, 1.0),)
    absent = staticmethod(rates)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "spike_rate":
            return reading
        firing = reading.value > 0
        relative = jnp.where(firing, reading.value, TYPICAL) / TYPICAL
        bent = reading.value * jnp.exp(amount["exponent_beyond_one"] * jnp.log(relative))
        return dataclasses.replace(reading, value=jnp.where(firing, bent, reading.value))
