"""The indenter stood beside the place that was said, along the finger."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from .effect import Amount, Effect, Size
from .needs import not_swept

if TYPE_CHECKING:
    from ..forward.rigs import Plan
    from ..geometry.sections import LayeredSolid


class IndenterShift(Effect):
    """Force and profile rigs alone: under a sweep of positions it is the receptor that is elsewhere."""

    name = "indenter_shift"
    acts_on = "contact"
    leaves = "Profiles lean to one side; forces change as the pad's curvature and the bone beneath it do."
    confused_with = "indenter_tilt, profile_tilt, bone_offset."
    parameters = (Size("along", "mm", 0.5, -1.5, 1.5, step=0.25),)
    absent = staticmethod(not_swept)

    def plan(self, plan: Plan, solid: LayeredSolid, amount: Amount) -> Plan:
        if plan.measurement.kind == "spike_rate":
            return plan
        return dataclasses.replace(plan, origins=plan.origins + np.array([0.0, float(amount["along"])]))
