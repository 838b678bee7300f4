"""The tip of a line: too narrow for facets to resolve, so that it has quadrature and hats of its own along its length."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .indenter import Line
from .locate import locate
from .pad import Pad

NO_SKIN = 1e3  # mm: clearance of a station that has no skin over it

_ALONG, _ACROSS = np.polynomial.legendre.leggauss(4), np.polynomial.legendre.leggauss(3)


class Stations(eqx.Module):
    """Quadrature along and across the tip of a line: m points, b = 2 hats at each."""

    facet: Int[Array, " m"]
    shape: Float[Array, "m 6"]
    weight: Float[Array, " m"]
    hats: Int[Array, "m 2"]
    values: Float[Array, "m 2"]
    clearance: Float[Array, " m"]
    count: int = eqx.field(static=True)


def stations(pad: Pad, line: Line, origin: Any) -> Stations:
    """Points on the tip: hats a little coarser than nodes, four Gauss points between, three across."""
    (low, high), pieces = (pad.box[:2], pad.pieces[0]) if line.along == "x" else (pad.box[2:], pad.pieces[1])
    step = (high - low) / pieces
    t, wt = (_ALONG[0] + 1) / 2, _ALONG[1] / 2
    piece = np.repeat(np.arange(pieces), 12)
    share = np.tile(np.repeat(t, 3), pieces)
    along = low + (piece + share) * step
    across = jnp.asarray(np.tile(_ACROSS[0] / 2, 4 * pieces)) * line.width
    weight = np.tile(np.outer(wt, _ACROSS[1] / 2).ravel(), pieces) * step * line.width
    x, z = (along, origin[1] + across) if line.along == "x" else (origin[0] + across, along)
    facet, shape, inside = locate(pad, x, z)
    y = jnp.sum(shape * pad.points[pad.facets[facet], 1], axis=1)
    return Stations(
        facet,
        shape,
        jnp.where(inside, weight, 0.0),
        jnp.asarray(np.stack([piece, piece + 1], -1)),
        jnp.asarray(np.stack([1 - share, share], -1)),
        jnp.where(inside, y, NO_SKIN),
        pieces + 1,
    )
