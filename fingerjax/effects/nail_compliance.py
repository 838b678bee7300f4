"""The nail is not fixed: it rests on an elastic bed, alike in all directions."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..fem.body import Body, reinforced
from ..fem.springs import bed, facets, springs
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect, Size


class NailCompliance(Effect):
    name = "nail_compliance"
    acts_on = "support"
    leaves = "The whole finger gives way under flat and deep loads, and profiles sink as a whole; gentle and sharp loads hardly notice."
    confused_with = "bed_compliance, apparatus_compliance, deep_poisson."
    # A bed that hardly gives does so at the rim of the nail alone, where tractions are largest: the slope there tells nothing of others.
    parameters = (Size("compliance", "mm/MPa", 75.0, 0.0, 225.0, sign=1, step=10.0),)

    def lacking(self, finger: Finger) -> str | None:
        return None if finger.nail.any() else "no face of the body is held"

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        compliance = float(amount["compliance"])
        if compliance <= 0.0:
            return body
        nail = finger.skin[finger.nail[finger.skin].all(axis=1)]
        under = springs(bed(facets(finger.nodes, nail), len(finger.nodes)) / compliance)
        freed = jnp.where(jnp.asarray(finger.nail), 1.0, body.free)
        return reinforced(eqx.tree_at(lambda one: one.free, body, freed), under)
