"""A thin stiff film covers the skin."""

from __future__ import annotations

from ..fem.body import Body, reinforced
from ..fem.springs import facets, film, springs
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect, Size

POISSON_RATIO = 0.4


class StratumCorneum(Effect):
    """A membrane of stiffness E t that follows the skin; it bends freely."""

    name = "stratum_corneum"
    acts_on = "tissue"
    leaves = "The skin bridges over sharp indenters: their dip is wider, while flat ones are hardly stiffer."
    confused_with = "epidermis_thickness, anisotropy; the modulus of the epidermis takes most of it up."
    # A weak film follows the skin; a stiff one bridges over it, which the slope at none does not tell.
    parameters = (Size("membrane_stiffness", "N/mm", 0.05, 0.0, 0.15, sign=1, step=0.02),)

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        stiffness = float(amount["membrane_stiffness"])
        if stiffness <= 0.0:
            return body
        cover = springs(stiffness * film(facets(finger.nodes, finger.skin), len(finger.nodes), POISSON_RATIO))
        return reinforced(body, cover)
