"""The ending lies beside the place from which positions are counted."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import swept_rates
from .records import Placed


class ReceptorPosition(Effect):
    name = "receptor_position"
    acts_on = "finger"
    leaves = "The whole course of the rate over positions is shifted to one side."
    confused_with = "indenter_shift."
    parameters = (Size("along", "mm", 0.5, -1.5, 1.5, step=0.1),)
    absent = staticmethod(swept_rates)

    def place(self, placed: Placed, amount: Amount) -> Placed:
        return dataclasses.replace(placed, along=placed.along + float(amount["along"]))
