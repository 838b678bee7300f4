"""The dermis is thicker or thinner than was said."""

from __future__ import annotations

import numpy as np

from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect, Size
from .morph import Radii, on_rays

LAYER = 1


class DermisThickness(Effect):
    """Everywhere by the same share; what lies below it is pushed inwards, and adipose tissue gives way."""

    name = "dermis_thickness"
    acts_on = "finger"
    leaves = "Sharp indenters and flat ones disagree about how stiff the skin is; the skin's dip beside the load is too wide or too narrow."
    confused_with = "epidermis_thickness, depth_gradient; the modulus of the dermis takes most of it up."
    parameters = (Size("share", "1", 0.25, -0.6, 0.75),)

    def lacking(self, finger: Finger) -> str | None:
        return None if {LAYER, LAYER + 1} <= set(finger.layer.tolist()) else "the body has not both layers whose border would move"

    def shape(self, finger: Finger, solid: AbstractSolid, amount: Amount) -> Finger:
        share = float(amount["share"])
        return finger if share == 0.0 else on_rays(finger, solid, lambda radii: _thicker(radii, share))


def _thicker(radii: Radii, share: float) -> Radii:
    moved = radii.copy()
    moved[LAYER + 1 : 3] -= share * (radii[LAYER] - radii[LAYER + 1])
    # Where adipose tissue, and then dermis, would be used up, each keeps a tenth of its thickness.
    moved[2] = np.maximum(moved[2], radii[3] + 0.1 * (radii[2] - radii[3]))
    moved[1] = np.maximum(moved[1], moved[2] + 0.1 * (radii[1] - radii[2]))
    return moved
