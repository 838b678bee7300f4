"""The skin that can be touched: its nodes, its quadrature, and a space of its own for the contact pressure.

A uniform pressure puts no consistent force on the vertices of a quadratic triangle, so contact cannot be
decided node by node. The pressure is a sum of hat functions phi_j instead, one for each vertex and linear on
each facet, and the gap is averaged against each hat:

    load[i, j] = int N_i phi_j,   overlap[j] = int phi_j (Y + h - y_skin),   area[j] = int phi_j,

all integrals over the x-z plane, over the part that the indenter covers. N_i are the quadratic shape
functions of the skin.

Why vertices: measured on a half-space (tests/halfspace.py), in per cent, the worst of three positions on the
mesh, against facet edges per contact radius. One hat for each quadratic node has four times the unknowns and
leaves a 5 % ripple in the pressure that refinement does not remove; vertex hats converge in everything.

| edges per radius | Hertz force | Hertz peak pressure | Hertz area | punch force |
|---|---|---|---|---|
| vertex hats, 1 | -10 | +88 | -25 | +7.0 |
| vertex hats, 2 | -0.9 | +19 | -2.3 | +2.3 |
| vertex hats, 3 | -0.7 | +2.1 | -1.4 | +1.4 |
| vertex hats, 4 | -0.1 | +2.4 | +0.4 | +0.9 |
| vertex hats, 6 | -0.1 | +0.9 | +0.4 | +0.6 |
| node hats, 2 | -0.1 | +10 | | +5.4 |
| node hats, 4 | -0.1 | +5.3 | | +2.8 |
| node hats, 6 | -0.1 | +5.1 | | +1.9 |

An edge is two node spacings. Vertex rows: a sphere of R = 20 a; node rows: R = 4 a, their force less the 0.6
% by which such a sphere falls short of Hertz's paraboloid. A line's force is only as good as the nodes
beneath its tip: with the tip 0.05 mm wide, a line at two places on the mesh gave forces 19 % apart at a node
spacing of 0.125 mm and 9 % at 0.0625 mm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from fingerjax.contact.indenter import AbstractIndenter, Line
from fingerjax.errors import InputError

STEEPEST_SKIN = 0.17  # facets whose unit normal has n_y above -0.17 (80 degrees) face sideways
SLIVER = 0.02  # a hat with less than this share of its own area under the indenter carries no pressure
# Hats along a line stand this many node spacings apart: at 1 the pressure ripples by 14 % (condition number
# 3000), at 1.5 by 1 % (20), and the force is the same to 0.6 %.
LINE_SPACING = 1.5
FAR = 1e3  # mm


@runtime_checkable
class SkinMesh(Protocol):
    """What this file needs of a finger: `nodes` (n, 3) in mm and `skin` (f, 6), normals outward."""

    @property
    def nodes(self) -> np.ndarray: ...
    @property
    def skin(self) -> np.ndarray: ...


@dataclass(frozen=True)
class Indentation:
    """One thing that will be pressed: an indenter, its origin (x0, z0), and the largest travel, in mm."""

    indenter: AbstractIndenter
    origin: tuple[float, float]
    travel: float


class Pad(eqx.Module):
    """Reachable skin. p pad nodes, f facets, q quadrature points on each, k pressure unknowns."""

    points: Float[Array, "p 3"]
    """Undeformed positions in mm."""
    nodes: Int[Array, " p"]
    """The finger's node at each pad node."""
    columns: Int[Array, " p"]
    """Column of each pad node in the compliance: 0..p-1, or a choice of them in a window of a larger pad."""
    facets: Int[Array, "f 6"]
    """Pad nodes of each quadratic triangle."""
    hats: Int[Array, "f 3"]
    """Pressure unknowns at the vertices of each facet."""
    position: Float[Array, "f q 3"]
    weight: Float[Array, "f q"]
    """Projected x-z area in mm^2 of each quadrature point."""
    full: Float[Array, " k"]
    """Integral of each hat over all of its skin, in mm^2."""
    rim: Bool[Array, " k"]
    """Hats on the border of the pad: pressure there means that the pad was chosen too small."""
    spacing: float = eqx.field(static=True)
    """Median node spacing in mm."""
    box: tuple[float, float, float, float] = eqx.field(static=True)
    """Smallest and largest x, smallest and largest z, in mm."""


