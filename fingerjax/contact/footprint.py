"""The geometry of one contact: where the indenter first touches, and what its pressure loads, overlaps and covers.

A uniform pressure puts no consistent force on the vertices of a quadratic triangle, so contact cannot be
decided node by node. The pressure is a sum of hat functions phi_j instead, one for each vertex and linear on
each facet, and the gap is averaged against each hat:

    load[i, j] = int N_i phi_j,   overlap[j] = int phi_j (Y + h - y_skin),   area[j] = int phi_j,

all integrals over the x-z plane, over the part that the indenter covers. N_i are the quadratic shape
functions of the skin.

Why vertices: measured on a half-space (tests/halfspace.py), in per cent, the worst of three positions on the
mesh, against facet edges per contact radius. One hat for each quadratic node has four times the unknowns and
leaves a 5 % ripple in the pressure that refinement does not remove; vertex hats converge in everything.

| edges per radius | Hertz force | largest hat | Hertz peak pressure | Hertz area | punch force |
|---|---|---|---|---|---|
| vertex hats, 1 | -10 | +88 | | -25 | +7.0 |
| vertex hats, 2 | -0.9 | +19 | +4.4 | -2.3 | +2.3 |
| vertex hats, 3 | -0.7 | +2.1 | -3.8 | -1.4 | +1.4 |
| vertex hats, 4 | -0.1 | +2.4 | +0.8 | +0.4 | +0.9 |
| vertex hats, 6 | -0.1 | +0.9 | -0.4 | +0.4 | +0.6 |
| node hats, 2 | -0.1 | +10 | | | +5.4 |
| node hats, 4 | -0.1 | +5.3 | | | +2.8 |
| node hats, 6 | -0.1 | +5.1 | | | +1.9 |

The largest hat stands above the pressure; its peak is that of the pressures `indentation.recovered`.
An edge is two node spacings. Vertex rows: a sphere of R = 20 a; node rows: R = 4 a, their force less the 0.6
% by which such a sphere falls short of Hertz's paraboloid. A line's force is only as good as the nodes
beneath its tip: with the tip 0.05 mm wide, a line at two places on the mesh gave forces 19 % apart at a node
spacing of 0.125 mm and 9 % at 0.0625 mm. What all places have in common is made good, see `line`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .indenter import Line
from .line import narrowness, stations
from .locate import locate
from .pad import Pad
from .shape import AbstractIndenter
from .triangle import HATS, SAMPLES, SHAPES, shapes

SLIVER = 0.02  # a hat with less than this share of its own area under the indenter carries no pressure
FAR = 1e3  # mm


class Interface(eqx.Module):
    """Geometry of one contact, with the indenter at first contact.

    `load` (p, k) in mm^2: nodal forces of a unit of each pressure; `overlap` (k,) in mm^3 and `area` (k,) in
    mm^2: integrals of overlap and of 1 against each hat. A hat that lies off the indenter has area 0 and
    takes no part. `lowest` is the y in mm at which the indenter first touches; travel is counted from there.
    `pieces` (r, 3), or (r, 2) of a line, are the hats of each facet and `covered` (r,) in mm^2 how much of it
    lies under the indenter. `gathered` (h, k) in MPa/N is the pressure of each hat from the force on each
    unknown where contact is held elsewhere than in hats (`nodal`). `narrow` (k,) in 1/mm is there for a line
    alone: what the mesh does not show of the skin's giving way under a force on each hat, see `line`.
    """

    load: Float[Array, "p k"]
    overlap: Float[Array, " k"]
    area: Float[Array, " k"]
    rim: Bool[Array, " k"]
    lowest: Float[Array, ""]
    pieces: Int[Array, "r b"]
    covered: Float[Array, " r"]
    gathered: Float[Array, "h k"] | None = None
    narrow: Float[Array, " k"] | None = None


def first_contact(pad: Pad, indenter: AbstractIndenter, origin: Any) -> Float[Array, ""]:
    """The y in mm at which the indenter, coming from -y, first touches the undeformed skin.

    Samples on every facet, then a closer and closer look at the best eight facets; and all over the end of a
    probe, which may lie between the samples. Differentiable in shape and pose with the point of first contact
    held (exact to first order, unless that point rides on an edge without a fillet).
    """
    if isinstance(indenter, Line):
        return jnp.min(stations(pad, indenter, origin).clearance)
    gap = partial(_gap, indenter=indenter, origin=origin)
    corners = pad.points[pad.facets]
    coarse = gap(corners[:, None], jnp.broadcast_to(jnp.asarray(SAMPLES), (len(corners), *SAMPLES.shape)))
    coarse = jnp.where(jnp.sum(pad.weight, axis=1, keepdims=True) > 0, coarse, FAR)
    _, best = jax.lax.top_k(-jnp.min(coarse, axis=1), min(8, len(corners)))
    start = jnp.asarray(SAMPLES)[jnp.argmin(coarse[best], axis=1)]
    at = jax.lax.stop_gradient(_closer(lambda a: gap(corners[best][:, None], a), start))
    found = jnp.min(gap(corners[best][:, None], at[:, None])[:, 0])
    beneath = _beneath(pad, indenter, origin)
    return found if beneath is None else jnp.minimum(found, jnp.min(beneath.clearance))


class _Beneath(NamedTuple):
    """The skin under a probe, at m points of its end: the pad's facet there, the facet's shape functions, the clearance y_skin - h in mm,
    and the area in mm^2 that each point stands for.
    """

    facet: Int[Array, " m"]
    shape: Float[Array, "m 6"]
    clearance: Float[Array, " m"]
    weight: Float[Array, " m"]


def _beneath(pad: Pad, indenter: AbstractIndenter, origin: Any) -> _Beneath | None:
    """None for an indenter that has no small end."""
    if (end := indenter.end) is None:
        return None
    x, z, weight = end
    facet, shape, there = locate(pad, x + origin[0], z + origin[1])
    clearance = jnp.sum(shape * pad.points[pad.facets[facet], 1], axis=1) - indenter.surface(x, z)
    return _Beneath(facet, shape, jnp.where(there, clearance, FAR), jnp.where(there, weight, 0.0))


def _gap(
    nodes: Float[Array, "... 6 3"], at: Float[Array, "... 2"], *, indenter: AbstractIndenter, origin: Any
) -> Float[Array, "..."]:
    """Clearance y_skin - h at parameters `at` of facets with `nodes`; far away where nothing can touch."""
    place = jnp.einsum("...a,...ai->...i", shapes(at[..., 0], at[..., 1]), nodes)
    x, z = place[..., 0] - origin[0], place[..., 2] - origin[1]
    return jnp.where(indenter.covers(x, z), place[..., 1] - indenter.surface(x, z), FAR)


def _closer(
    gap: Callable[[Float[Array, "c n 2"]], Float[Array, "c n"]], start: Float[Array, "c 2"]
) -> Float[Array, "c 2"]:
    """Lower `gap` over the triangle by looking around the best point on ever finer 5 x 5 lattices."""
    grid = jnp.stack(jnp.meshgrid(jnp.linspace(-1, 1, 5), jnp.linspace(-1, 1, 5)), -1).reshape(-1, 2)

    def look(round_: Int[Array, ""], at: Float[Array, "c 2"]) -> Float[Array, "c 2"]:
        around = jnp.clip(at[:, None] + grid * (0.5 ** (round_ + 2.5)), 0.0, 1.0)
        around = around / jnp.maximum(jnp.sum(around, -1, keepdims=True), 1.0)
        return jnp.take_along_axis(around, jnp.argmin(gap(around), axis=1)[:, None, None], axis=1)[:, 0]

    return jax.lax.fori_loop(0, 22, look, start)


def interface(pad: Pad, indenter: AbstractIndenter, origin: Any = (0.0, 0.0)) -> Interface:
    """Load, overlap and area of the pressure hats under an indenter with its origin at (x0, z0), in mm.

    Where elements are so large that a probe has no hat under it, one pressure acts all over its end. Traceable,
    and differentiable in the indenter's shape and pose through the overlap and through the covered area: the
    edge of the indenter cuts a quadrature point's own area in proportion.
    """
    if isinstance(indenter, Line):
        return _line_interface(pad, indenter, origin)
    lowest = first_contact(pad, indenter, origin)
    x, y, z = pad.position[..., 0] - origin[0], pad.position[..., 1], pad.position[..., 2] - origin[1]
    size = jnp.sqrt(jnp.maximum(pad.weight, 1e-12))
    weight = pad.weight * jnp.clip(0.5 + indenter.margin(x, z) / size, 0.0, 1.0)
    hats = jnp.asarray(HATS)
    local = jnp.einsum(
        "fq,qa,qb->fab", weight, jnp.asarray(SHAPES), hats
    )  # f facet, a node, b hat
    k = pad.full.shape[0]
    load = jnp.zeros((len(pad.points), k)).at[pad.facets[:, :, None], pad.hats[:, None, :]].add(local)
    overlap = lowest + indenter.surface(x, z) - y
    area = jnp.zeros(k).at[pad.hats].add(jnp.einsum("fq,qb->fb", weight, hats))
    against = jnp.zeros(k).at[pad.hats].add(jnp.einsum("fq,fq,qb->fb", weight, overlap, hats))
    found = _without_slivers(
        Interface(load, against, area, pad.rim, lowest, pad.hats, jnp.sum(weight, axis=1)), pad.full
    )
    one = _one_pressure(found, pad, indenter, origin)
    return found if one is None else jax.tree.map(partial(jnp.where, jnp.any(found.area > 0)), found, one)


def _one_pressure(hats: Interface, pad: Pad, indenter: AbstractIndenter, origin: Any) -> Interface | None:
    """The interface in which a hat of the facet under a probe stands for one pressure all over its end, and no other hat for anything."""
    beneath = _beneath(pad, indenter, origin)
    if beneath is None:
        return None
    facet = beneath.facet[jnp.argmin(beneath.clearance)]
    hat = pad.hats[facet, 0]
    alone = jnp.zeros_like(hats.area).at[hat]
    nodal = beneath.weight[:, None] * beneath.shape
    area = jnp.sum(beneath.weight)
    return Interface(
        load=jnp.zeros_like(hats.load).at[pad.facets[beneath.facet], hat].add(nodal),
        overlap=alone.set(jnp.sum(beneath.weight * (hats.lowest - beneath.clearance))),
        area=alone.set(area),
        rim=jnp.zeros_like(hats.rim),
        lowest=hats.lowest,
        pieces=hats.pieces.at[facet].set(hat),
        covered=jnp.zeros_like(hats.covered).at[facet].set(area),
    )


def only(interface: Interface, kept: np.ndarray, load: Float[Array | np.ndarray, "p k"]) -> Interface:
    """Some of the hats, by number, with another `load`; facets that any other hat stands on lose their area. Outside of compiled code."""
    number = np.full(len(interface.area), -1)
    number[kept] = np.arange(len(kept))
    pieces = number[np.asarray(interface.pieces)]
    whole = np.all(pieces >= 0, axis=1)
    overlap, area, rim = (np.asarray(part)[kept] for part in (interface.overlap, interface.area, interface.rim))
    rest = overlap, area, rim, interface.lowest, pieces[whole], np.asarray(interface.covered)[whole]
    narrow = None if interface.narrow is None else jax.device_put(np.asarray(interface.narrow)[kept])
    return dataclasses.replace(Interface(jax.device_put(load), *jax.device_put(rest)), narrow=narrow)


def _without_slivers(interface: Interface, full: Float[Array, " k"]) -> Interface:
    keep = interface.area > SLIVER * full
    load, overlap, area = (
        jnp.where(keep, part, 0.0) for part in (interface.load, interface.overlap, interface.area)
    )
    rest = interface.lowest, interface.pieces, interface.covered
    narrow = None if interface.narrow is None else jnp.where(keep, interface.narrow, 0.0)
    return Interface(load, overlap, area, interface.rim & keep, *rest, None, narrow)


def _line_interface(pad: Pad, line: Line, origin: Any) -> Interface:
    at = stations(pad, line, origin)
    lowest, k = jnp.min(at.clearance), at.count
    local = at.weight[:, None, None] * at.shape[:, :, None] * at.values[:, None, :]  # m point, a node, b hat
    load = (
        jnp.zeros((len(pad.points), k)).at[pad.facets[at.facet][:, :, None], at.hats[:, None, :]].add(local)
    )
    part = at.weight[:, None] * at.values
    full = jnp.zeros(k).at[at.hats].add(part)
    overlap = jnp.zeros(k).at[at.hats].add(part * (lowest - at.clearance)[:, None])
    ends = jnp.arange(k)
    rim = (ends < jnp.argmax(full > 0) + 1) | (ends > k - 2 - jnp.argmax(full[::-1] > 0))
    pieces = jnp.stack([ends[:-1], ends[1:]], axis=1)
    covered = jnp.sum(at.weight.reshape(k - 1, -1), axis=1)
    whole = jnp.full(k, jnp.max(full))
    found = Interface(load, overlap, full, rim, lowest, pieces, covered, narrow=narrowness(pad, line, at))
    return _without_slivers(found, whole)
