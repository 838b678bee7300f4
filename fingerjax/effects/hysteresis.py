"""The way back is softer than the way in."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import unloading
from .records import Reading


class Hysteresis(Effect):
    name = "hysteresis"
    acts_on = "time"
    leaves = "Forces on the way out are a constant share below those on the way in, however slow."
    confused_with = "relaxation, force_lag."
    parameters = (Size("share", "1", 0.2, 0.0, 0.8, sign=1),)
    absent = staticmethod(unloading)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if not reading.is_force or "time" not in reading.context.table:
            return reading
        return dataclasses.replace(reading, value=reading.value * (1 - amount["share"] * reading.context.retreating()))