class Interface(eqx.Module):
    """Geometry of one contact, with the indenter at first contact.

    `load` (p, k) in mm^2: nodal forces of a unit of each pressure; `overlap` (k,) in mm^3 and `area` (k,) in
    mm^2: integrals of overlap and of 1 against each hat. A hat that lies off the indenter has area 0 and
    takes no part. `lowest` is the y in mm at which the indenter first touches; travel is counted from there.
    `pieces` (r, 3), or (r, 2) of a line, are the hats of each facet and `covered` (r,) in mm^2 how much of it
    lies under the indenter.
    """

    load: Float[Array, "p k"]
    overlap: Float[Array, " k"]
    area: Float[Array, " k"]
    rim: Bool[Array, " k"]
    lowest: Float[Array, ""]
    pieces: Int[Array, "r b"]
    covered: Float[Array, " r"]


# --- quadratic triangle, barycentric (1 - a - b, a, b), nodes: vertices, then midsides 01, 12, 20


def _shapes(a: Float[ArrayLike, "..."], b: Float[ArrayLike, "..."]) -> Float[Array, "... 6"]:
    """Quadratic shape functions (..., 6)."""
    c = 1.0 - a - b
    return jnp.stack(
        [c * (2 * c - 1), a * (2 * a - 1), b * (2 * b - 1), 4 * c * a, 4 * a * b, 4 * b * c], axis=-1
    )


def _slopes(a: Float[ArrayLike, "..."], b: Float[ArrayLike, "..."]) -> Float[Array, "... 2 6"]:
    """Their derivatives in (a, b): (..., 2, 6)."""
    c, o = 1.0 - a - b, jnp.zeros_like(jnp.asarray(a))
    in_a = [1 - 4 * c, 4 * a - 1, o, 4 * (c - a), 4 * b, -4 * b]
    in_b = [1 - 4 * c, o, 4 * b - 1, -4 * a, 4 * a, 4 * (c - b)]
    return jnp.stack([jnp.stack(in_a, -1), jnp.stack(in_b, -1)], axis=-2)


_CHILDREN = np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)])
_CORNERS = np.array([(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)], float)


def _rule() -> tuple[np.ndarray, np.ndarray]:
    """Points (24, 2) and weights (24,) summing to 1/2: 6, exact to degree 4, in each quarter triangle."""
    a, b = 0.445948490915965, 0.091576213509771
    one = [(a, a), (1 - 2 * a, a), (a, 1 - 2 * a), (b, b), (1 - 2 * b, b), (b, 1 - 2 * b)]
    bary = np.array([(1 - s - t, s, t) for s, t in one])
    weight = np.repeat([0.223381589678011, 0.109951743655322], 3) / 8.0
    points = np.concatenate([bary @ _CORNERS[corners] for corners in _CHILDREN])
    return points, np.tile(weight, 4)


_POINTS, _WEIGHTS = _rule()
_HATS = np.column_stack([1 - _POINTS.sum(1), _POINTS])


def _lattice(order: int) -> np.ndarray:
    return np.array([(i, j) for i in range(order + 1) for j in range(order + 1 - i)], float) / order


_SAMPLES = _lattice(6)


# --- host: choosing the pad


def pad(finger: SkinMesh) -> Pad:
    """All of the skin that faces -y."""
    facets = np.asarray(finger.skin)[_facing_down(finger)]
    if len(facets) == 0:
        raise InputError("no skin faces -y", place="skin", remedy="the pad must be at -y, the nail at +y")
    return _pad(np.asarray(finger.nodes, float), facets)


def pad_for(finger: SkinMesh, indentations: Sequence[Indentation]) -> Pad:
    """The skin that any of `indentations` can reach, with a rim of facets to spare."""
    whole = pad(finger)
    chosen = np.any([_reached(whole, one) for one in indentations], axis=0)
    return _pad(np.asarray(finger.nodes, float), np.asarray(whole.nodes)[np.asarray(whole.facets)[chosen]])


