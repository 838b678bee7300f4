"""Fibres along the finger make the skin stiffer that way."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..fem.body import Body, reinforced
from ..fem.springs import Springs
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect, Size

SKIN = (0, 1)


class Anisotropy(Effect):
    """A stress 2 mu a e_zz along the finger in epidermis and dermis, beside the isotropic one (one fibre family: Spencer 1984)."""

    name = "anisotropy"
    acts_on = "tissue"
    leaves = "The dip under a wedge across the finger is wider along it than one modulus for all directions allows."
    confused_with = "stratum_corneum, epidermis_thickness."
    parameters = (Size("fibres", "1", 0.75, -0.4, 2.25),)

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        fibres = float(amount["fibres"])
        if fibres == 0.0:
            return body
        parts = [_along(body, layer, fibres) for layer in SKIN]
        joined = parts[0] + parts[1]
        return reinforced(body, joined)


def _along(body: Body, layer: int, fibres: float) -> Springs:
    chosen = np.flatnonzero(np.asarray(body.layer) == layer)
    weight = np.asarray(body.weight)[chosen]
    inverse = np.broadcast_to(np.asarray(body.inverse)[chosen], (*weight.shape, 3, 3))
    slope = np.einsum("qak,eqk->eqa", np.asarray(body.slopes), inverse[..., 2])  # d N_a / dz
    local = 2 * fibres * np.einsum("eq,eqa,eqb->eab", weight, slope, slope)
    nodes = 3 * np.asarray(body.tets)[chosen] + 2
    row, column = np.repeat(nodes, nodes.shape[1], axis=1).ravel(), np.tile(nodes, nodes.shape[1]).ravel()
    return Springs(
        jnp.asarray(row, jnp.int32), jnp.asarray(column, jnp.int32), jnp.asarray(local.ravel()), jnp.full(local.size, layer, jnp.int32)
    )
