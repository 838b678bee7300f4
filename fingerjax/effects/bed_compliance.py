"""The cut end of the finger is held by the rest of the finger, which the free cut leaves out."""

from __future__ import annotations

from ..fem.body import Body, reinforced
from ..fem.springs import bed, faces_on, facets, springs
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect, Size


class BedCompliance(Effect):
    """An elastic bed under the proximal cut, as stiff as tissue of the finger's own thickness would be; zero is the free cut."""

    name = "bed_compliance"
    acts_on = "support"
    leaves = "The finger as a whole is stiffer, or softer, against loads near its cut end than against loads near its tip."
    confused_with = "nail_compliance, deep_poisson."
    # The first bit of a bed does most of what a stiff one does: the slope at none at all foretells many times what a
    # plausible one leaves.
    parameters = (Size("stiffness", "MPa/mm", 0.01, 0.0, 0.03, sign=1, step=0.005),)

    def lacking(self, finger: Finger) -> str | None:
        return None if finger.proximal.any() else "the body has no cut end"

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        stiffness = float(amount["stiffness"])
        if stiffness <= 0.0:
            return body
        cut = faces_on(finger.tets, finger.proximal)
        behind = springs(stiffness * bed(facets(finger.nodes, cut), len(finger.nodes)))
        return reinforced(body, behind)
