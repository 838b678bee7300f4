"""The load cell reads a constant share too much or too little."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import force
from .records import Push, Reading


class ForceGain(Effect):
    name = "force_gain"
    acts_on = "instrument"
    leaves = "Nothing, as a rule: all moduli take the factor up. Only a modulus known from elsewhere gives it away."
    confused_with = "all moduli together."
    parameters = (Size("gain", "1", 0.1, -0.3, 0.3),)
    absent = staticmethod(force)

    def push(self, push: Push, amount: Amount) -> Push:
        return dataclasses.replace(push, imposed=push.imposed / (1 + amount["gain"])) if push.forced else push

    def read(self, reading: Reading, amount: Amount) -> Reading:
        return dataclasses.replace(reading, value=reading.value * (1 + amount["gain"])) if reading.is_force else reading
