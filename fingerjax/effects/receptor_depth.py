"""The ending lies deeper or shallower than was said."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import rates
from .records import Placed


class ReceptorDepth(Effect):
    name = "receptor_depth"
    acts_on = "finger"
    leaves = "Edges of the stimulus are sharper, or rounder, in the rate than they should be."
    confused_with = "receptive_field_pooling, skin_poisson."
    parameters = (Size("deeper", "mm", 0.15, -0.4, 0.5, step=0.05),)
    absent = staticmethod(rates)

    def place(self, placed: Placed, amount: Amount) -> Placed:
        return dataclasses.replace(placed, deeper=placed.deeper + float(amount["deeper"]))
