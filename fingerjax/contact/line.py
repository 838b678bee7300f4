"""The tip of a line: too narrow for facets to resolve, so that it has quadrature and hats of its own along its length.

Under a load q per length the surface of a solid goes down with the logarithm of the distance (Flamant, 1892), and a mesh follows it only
down to its own elements. It gives way as if the load were a strip of half-width b = (a^2 + (c h)^2)^(1/2), with a that of the tip, h the
spacing of nodes and c = 0.425; the skin under a rigid flat tip gives way by

    d = 2 (1 - nu^2) q / (pi E) (ln(b / a) - 3/2 + 2 ln 2)

more. The last two terms set a rigid strip apart from one of uniform pressure (Johnson, 1985, chapter 2). Without d a wedge reads too stiff,
and presses the skin beside it down too far. c is that of a half-space (tests/test_line.py), the mean of lines anywhere on a lattice, for
tips of 0.04 to 0.4 of h; a tip of 0.08 h along the edges of facets, where these may bend, finds 0.15, one between them 0.56.
"""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .indenter import Line
from .locate import locate
from .pad import Pad

NO_SKIN = 1e3  # mm: clearance of a station that has no skin over it
BLUNTED = 0.425  # node spacings: half-width of the strip that a mesh makes of a line
RIGID = 1.5 - 2.0 * math.log(2.0)  # how much less a rigid flat strip goes down than the mean of a uniform one, of 2 (1 - nu^2) q / (pi E)
MIDDLE = 2.0 / math.sqrt(math.e)  # half-width of a uniform strip whose middle goes down like the mean of one of half-width 1

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


def narrowness(pad: Pad, line: Line, at: Stations) -> Float[Array, " k"]:
    """What the skin under each hat gives way beyond what the mesh shows, for a force on it, per unit of `sharp_compliance`: 1/mm."""
    part = at.weight[:, None] * at.values
    own = jnp.log(blunted(pad, line, at.facet) / (0.5 * line.width)) - RIGID
    area, summed = (jnp.zeros(at.count).at[at.hats].add(each) for each in (part, part * own[:, None]))
    return jnp.where(area > 0, summed * line.width / jnp.where(area > 0, area, 1.0) ** 2, 0.0)


def blunted(pad: Pad, line: Line, facet: Int[Array, "*m"]) -> Float[Array, "*m"]:
    """Half-width in mm of the strip that the mesh makes of the tip on some facets."""
    spacing = jnp.sqrt(jnp.sum(pad.weight, axis=1)[facet] / 2.0)
    return jnp.hypot(0.5 * line.width, BLUNTED * spacing)


def sharp_compliance(lame: Float[Array, "*v 2 layers"], layer: int) -> Float[Array, "*v"]:
    """2 (1 - nu^2) / (pi E) of a layer, in mm^2/N."""
    first, shear = lame[..., 0, layer], lame[..., 1, layer]
    return (first + 2.0 * shear) / (2.0 * jnp.pi * shear * (first + shear))


def beside_tip(
    distance: Float[np.ndarray, "*r"], half: float, blunt: Float[np.ndarray, "*k"] | float
) -> Float[np.ndarray, "*n"]:
    """How much deeper skin at a `distance` in mm from the middle of a rigid flat tip lies than the mesh shows, per unit of
    `sharp_compliance` times the load per length (Johnson, 1985, chapter 2).

    What the mesh shows is taken for the skin under a uniform strip, whose middle lies as deep as the mean of that of half-width `blunt`.
    """
    away, wide = np.abs(distance), blunt * MIDDLE
    rigid = np.log(2.0 / half) - np.arccosh(np.maximum(away / half, 1.0))
    near, far = away - wide, away + wide
    uniform = 1.0 - (far * np.log(far) - near * np.log(np.maximum(np.abs(near), 1e-300))) / (2.0 * wide)
    return rigid - uniform
