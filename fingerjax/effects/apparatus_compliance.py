"""The apparatus gives way: part of the travel is not the skin's."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import pushing
from .records import Push


class ApparatusCompliance(Effect):
    name = "apparatus_compliance"
    acts_on = "contact"
    leaves = "Travel is lost in proportion to force: stiff and deep indentations read too soft, gentle ones hardly."
    confused_with = "tip_radius, nail_compliance and bed_compliance, where the finger as a whole gives way."
    parameters = (Size("compliance", "mm/N", 0.5, 0.0, 1.5, sign=1),)
    absent = staticmethod(pushing)

    def push(self, push: Push, amount: Amount) -> Push:
        return dataclasses.replace(push, series=push.series + amount["compliance"])
