"""Tissue stiffens with strain, in the skin or beneath it."""

from __future__ import annotations

import jax.numpy as jnp

from ..fem.tissue import AbstractTissue, Exponential, FiniteStrain
from .effect import Amount, Effect, Size


class StrainStiffening(Effect):
    """Exponential law of Fung (1967) with exponent b; large strains come with it, complete where b is above two."""

    name = "strain_stiffening"
    acts_on = "tissue"
    leaves = "Force grows faster than contact makes it grow: too small moduli fit gentle pushes, too large ones deep pushes."
    confused_with = "contact_offset (both bend the force curve), apparatus_compliance with the other sign, bone_offset."
    parameters = (Size("skin", "1", 5.0, 0.0, 15.0, sign=1, step=5.0), Size("deep", "1", 5.0, 0.0, 15.0, sign=1, step=5.0))

    def law(self, law: AbstractTissue, amount: Amount) -> AbstractTissue:
        skin, deep = jnp.asarray(amount["skin"], float), jnp.asarray(amount["deep"], float)
        large = jnp.tanh(skin + deep)
        finite = FiniteStrain(jnp.maximum(large, law.homotopy) if isinstance(law, FiniteStrain) else large)
        return Exponential(finite, jnp.stack([skin, skin, deep, deep, jnp.zeros(())]))
