"""Strains and turns are not small."""

from __future__ import annotations

import jax.numpy as jnp

from ..fem.tissue import AbstractTissue, Exponential, FiniteStrain
from .effect import Amount, Effect, Size


class FiniteStrainEffect(Effect):
    """From Hooke's law at 0 to compressible neo-Hookean kinematics at 1: strains and turns count that many times."""

    name = "finite_strain"
    acts_on = "tissue"
    leaves = "Deep indentations are stiffer, and the skin bulges less, than small-strain elasticity has it."
    confused_with = "strain_stiffening, contact_offset."
    parameters = (Size("homotopy", "1", 0.5, 0.0, 1.0, sign=1),)

    def law(self, law: AbstractTissue, amount: Amount) -> AbstractTissue:
        share = jnp.asarray(amount["homotopy"], float)
        if isinstance(law, Exponential):
            return Exponential(FiniteStrain(share), law.stiffening)
        return FiniteStrain(share)
