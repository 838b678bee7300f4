"""The load cell's zero moves with time."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import timed_force
from .records import Reading


class ForceDrift(Effect):
    name = "force_drift"
    acts_on = "instrument"
    leaves = "A straight line in time under every force, whether the skin is loaded or not."
    confused_with = "poroelastic_drift and relaxation where only one load is held."
    parameters = (Size("rate", "N/s", 1e-3, -3e-3, 3e-3),)
    absent = staticmethod(timed_force)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if not reading.is_force or "time" not in reading.context.table:
            return reading
        return dataclasses.replace(reading, value=reading.value + amount["rate"] * reading.context.since_start())
