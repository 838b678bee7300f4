"""The camera's scale is off."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import profile
from .records import Reading


class CameraScale(Effect):
    name = "camera_scale"
    acts_on = "instrument"
    leaves = "Every deflection is off by the same share, also beneath the indenter, where it should be the depth itself."
    confused_with = "contact_offset, as far as depths are alike."
    parameters = (Size("scale", "1", 0.03, -0.1, 0.1),)
    absent = staticmethod(profile)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "deflection_profile":
            return reading
        return dataclasses.replace(reading, value=reading.value * (1 + amount["scale"]))
