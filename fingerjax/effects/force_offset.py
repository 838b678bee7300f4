"""The load cell was not at zero."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import force_read
from .records import Reading


class ForceOffset(Effect):
    name = "force_offset"
    acts_on = "instrument"
    leaves = "The same force is missing from, or added to, every reading, at rest too."
    confused_with = "adhesion, contact_offset where forces are small."
    parameters = (Size("offset", "N", 0.01, -0.03, 0.03),)
    absent = staticmethod(force_read)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        return dataclasses.replace(reading, value=reading.value + amount["offset"]) if reading.is_force else reading
