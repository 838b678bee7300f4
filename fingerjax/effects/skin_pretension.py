"""The skin is under tension at rest."""

from __future__ import annotations

from ..fem.body import Body, reinforced
from ..fem.springs import facets, springs, tension
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect, Size


class SkinPretension(Effect):
    """An isotropic tension in the surface: its stiffness against deflection, integral of T grad u . grad u."""

    name = "skin_pretension"
    acts_on = "tissue"
    leaves = "The dip beside the load is wider than any stiffness of the layers makes it."
    confused_with = "stratum_corneum, epidermis_thickness."
    parameters = (Size("tension", "N/mm", 0.005, 0.0, 0.02, sign=1),)

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        pull = float(amount["tension"])
        if pull <= 0.0:
            return body
        cover = springs(pull * tension(facets(finger.nodes, finger.skin), len(finger.nodes)))
        return reinforced(body, cover)
