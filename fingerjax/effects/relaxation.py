"""Stress fades while the skin is held: quasi-linear viscoelasticity with one or two times."""

from __future__ import annotations

import dataclasses

from .effect import Amount, Column, Effect, Size
from .needs import timed_force
from .records import Reading

TIMES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)


class Relaxation(Effect):
    """F(t) = integral of g(t - s) dF_elastic(s), g(t) = 1 - sum share_i (1 - exp(-t/tau_i)) (Fung 1981, chapter 7).

    The moduli are the instant ones.
    """

    name = "relaxation"
    acts_on = "time"
    leaves = "Force falls while travel is held; slow ramps read softer than fast ones."
    confused_with = "poroelastic_drift, force_lag, hysteresis."
    parameters = (Size("share", "1", 0.3, 0.0, 0.9, sign=1),)
    grid = {"time": TIMES}
    grid_units = {"time": "s"}
    absent = staticmethod(timed_force)

    def second(self) -> tuple[Column, ...]:
        size = dataclasses.replace(self.parameters[0], name="second_share")
        return tuple(Column(size, {"second_time": time}) for time in TIMES)

    def null(self) -> dict[str, float]:
        return super().null() | {"second_share": 0.0, "second_time": TIMES[0]}

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if not reading.is_force or "time" not in reading.context.table:
            return reading
        value, context = reading.value, reading.context
        for share, time in (("share", "time"), ("second_share", "second_time")):
            lost = reading.value - context.fading(reading.value, amount[time], from_rest=True)
            value = value - amount[share] * lost
        return dataclasses.replace(reading, value=value)