def windows(whole: Pad, indentations: Sequence[Indentation]) -> Pad:
    """One small pad for each indentation, cut from `whole` and stacked along a leading axis, for `jax.vmap`.

    `columns` says which of the whole pad's nodes each window has. Short windows are filled up with facets of
    no area.
    """
    cuts = [np.flatnonzero(_reached(whole, one)) for one in indentations]
    return _stack([_cut(whole, cut) for cut in cuts])


def functionals(whole: Pad, nodes: int) -> sp.csc_matrix:
    """Columns (3 nodes, p): the y-displacement of each pad node, also a unit force along +y on it."""
    p = len(whole.nodes)
    return sp.csc_matrix((np.ones(p), (3 * np.asarray(whole.nodes) + 1, np.arange(p))), shape=(3 * nodes, p))


def surface_functionals(finger: SkinMesh, points_xz: np.ndarray) -> sp.csc_matrix:
    """Columns (3n, m): the y-displacement of the pad's skin at m points (x, z), in mm.

    **Raises:** `InputError` where a point has no skin below it.
    """
    whole, shape, facet = _found(finger, points_xz)
    rows = 3 * np.asarray(whole.nodes)[np.asarray(whole.facets)[facet]] + 1
    columns = np.repeat(np.arange(len(rows)), 6)
    return sp.csc_matrix((shape.ravel(), (rows.ravel(), columns)), shape=(3 * len(finger.nodes), len(rows)))


