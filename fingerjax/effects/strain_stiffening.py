"""Tissue stiffens with strain, in the skin or beneath it."""

from __future__ import annotations

import jax.numpy as jnp

from ..fem.tissue import AbstractTissue, Exponential, FiniteStrain
from .effect import Amount, Effect, Size


class StrainStiffening(Effect):
    """Exponential law of Fung (1967) with exponent b, at finite strain: the two come together in soft tissue."""

    name = "strain_stiffening"
    acts_on = "tissue"
    leaves = "Force grows faster than contact makes it grow: too small moduli fit gentle pushes, too large ones deep pushes."
    confused_with = "contact_offset (both bend the force curve), apparatus_compliance with the other sign, bone_offset."
    parameters = (Size("skin", "1", 5.0, 0.0, 20.0, sign=1, step=1.0), Size("deep", "1", 5.0, 0.0, 20.0, sign=1, step=1.0))

    def law(self, law: AbstractTissue, amount: Amount) -> AbstractTissue:
        skin, deep = float(amount["skin"]), float(amount["deep"])
        if skin <= 0.0 and deep <= 0.0:
            return law
        finite = law if isinstance(law, FiniteStrain) else FiniteStrain(jnp.asarray(1.0))
        return Exponential(finite, jnp.asarray([skin, skin, deep, deep, 0.0]))
