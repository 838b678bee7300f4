"""The afferent tires while the skin is held."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from .effect import Amount, Effect, Size
from .needs import timed_rates
from .records import Reading


class RateAdaptation(Effect):
    name = "rate_adaptation"
    acts_on = "afferent"
    leaves = "Rates fall with time under a load that does not."
    confused_with = "relaxation, where the force falls too."
    parameters = (Size("share", "1", 0.4, 0.0, 0.95, sign=1),)
    grid = {"time": (0.03, 0.1, 0.3, 1.0, 3.0)}
    grid_units = {"time": "s"}
    absent = staticmethod(timed_rates)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "spike_rate" or "time" not in reading.context.table:
            return reading
        tired = -jnp.expm1(-reading.context.since_start() / amount["time"])
        return dataclasses.replace(reading, value=reading.value * (1 - amount["share"] * tired))
