"""The camera, or the finger under it, is tilted: a straight line lies under every profile."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import profile
from .records import Reading


class ProfileTilt(Effect):
    name = "profile_tilt"
    acts_on = "instrument"
    leaves = "A straight line in the distance from the load, the same at every depth: up on one side, down on the other."
    confused_with = "indenter_tilt, bone_offset along the finger."
    parameters = (Size("slope", "mm/mm", 0.01, -0.05, 0.05),)
    absent = staticmethod(profile)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "deflection_profile":
            return reading
        return dataclasses.replace(reading, value=reading.value + amount["slope"] * reading.context.table["distance"])
