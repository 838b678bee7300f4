"""The ending lies beside the place from which positions are counted."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from .effect import Amount, Effect, Size
from .needs import swept_rates

if TYPE_CHECKING:
    from ..forward.rigs import Plan
    from ..geometry.sections import LayeredSolid


class ReceptorPosition(Effect):
    name = "receptor_position"
    acts_on = "finger"
    leaves = "The whole course of the rate over positions is shifted to one side."
    confused_with = "indenter_shift."
    parameters = (Size("along", "mm", 0.5, -1.5, 1.5, step=0.1),)
    absent = staticmethod(swept_rates)

    def plan(self, plan: Plan, solid: LayeredSolid, amount: Amount) -> Plan:
        receptor = plan.measurement.receptor
        if receptor is None or plan.measurement.kind != "spike_rate":
            return plan
        moved = dataclasses.replace(receptor, z=receptor.z + amount["along"])
        return dataclasses.replace(plan, measurement=dataclasses.replace(plan.measurement, receptor=moved))
