"""The afferent cannot fire faster than some rate."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import rates
from .records import Reading


class RateSaturation(Effect):
    name = "rate_saturation"
    acts_on = "afferent"
    leaves = "Large rates fall short, small ones do not."
    confused_with = "receptive_field_pooling, rate_power_law with an exponent below one."
    parameters = (Size("slowing", "s", 0.003, 0.0, 0.02, sign=1),)
    absent = staticmethod(rates)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "spike_rate":
            return reading
        return dataclasses.replace(reading, value=reading.value / (1 + amount["slowing"] * reading.value))
