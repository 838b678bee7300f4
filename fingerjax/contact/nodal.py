"""Contact held at every node of the skin, as most finite-element programs hold it: no node lies deeper than the indenter's surface.

Beside the contact of `footprint`, which holds for means over hats. There a node between two hats may lie deeper, by an amount that
shrinks with the square of the edges; here none does, and the price is in the pressure: a uniform one is borne by the midsides of
quadratic triangles alone, so the forces at nodes mean nothing one by one. They are gathered at the vertices, each midside's half at
either end, which gives back a uniform pressure as it is. In an edge that the indenter's border cuts, a node is under it or is not, so
force jumps as the border passes a node, and no derivative sees that.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import InputError
from .footprint import Interface, first_contact
from .indenter import Line
from .pad import Pad, node_area
from .shape import AbstractIndenter
from .triangle import HATS

ENDS = ((0, 1), (1, 2), (2, 0))  # vertices beside midsides 3, 4 and 5


def at_nodes(pad: Pad, indenter: AbstractIndenter, origin: Any = (0.0, 0.0)) -> Interface:
    """Nodes of the pad as the unknowns of contact under an indenter with its origin at (x0, z0), in mm.

    **Raises:** `InputError` for a line, which is hardly ever over a node.
    """
    if isinstance(indenter, Line):
        raise InputError("a line has no width for nodes to lie under", place="at", seen="nodes", remedy='hold contact at "hats"')
    x, y, z = pad.points[:, 0] - origin[0], pad.points[:, 1], pad.points[:, 2] - origin[1]
    lowest = first_contact(pad, indenter, origin)
    area = jnp.where(indenter.covers(x, z), node_area(pad), 0.0)
    over_x, over_z = pad.position[..., 0] - origin[0], pad.position[..., 2] - origin[1]
    covered = pad.weight * jnp.clip(0.5 + indenter.margin(over_x, over_z) / jnp.sqrt(jnp.maximum(pad.weight, 1e-12)), 0.0, 1.0)
    rim = jnp.zeros(len(x), bool).at[pad.facets[:, :3]].max(pad.rim[pad.hats])
    return Interface(
        load=jnp.diag(area),
        overlap=area * (lowest + indenter.surface(x, z) - y),
        area=area,
        rim=rim & (area > 0),
        lowest=lowest,
        pieces=pad.hats,
        covered=jnp.sum(covered, axis=1),
        gathered=_gathered(pad),
    )


def _gathered(pad: Pad) -> Float[Array, "h p"]:
    """MPa at each vertex's hat for a newton on each node: a vertex's own, and half of every midside's beside it."""
    hats, nodes = len(pad.full), len(pad.points)
    whole = jnp.zeros(hats).at[pad.hats].add(jnp.asarray(pad.weight @ HATS))
    beside = jnp.zeros((hats, nodes), bool).at[pad.hats, pad.facets[:, :3]].set(True)
    for midside, ends in zip((3, 4, 5), ENDS, strict=True):
        for end in ends:
            beside = beside.at[pad.hats[:, end], pad.facets[:, midside]].set(True)
    share = jnp.where(jnp.sum(beside, axis=0) > 1, 0.5, 1.0)
    return jnp.where(beside, share, 0.0) / jnp.where(whole > 0, whole, 1.0)[:, None]
