"""A flat indenter leans."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from ..contact.indenter import FlatCylinder, FlatPlate, Point, Tilted
from .effect import Amount, Data, Effect, Size
from .needs import flat_indenter, has_shape
from .records import Placed


class IndenterTilt(Effect):
    """Plates and thinner probes are mounted each on their own: one may lean where the other does not.

    A symmetric finger feels no difference to first order: the columns are secants.
    """

    name = "indenter_tilt"
    acts_on = "contact"
    leaves = "Flat indenters touch earlier and on less skin: too soft at first, then as they should be."
    confused_with = "contact_offset, indenter_shift, finite_strain, anisotropy."
    parameters = (Size("plate_pitch", "rad", 0.05, -0.15, 0.15, step=0.05), Size("probe_pitch", "rad", 0.05, -0.15, 0.15, step=0.05))
    absent = staticmethod(flat_indenter)

    def unseen(self, data: Data) -> tuple[str, ...]:
        leaning = {"plate_pitch": ("flat_plate",), "probe_pitch": ("flat_cylinder", "point")}
        return tuple(number for number, shapes in leaning.items() if not has_shape(data, shapes))

    def place(self, placed: Placed, amount: Amount) -> Placed:
        pitch = float(amount["plate_pitch" if isinstance(placed.indenter, FlatPlate) else "probe_pitch"])
        if not pitch or not isinstance(placed.indenter, (FlatPlate, FlatCylinder, Point)):
            return placed
        return dataclasses.replace(placed, indenter=Tilted(placed.indenter, pitch=jnp.asarray(pitch)))
