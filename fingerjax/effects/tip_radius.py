"""The tip of a wedge or probe is blunter than was said."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..contact.indenter import Line, Point
from .effect import Amount, Effect, Size
from .needs import tip
from .records import Placed

SHARPEST = 0.01  # mm


class TipRadius(Effect):
    name = "tip_radius"
    acts_on = "contact"
    leaves = "Sharp indenters read too stiff, and press the skin down over a wider strip, while flat ones are right."
    confused_with = "apparatus_compliance, contact_offset."
    parameters = (Size("wider", "mm", 0.1, -0.1, 0.3, step=0.1),)
    absent = staticmethod(tip)

    def place(self, placed: Placed, amount: Amount) -> Placed:
        wider, indenter = float(amount["wider"]), placed.indenter
        if isinstance(indenter, Line):
            width = jnp.asarray(max(float(indenter.width) + 2 * wider, SHARPEST))
            return dataclasses.replace(placed, indenter=dataclasses.replace(indenter, width=width))
        if isinstance(indenter, Point):
            radius = jnp.asarray(max(float(indenter.radius) + wider, SHARPEST))
            return dataclasses.replace(placed, indenter=dataclasses.replace(indenter, radius=radius))
        return placed