def surface_y(finger: SkinMesh, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Height y in mm of the pad's undeformed skin at (x, z)."""
    x, z = np.broadcast_arrays(np.asarray(x, float), np.asarray(z, float))
    whole, shape, facet = _found(finger, np.column_stack([x.ravel(), z.ravel()]))
    y = np.asarray(whole.points)[np.asarray(whole.facets)[facet], 1]
    return np.sum(shape * y, axis=1).reshape(x.shape)


def _found(finger: SkinMesh, points_xz: np.ndarray) -> tuple[Pad, np.ndarray, np.ndarray]:
    whole, points = pad(finger), np.asarray(points_xz, float)
    facet, shape, inside = locate(whole, jnp.asarray(points[:, 0]), jnp.asarray(points[:, 1]))
    if not np.all(inside):
        first = points[np.argmin(np.asarray(inside))]
        x0, x1, z0, z1 = (round(value, 3) for value in whole.box)
        remedy = f"the pad lies within x {x0} to {x1}, z {z0} to {z1} mm"
        raise InputError(
            "no skin faces -y at this (x, z)",
            place="surface point",
            seen=tuple(first.tolist()),
            remedy=remedy,
        )
    return whole, np.asarray(shape), np.asarray(facet)


def _facing_down(finger: SkinMesh) -> np.ndarray:
    corners = np.asarray(finger.nodes, float)[np.asarray(finger.skin)[:, :3]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal[:, 1] < -STEEPEST_SKIN * np.linalg.norm(normal, axis=1)


def _pad(points: np.ndarray, skin: np.ndarray) -> Pad:
    nodes, facets = _renumbered(skin)
    at = points[nodes]
    tangent = np.einsum(
        "qda,fai->fqdi", np.asarray(_slopes(*_POINTS.T)), at[facets]
    )  # f facet, q point, d direction, i space
    down = -np.cross(tangent[:, :, 0], tangent[:, :, 1])[..., 1]
    weight = np.maximum(down, 0.0) * _WEIGHTS
    carrying, hats = _renumbered(facets[:, :3])
    full = np.bincount(hats.ravel(), (weight @ _HATS).ravel(), len(carrying))
    return Pad(
        points=jnp.asarray(at),
        nodes=jnp.asarray(nodes),
        columns=jnp.arange(len(nodes)),
        facets=jnp.asarray(facets),
        hats=jnp.asarray(hats),
        position=jnp.asarray(np.einsum("qa,fai->fqi", np.asarray(_shapes(*_POINTS.T)), at[facets])),
        weight=jnp.asarray(weight),
        full=jnp.asarray(full),
        rim=jnp.asarray(np.isin(carrying, _border(facets))),
        spacing=float(np.median(np.sqrt(weight.sum(1) / 2.0))),
        box=(at[:, 0].min().item(), at[:, 0].max().item(), at[:, 2].min().item(), at[:, 2].max().item()),
    )


def _border(facets: np.ndarray) -> np.ndarray:
    """Nodes on edges that belong to one facet only."""
    edges = facets[:, [[0, 3, 1], [1, 4, 2], [2, 5, 0]]].reshape(-1, 3)
    _, first, count = np.unique(edges[:, 1], return_index=True, return_counts=True)
    return np.unique(edges[first[count == 1]])


def _reached(whole: Pad, one: Indentation) -> np.ndarray:
    """Facets within a quarter of the travel of the indenter (soft skin bulges), and their neighbours."""
    lowest = _first_contact(whole, one.indenter, jnp.asarray(one.origin, float))
    at = np.einsum(
        "sa,fai->fsi", np.asarray(_shapes(*_SAMPLES.T)), np.asarray(whole.points)[np.asarray(whole.facets)]
    )
    x, z = jnp.asarray(at[..., 0] - one.origin[0]), jnp.asarray(at[..., 2] - one.origin[1])
    size = np.ptp(at[..., 0], axis=1) + np.ptp(at[..., 2], axis=1)
    near = np.asarray(one.indenter.margin(x, z)) > -size[:, None]
    gap = at[..., 1] - np.asarray(one.indenter.surface(x, z)) - float(lowest)
    touched = np.any(near & (gap < 1.25 * one.travel), axis=1)
    facets = np.asarray(whole.facets)
    return np.any(np.isin(facets, facets[touched]), axis=1)


@eqx.filter_jit
def _first_contact(whole: Pad, indenter: AbstractIndenter, origin: Float[Array, "2"]) -> Float[Array, ""]:
    return first_contact(whole, indenter, (origin[0], origin[1]))


def _cut(whole: Pad, chosen: np.ndarray) -> Pad:
    """The pad of some facets of a pad."""
    facets, hats = np.asarray(whole.facets)[chosen], np.asarray(whole.hats)[chosen]
    columns, facets = _renumbered(facets)
    kept, hats = _renumbered(hats)
    edge = np.isin(np.arange(len(kept)), hats[np.isin(facets[:, :3], _border(facets))])
    return eqx.tree_at(
        lambda one: (
            one.points,
            one.nodes,
            one.columns,
            one.facets,
            one.hats,
            one.position,
            one.weight,
            one.full,
            one.rim,
        ),
        whole,
        (
            whole.points[columns],
            whole.nodes[columns],
            whole.columns[columns],
            jnp.asarray(facets),
            jnp.asarray(hats),
            whole.position[chosen],
            whole.weight[chosen],
            whole.full[kept],
            jnp.asarray(edge),
        ),
    )


def _renumbered(indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept, inverse = np.unique(indices, return_inverse=True)
    return kept, inverse.reshape(indices.shape)


def _stack(pads: Sequence[Pad]) -> Pad:
    longest = [max(len(leaf) for leaf in leaves) for leaves in zip(*map(jax.tree.leaves, pads), strict=True)]

    def padded(one: Pad) -> Pad:
        leaves, tree = jax.tree.flatten(one)
        filled = [_filled(leaf, length) for leaf, length in zip(leaves, longest, strict=True)]
        return jax.tree.unflatten(tree, filled)

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(padded, pads))


def _filled(leaf: Array, length: int) -> Array:
    """Repeat the first index or position; areas and flags are filled with 0."""
    like = jnp.zeros_like if leaf.dtype == bool or (leaf.dtype == float and leaf.ndim < 3) else jnp.asarray
    filler = jnp.broadcast_to(like(leaf[:1]), (length - len(leaf), *leaf.shape[1:]))
    return jnp.concatenate([leaf, filler])


# --- traced: geometry of one contact


def locate(
    pad: Pad, x: Float[Array, " m"], z: Float[Array, " m"]
) -> tuple[Int[Array, " m"], Float[Array, "m 6"], Bool[Array, " m"]]:
    """The curved facet over each (x, z), its shape functions there, and whether the pad has this (x, z).

    Newton's iteration in the facet's own parameters; the last step carries the derivatives in x and z.
    """
    corner = pad.points[pad.facets[:, :3]][..., jnp.array([0, 2])]  # f facet, v vertex, i (x, z)
    target = jnp.stack([x, z], axis=-1)
    frozen = jax.lax.stop_gradient(target)
    first, u, v = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    to = frozen[:, None] - first
    det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    det = jnp.where(det == 0, 1.0, det)
    a = (to[..., 0] * v[:, 1] - to[..., 1] * v[:, 0]) / det
    b = (u[:, 0] * to[..., 1] - u[:, 1] * to[..., 0]) / det
    depth = jnp.minimum(jnp.minimum(a, b), 1.0 - a - b)
    depth = jnp.where(jnp.sum(pad.weight, axis=1) > 0, depth, -FAR)
    facet = jnp.argmax(depth, axis=1)
    start = jnp.take_along_axis(jnp.stack([a, b], -1), facet[:, None, None], axis=1)[:, 0]
    nodes = pad.points[pad.facets[facet]][..., jnp.array([0, 2])]  # m point, a node, i (x, z)
    settled = jax.lax.fori_loop(0, 6, lambda _, at: _newton(nodes, at, frozen), start)
    at = _newton(nodes, jax.lax.stop_gradient(settled), target)
    inside = jnp.minimum(jnp.minimum(at[:, 0], at[:, 1]), 1.0 - at[:, 0] - at[:, 1]) > -0.05
    return facet, _shapes(at[:, 0], at[:, 1]), inside


def _newton(
    nodes: Float[Array, "m 6 2"], at: Float[Array, "m 2"], target: Float[Array, "m 2"]
) -> Float[Array, "m 2"]:
    """One step towards the parameters at which each facet passes through its target in x-z."""
    shape, slope = _shapes(at[:, 0], at[:, 1]), _slopes(at[:, 0], at[:, 1])
    miss = target - jnp.einsum("ma,mai->mi", shape, nodes)
    j = jnp.einsum("mda,mai->mid", slope, nodes)  # i (x, z), d (a, b)
    det = j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]
    det = jnp.where(det == 0, 1.0, det)
    step_a = (j[:, 1, 1] * miss[:, 0] - j[:, 0, 1] * miss[:, 1]) / det
    step_b = (j[:, 0, 0] * miss[:, 1] - j[:, 1, 0] * miss[:, 0]) / det
    return at + jnp.clip(jnp.stack([step_a, step_b], -1), -1.0, 1.0)


def first_contact(pad: Pad, indenter: AbstractIndenter, origin: Any) -> Float[Array, ""]:
    """The y in mm at which the indenter, coming from -y, first touches the undeformed skin.

    Samples on every facet, then a closer and closer look at the best eight facets. Differentiable in shape
    and pose with the point of first contact held (exact to first order, unless that point rides on an edge
    without a fillet).
    """
    if isinstance(indenter, Line):
        return jnp.min(_line_stations(pad, indenter, origin).clearance)
    gap = partial(_gap, indenter=indenter, origin=origin)
    corners = pad.points[pad.facets]
    coarse = gap(corners[:, None], jnp.broadcast_to(jnp.asarray(_SAMPLES), (len(corners), *_SAMPLES.shape)))
    coarse = jnp.where(jnp.sum(pad.weight, axis=1, keepdims=True) > 0, coarse, FAR)
    _, best = jax.lax.top_k(-jnp.min(coarse, axis=1), min(8, len(corners)))
    start = jnp.asarray(_SAMPLES)[jnp.argmin(coarse[best], axis=1)]
    at = jax.lax.stop_gradient(_closer(lambda a: gap(corners[best][:, None], a), start))
    return jnp.min(gap(corners[best][:, None], at[:, None])[:, 0])


def _gap(
    nodes: Float[Array, "... 6 3"], at: Float[Array, "... 2"], *, indenter: AbstractIndenter, origin: Any
) -> Float[Array, "..."]:
    """Clearance y_skin - h at parameters `at` of facets with `nodes`; far away where nothing can touch."""
    place = jnp.einsum("...a,...ai->...i", _shapes(at[..., 0], at[..., 1]), nodes)
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

    Traceable, and differentiable in the indenter's shape and pose through the overlap and through the covered
    area: the edge of the indenter cuts a quadrature point's own area in proportion.
    """
    if isinstance(indenter, Line):
        return _line_interface(pad, indenter, origin)
    lowest = first_contact(pad, indenter, origin)
    x, y, z = pad.position[..., 0] - origin[0], pad.position[..., 1], pad.position[..., 2] - origin[1]
    size = jnp.sqrt(jnp.maximum(pad.weight, 1e-12))
    weight = pad.weight * jnp.clip(0.5 + indenter.margin(x, z) / size, 0.0, 1.0)
    hats = jnp.asarray(_HATS)
    local = jnp.einsum(
        "fq,qa,qb->fab", weight, _shapes(*jnp.asarray(_POINTS.T)), hats
    )  # f facet, a node, b hat
    k = pad.full.shape[0]
    load = jnp.zeros((len(pad.points), k)).at[pad.facets[:, :, None], pad.hats[:, None, :]].add(local)
    overlap = lowest + indenter.surface(x, z) - y
    area = jnp.zeros(k).at[pad.hats].add(jnp.einsum("fq,qb->fb", weight, hats))
    against = jnp.zeros(k).at[pad.hats].add(jnp.einsum("fq,fq,qb->fb", weight, overlap, hats))
    return _without_slivers(
        Interface(load, against, area, pad.rim, lowest, pad.hats, jnp.sum(weight, axis=1)), pad.full
    )


def _without_slivers(interface: Interface, full: Float[Array, " k"]) -> Interface:
    keep = interface.area > SLIVER * full
    load, overlap, area = (
        jnp.where(keep, part, 0.0) for part in (interface.load, interface.overlap, interface.area)
    )
    rest = interface.lowest, interface.pieces, interface.covered
    return Interface(load, overlap, area, interface.rim & keep, *rest)


class _Stations(eqx.Module):
    """Quadrature along and across the tip of a line: m points, b = 2 hats at each."""

    facet: Int[Array, " m"]
    shape: Float[Array, "m 6"]
    weight: Float[Array, " m"]
    hats: Int[Array, "m 2"]
    values: Float[Array, "m 2"]
    clearance: Float[Array, " m"]
    count: int = eqx.field(static=True)


_GAUSS_ALONG, _GAUSS_ACROSS = np.polynomial.legendre.leggauss(4), np.polynomial.legendre.leggauss(3)


def _line_stations(pad: Pad, line: Line, origin: Any) -> _Stations:
    """Points on the tip: hats a little coarser than nodes, four Gauss points between, three across."""
    low, high = pad.box[:2] if line.along == "x" else pad.box[2:]
    pieces = max(int(np.ceil((high - low) / (LINE_SPACING * pad.spacing))), 1)
    step = (high - low) / pieces
    t, wt = (_GAUSS_ALONG[0] + 1) / 2, _GAUSS_ALONG[1] / 2
    piece = np.repeat(np.arange(pieces), 12)
    share = np.tile(np.repeat(t, 3), pieces)
    along = jnp.asarray(low + (piece + share) * step)
    across = jnp.asarray(np.tile(_GAUSS_ACROSS[0] / 2, 4 * pieces)) * line.width
    weight = jnp.asarray(np.tile(np.outer(wt, _GAUSS_ACROSS[1] / 2).ravel(), pieces) * step) * line.width
    x, z = (along, origin[1] + across) if line.along == "x" else (origin[0] + across, along)
    facet, shape, inside = locate(pad, x, z)
    y = jnp.sum(shape * pad.points[pad.facets[facet], 1], axis=1)
    return _Stations(
        facet,
        shape,
        jnp.where(inside, weight, 0.0),
        jnp.asarray(np.stack([piece, piece + 1], -1)),
        jnp.asarray(np.stack([1 - share, share], -1)),
        jnp.where(inside, y, FAR),
        pieces + 1,
    )


def _line_interface(pad: Pad, line: Line, origin: Any) -> Interface:
    at = _line_stations(pad, line, origin)
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
    return _without_slivers(Interface(load, overlap, full, rim, lowest, pieces, covered), whole)
