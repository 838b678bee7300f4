"""A flat indenter leans."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from ..contact.indenter import FlatCylinder, FlatPlate, Point, Tilted
from .effect import Amount, Effect, Size
from .needs import flat_indenter

if TYPE_CHECKING:
    from ..forward.rigs import Plan
    from ..geometry.sections import LayeredSolid


class IndenterTilt(Effect):
    """A symmetric finger feels no difference to first order: the column is a secant."""

    name = "indenter_tilt"
    acts_on = "contact"
    leaves = "Flat indenters touch earlier and on less skin: too soft at first, then as they should be."
    confused_with = "contact_offset, indenter_shift."
    parameters = (Size("pitch", "rad", 0.05, -0.15, 0.15, step=0.05),)
    absent = staticmethod(flat_indenter)

    def plan(self, plan: Plan, solid: LayeredSolid, amount: Amount) -> Plan:
        if not isinstance(plan.indenter, (FlatPlate, FlatCylinder, Point)):
            return plan
        return dataclasses.replace(plan, indenter=Tilted(plan.indenter, pitch=float(amount["pitch"])))
