"""The tip of a wedge or probe is blunter than was said."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..contact.indenter import Line, Point
from .effect import Amount, Data, Effect, Size
from .needs import has_shape, tip
from .records import Placed

SHARPEST = 0.01  # mm


class TipRadius(Effect):
    """A wedge and a probe are ground each on its own, and wear each on its own. An edge that was to be sharp is at
    most blunter; a probe may be thinner too.

    Elements under a wedge may be as wide as its tip, and a little more of it changes nothing there: its column is a secant.
    """

    name = "tip_radius"
    acts_on = "contact"
    leaves = "Sharp indenters read too stiff, and press the skin down over a wider strip, while flat ones are right."
    confused_with = "apparatus_compliance, contact_offset."
    parameters = (Size("wedge_wider", "mm", 0.2, 0.0, 0.6, sign=1, step=0.2), Size("probe_wider", "mm", 0.1, -0.1, 0.3, step=0.1))
    absent = staticmethod(tip)

    def unseen(self, data: Data) -> tuple[str, ...]:
        return tuple(number for number, shape in (("wedge_wider", "line"), ("probe_wider", "point")) if not has_shape(data, (shape,)))

    def place(self, placed: Placed, amount: Amount) -> Placed:
        indenter, wedge, probe = placed.indenter, float(amount["wedge_wider"]), float(amount["probe_wider"])
        if isinstance(indenter, Line) and wedge:
            width = jnp.asarray(float(indenter.width) + 2 * wedge)
            return dataclasses.replace(placed, indenter=dataclasses.replace(indenter, width=width))
        if isinstance(indenter, Point) and probe:
            radius = jnp.asarray(max(float(indenter.radius) + probe, SHARPEST))
            return dataclasses.replace(placed, indenter=dataclasses.replace(indenter, radius=radius))
        return placed
