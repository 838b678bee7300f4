"""Skin sticks to the indenter: to first order, the work of adhesion that every new square millimetre of contact gives.

At a given travel d the energy of body and contact is Pi(d) - w A(d), and the contact area A stands where Pi is least, so that to first
order in w its own change does not count (Johnson, Kendall & Roberts 1971, whose sphere needs pi R w less force than Hertz's):

    F = F_0 - w dA/dd,        d = d_0 + w dA/dF   where the force is imposed.

How the area grows is read off from the depths, or forces, of the same place that are in the data. What adhesion does to a profile or a
receptor beside the contact is not known to this order. Nothing is remembered of the way: skin that holds on while it is withdrawn says
"much", not how much. Slopes by the material take the force that would close a gap as it is: what they leave out, per e-fold of a modulus,
is less than this effect's own share of the reading.
"""

from __future__ import annotations

import dataclasses

from .effect import Amount, Effect, Size
from .needs import force
from .records import Reading

N_PER_MM = 1e-3  # of one N/m


class Adhesion(Effect):
    name = "adhesion"
    acts_on = "contact"
    leaves = "Force is missing in proportion to how fast the area grows with travel: wide blunt indenters lose the most, flat ends none."
    confused_with = "force_offset (under spheres the same), contact_offset, tip_radius."
    parameters = (Size("work", "N/m", 0.5, 0.0, 10.0, sign=1),)
    absent = staticmethod(force)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if reading.context.kind != "force_displacement":
            return reading
        given = N_PER_MM * amount["work"] * reading.growth
        return dataclasses.replace(reading, value=reading.value + given if reading.context.forced else reading.value - given)
