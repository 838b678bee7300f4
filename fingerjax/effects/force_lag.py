"""The force is read through a filter: it comes late."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from .effect import Amount, Effect, Size
from .needs import timed_force
from .records import Reading


class ForceLag(Effect):
    """A first-order filter, F + tau dF/dt = F_true, exact for forces that change linearly between rows."""

    name = "force_lag"
    acts_on = "instrument"
    leaves = "Too little force while it rises, too much while it falls, none of it while it is held."
    confused_with = "hysteresis, relaxation with a short time."
    parameters = (Size("time", "s", 0.05, 0.0, 0.15, sign=1),)
    absent = staticmethod(timed_force)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if not reading.is_force or "time" not in reading.context.table:
            return reading
        late, context = amount["time"] > 0, reading.context
        behind = context.fading(reading.value, jnp.where(late, amount["time"], 1.0), from_rest=False)
        at_first = amount["time"] * context.speed(reading.value)  # what `behind` begins as
        return dataclasses.replace(reading, value=reading.value - jnp.where(late, behind, at_first))
