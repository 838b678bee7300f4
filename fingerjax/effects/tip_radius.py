"""The tip of a wedge or probe is blunter than was said."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from ..contact.indenter import Line, Point
from .effect import Amount, Effect, Size
from .needs import tip

if TYPE_CHECKING:
    from ..forward.rigs import Plan
    from ..geometry.sections import LayeredSolid


class TipRadius(Effect):
    name = "tip_radius"
    acts_on = "contact"
    leaves = "Sharp indenters read too stiff, and press the skin down over a wider strip, while flat ones are right."
    confused_with = "apparatus_compliance, contact_offset."
    parameters = (Size("wider", "mm", 0.1, -0.1, 0.3, step=0.1),)
    absent = staticmethod(tip)

    def plan(self, plan: Plan, solid: LayeredSolid, amount: Amount) -> Plan:
        wider, indenter = float(amount["wider"]), plan.indenter
        if isinstance(indenter, Line):
            width = float(indenter.width) + 2 * wider
            return dataclasses.replace(plan, indenter=dataclasses.replace(indenter, width=max(width, 0.01)))
        if isinstance(indenter, Point):
            return dataclasses.replace(plan, indenter=dataclasses.replace(indenter, radius=max(float(indenter.radius) + wider, 0.01)))
        return plan
