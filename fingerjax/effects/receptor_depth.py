"""The ending lies deeper or shallower than was said."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from .effect import Amount, Effect, Size
from .needs import rates

if TYPE_CHECKING:
    from ..forward.rigs import Plan
    from ..geometry.sections import LayeredSolid


class ReceptorDepth(Effect):
    name = "receptor_depth"
    acts_on = "finger"
    leaves = "Edges of the stimulus are sharper, or rounder, in the rate than they should be."
    confused_with = "receptive_field_pooling, skin_poisson."
    parameters = (Size("deeper", "mm", 0.15, -0.4, 0.5, step=0.05),)
    absent = staticmethod(rates)

    def plan(self, plan: Plan, solid: LayeredSolid, amount: Amount) -> Plan:
        receptor = plan.measurement.receptor
        if receptor is None or plan.measurement.kind != "spike_rate":
            return plan
        moved = dataclasses.replace(receptor, depth=receptor.depth + amount["deeper"])
        return dataclasses.replace(plan, measurement=dataclasses.replace(plan.measurement, receptor=moved))
