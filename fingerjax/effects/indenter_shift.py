"""The indenter stood beside the place that was said, along the finger."""

from __future__ import annotations

import dataclasses

import numpy as np

from .effect import Amount, Effect, Size
from .needs import not_swept
from .records import Placed


class IndenterShift(Effect):
    """Force and profile rigs alone: under a sweep of positions it is the receptor that is elsewhere."""

    name = "indenter_shift"
    acts_on = "contact"
    leaves = "Profiles lean to one side; forces change as the pad's curvature and the bone beneath it do."
    confused_with = "indenter_tilt, profile_tilt, bone_offset."
    parameters = (Size("along", "mm", 0.5, -1.5, 1.5, step=0.25),)
    absent = staticmethod(not_swept)

    def place(self, placed: Placed, amount: Amount) -> Placed:
        if placed.kind == "spike_rate":
            return placed
        return dataclasses.replace(placed, origins=placed.origins + np.array([0.0, float(amount["along"])]))
