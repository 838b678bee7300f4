"""The afferent fires without a stimulus."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import rates
from .records import Reading


class SpontaneousRate(Effect):
    name = "spontaneous_rate"
    acts_on = "afferent"
    leaves = "The same rate is added everywhere, also where the skin is not touched."
    confused_with = "a lower threshold."
    parameters = (Size("rate", "Hz", 3.0, 0.0, 15.0, sign=1),)
    absent = staticmethod(rates)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "spike_rate":
            return reading
        return dataclasses.replace(reading, value=reading.value + amount["rate"])
