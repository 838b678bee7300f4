"""Fluid leaves the loaded tissue: force falls as the square root of time before it levels off."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from .effect import Amount, Effect, Size
from .needs import timed_force
from .records import Reading


class PoroelasticDrift(Effect):
    """share sqrt(t/tau) / (1 + sqrt(t/tau)) of the force is lost: the early and late limits of a draining layer (Biot 1941), joined."""

    name = "poroelastic_drift"
    acts_on = "time"
    leaves = "A loss of force that begins steeply and goes on for a long time, without an end in sight."
    confused_with = "relaxation, force_drift."
    parameters = (Size("share", "1", 0.3, 0.0, 0.9, sign=1),)
    grid = {"time": (1.0, 10.0, 100.0)}
    grid_units = {"time": "s"}
    absent = staticmethod(timed_force)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if not reading.is_force or "time" not in reading.context.table:
            return reading
        since = reading.context.since_start()
        begun = since > 0  # a root has no slope at zero
        root = jnp.where(begun, jnp.sqrt(jnp.where(begun, since, 1.0) / amount["time"]), 0.0)
        return dataclasses.replace(reading, value=reading.value * (1 - amount["share"] * root / (1 + root)))
