"""The first contact was found too early or too late."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import imposed_travel
from .records import Push


class ContactOffset(Effect):
    name = "contact_offset"
    acts_on = "contact"
    leaves = "Every depth is off by the same length: forces at small travel are off by a larger share than those at large travel."
    confused_with = "strain_stiffening (both bend the force curve upwards), tip_radius, apparatus_compliance."
    parameters = (Size("offset", "mm", 0.05, -0.2, 0.2),)
    absent = staticmethod(imposed_travel)

    def push(self, push: Push, amount: Amount) -> Push:
        if push.forced:
            return push
        return dataclasses.replace(push, imposed=push.imposed + amount["offset"])
