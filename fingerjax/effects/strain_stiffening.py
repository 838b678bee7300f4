"""Tissue stiffens with strain, in the skin or beneath it."""

from __future__ import annotations

import jax.numpy as jnp

from ..fem.tissue import AbstractTissue, Exponential
from .effect import Amount, Effect, Size


class StrainStiffening(Effect):
    """Exponential law of Fung (1967) with exponent b, on whatever strain measure the tissue has beside it.

    Skin becomes some 18 times as stiff before it tears; where that takes a stretch of a quarter, b is about 30. Strains at which tissue
    stiffens are not small, so that finite strain comes with it.
    """

    name = "strain_stiffening"
    acts_on = "tissue"
    leaves = "Force grows faster than contact makes it grow: too small moduli fit gentle pushes, too large ones deep pushes."
    confused_with = "finite_strain, contact_offset (both bend the force curve), apparatus_compliance with the other sign, bone_offset."
    comes_with = ("finite_strain",)
    parameters = (Size("skin", "1", 10.0, 0.0, 30.0, sign=1), Size("deep", "1", 10.0, 0.0, 30.0, sign=1))

    def law(self, law: AbstractTissue, amount: Amount) -> AbstractTissue:
        skin, deep = jnp.asarray(amount["skin"], float), jnp.asarray(amount["deep"], float)
        return Exponential(law, jnp.stack([skin, skin, deep, deep, jnp.zeros(())]))
