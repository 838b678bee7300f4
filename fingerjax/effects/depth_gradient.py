"""The tissue beneath the skin grows stiffer, or softer, towards the bone."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..fem.body import Body
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from ..layers import BONE
from .effect import Amount, Effect, Size

DERMIS_INNER = 2  # the outer surface of adipose tissue


class DepthGradient(Effect):
    """Moduli of adipose tissue and fibrous matrix times 1 + g (2 d - 1), d from 0 beneath the dermis to 1 at the bone."""

    name = "depth_gradient"
    acts_on = "tissue"
    leaves = "Stations far from the load, and deep indentations, disagree with near and shallow ones about the deep layers."
    confused_with = "the moduli of adipose tissue and fibrous matrix, bone_offset."
    parameters = (Size("gradient", "1", 0.35, -0.9, 0.9),)

    def lacking(self, finger: Finger) -> str | None:
        deep = (finger.layer >= DERMIS_INNER) & (finger.layer < BONE)
        return None if deep.any() else "nothing lies beneath the skin"

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        gradient = float(amount["gradient"])
        if gradient == 0.0:
            return body
        middle = finger.nodes[finger.tets[:, :4]].mean(axis=1)
        centre, radii = solid.rays(middle)
        outer, inner = radii[DERMIS_INNER], radii[BONE]
        depth = np.clip((outer - np.linalg.norm(middle[:, :2] - centre, axis=1)) / np.maximum(outer - inner, 1e-9), 0.0, 1.0)
        deep = (finger.layer >= DERMIS_INNER) & (finger.layer < BONE)
        factor = np.where(deep, 1 + gradient * (2 * depth - 1), 1.0)
        return eqx.tree_at(lambda one: one.weight_along, body, body.weight_along * jnp.asarray(factor))
