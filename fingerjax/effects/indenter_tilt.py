"""A flat indenter leans."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..contact.indenter import FlatCylinder, FlatPlate, Point, Tilted
from .effect import Amount, Effect, Size
from .needs import flat_indenter
from .records import Placed


class IndenterTilt(Effect):
    """A symmetric finger feels no difference to first order: the column is a secant."""

    name = "indenter_tilt"
    acts_on = "contact"
    leaves = "Flat indenters touch earlier and on less skin: too soft at first, then as they should be."
    confused_with = "contact_offset, indenter_shift."
    parameters = (Size("pitch", "rad", 0.05, -0.15, 0.15, step=0.05),)
    absent = staticmethod(flat_indenter)

    def place(self, placed: Placed, amount: Amount) -> Placed:
        if not isinstance(placed.indenter, (FlatPlate, FlatCylinder, Point)):
            return placed
        return dataclasses.replace(placed, indenter=Tilted(placed.indenter, pitch=jnp.asarray(float(amount["pitch"]))))
