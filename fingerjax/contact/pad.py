"""The skin that can be touched: its nodes, its quadrature, and hats for the contact pressure at its vertices."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from ..errors import InputError
from .triangle import HATS, QUARTERS, SHAPES, SLOPES, WEIGHTS

STEEPEST_SKIN = 0.17  # facets whose unit normal has n_y above -0.17 (80 degrees) face sideways
# Hats along a line stand this many node spacings apart: at 1 the pressure ripples by 14 % (condition number
# 3000), at 1.5 by 1 % (20), and the force is the same to 0.6 %.
LINE_SPACING = 1.5
SHARP = 0.5  # cosine of the angle by which the skin turns at an edge of the body: 60 degrees


@runtime_checkable
class SkinMesh(Protocol):
    """What this file needs of a finger: `nodes` (n, 3) in mm and `skin` (f, 6), normals outward; and `proximal` (n,) bool, nodes on the cut
    where the body ends, if it has one.
    """

    @property
    def nodes(self) -> np.ndarray: ...
    @property
    def skin(self) -> np.ndarray: ...


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
    """Hats on the border of the pad: pressure there means that the pad was chosen too small. The body's own edges are no border."""
    edge: Bool[Array, " p"]
    """Pad nodes on an edge of the body, beyond which there is no skin that could be touched."""
    box: Float[Array, "4"]
    """Smallest and largest x, smallest and largest z, in mm. No number that a mesh bent a little changes is static: code would be compiled
    anew for each."""
    pieces: tuple[int, int] = eqx.field(static=True)
    """Pieces of the tip of a line across the box, along x and along z."""


def pad(finger: SkinMesh) -> Pad:
    """All of the skin that faces -y."""
    facets = np.asarray(finger.skin)[_facing_down(finger)]
    if len(facets) == 0:
        raise InputError("no skin faces -y", place="skin", remedy="the pad must be at -y, the nail at +y")
    return of_facets(np.asarray(finger.nodes, float), facets, _edges(finger))


def functionals(whole: Pad, nodes: int) -> sp.csc_matrix:
    """Columns (3 nodes, p): the y-displacement of each pad node, also a unit force along +y on it."""
    p = len(whole.nodes)
    return sp.csc_matrix((np.ones(p), (3 * np.asarray(whole.nodes) + 1, np.arange(p))), shape=(3 * nodes, p))


def node_area(pad: Pad) -> Float[Array, " p"]:
    """Projected area, mm^2, that is each node's own: a third of every quarter of a facet that it is a corner of."""
    quarters = jnp.sum(pad.weight.reshape(len(pad.facets), len(QUARTERS), -1), axis=2)
    share = jnp.broadcast_to(quarters[:, :, None] / 3, (*quarters.shape, 3))
    return jnp.zeros(len(pad.points)).at[pad.facets[:, np.array(QUARTERS)]].add(share)


def _facing_down(finger: SkinMesh) -> np.ndarray:
    return _normals(finger)[:, 1] < -STEEPEST_SKIN


def _normals(finger: SkinMesh) -> np.ndarray:
    """(f, 3) unit normals of the skin's facets."""
    corners = np.asarray(finger.nodes, float)[np.asarray(finger.skin)[:, :3]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _edges(finger: SkinMesh) -> np.ndarray:
    """(n,) bool: nodes where two facets of the skin meet at an angle that no smooth skin has, or on the cut, where the skin ends."""
    skin, normal = np.asarray(finger.skin), _normals(finger)
    sides = skin[:, [[0, 3, 1], [1, 4, 2], [2, 5, 0]]].reshape(-1, 3)
    order = np.argsort(sides[:, 1], kind="stable")
    middle = sides[order, 1]
    pairs = np.flatnonzero(middle[1:] == middle[:-1])
    one, other = order[pairs] // 3, order[pairs + 1] // 3
    sharp = np.einsum("fi,fi->f", normal[one], normal[other]) < SHARP
    cut = getattr(finger, "proximal", np.zeros(len(finger.nodes), bool))
    return cut | np.isin(np.arange(len(finger.nodes)), sides[order[pairs[sharp]]])


def of_facets(points: np.ndarray, skin: np.ndarray, edge: np.ndarray) -> Pad:
    """The pad of some facets (f, 6) of a skin whose nodes are at `points` (n, 3), mm; `edge` (n,) are on an edge of the body."""
    nodes, facets = renumbered(skin)
    at = points[nodes]
    tangent = np.einsum("qda,fai->fqdi", SLOPES, at[facets])  # f facet, q point, d direction, a node, i space
    down = -np.cross(tangent[:, :, 0], tangent[:, :, 1])[..., 1]
    weight = np.maximum(down, 0.0) * WEIGHTS
    carrying, hats = renumbered(facets[:, :3])
    low, high = at[:, [0, 2]].min(axis=0), at[:, [0, 2]].max(axis=0)
    count = np.ceil((high - low) / (LINE_SPACING * np.median(np.sqrt(weight.sum(1) / 2.0))))
    return Pad(
        points=jnp.asarray(at),
        nodes=jnp.asarray(nodes),
        columns=jnp.asarray(np.arange(len(nodes))),
        facets=jnp.asarray(facets),
        hats=jnp.asarray(hats),
        position=jnp.asarray(np.einsum("qa,fai->fqi", SHAPES, at[facets])),
        weight=jnp.asarray(weight),
        full=jnp.asarray(np.bincount(hats.ravel(), (weight @ HATS).ravel(), len(carrying))),
        rim=jnp.asarray(np.isin(carrying, border(facets)) & ~edge[nodes[carrying]]),
        edge=jnp.asarray(edge[nodes]),
        box=jnp.asarray(np.stack([low, high], axis=1).ravel()),
        pieces=(max(int(count[0]), 1), max(int(count[1]), 1)),
    )


def border(facets: np.ndarray) -> np.ndarray:
    """Nodes on edges that belong to one facet only."""
    edges = facets[:, [[0, 3, 1], [1, 4, 2], [2, 5, 0]]].reshape(-1, 3)
    _, first, count = np.unique(edges[:, 1], return_index=True, return_counts=True)
    return np.unique(edges[first[count == 1]])


def renumbered(indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices that occur, and the same array in terms of their places."""
    kept, inverse = np.unique(indices, return_inverse=True)
    return kept, inverse.reshape(indices.shape)
