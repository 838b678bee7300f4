"""Which facet of the skin lies over a place in the x-z plane, and what is read there."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from ..errors import InputError
from .pad import Pad, SkinMesh, pad
from .triangle import shapes, slopes

OUTSIDE = -1e3  # barycentric depth of a facet without area
CANDIDATES = 4  # facets that are looked at for each place


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
    facet, shape, inside = _located(whole, jnp.asarray(points[:, 0]), jnp.asarray(points[:, 1]))
    if not np.all(inside):
        first = points[np.argmin(np.asarray(inside))]
        x0, x1, z0, z1 = (round(float(value), 3) for value in whole.box)
        remedy = f"the pad lies within x {x0} to {x1}, z {z0} to {z1} mm"
        raise InputError("no skin faces -y at this (x, z)", place="surface point", seen=tuple(first.tolist()), remedy=remedy)
    return whole, np.asarray(shape), np.asarray(facet)


def locate(pad: Pad, x: Float[Array, " m"], z: Float[Array, " m"]) -> tuple[Int[Array, " m"], Float[Array, "m 6"], Bool[Array, " m"]]:
    """The curved facet over each (x, z), its shape functions there, and whether the pad has this (x, z).

    Newton's iteration in the parameters of those facets whose straight triangles are nearest: near an edge that bends, the one that has
    the place is often not the first. The last step carries the derivatives in x and z.
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
    depth = jnp.where(jnp.sum(pad.weight, axis=1) > 0, depth, OUTSIDE)
    flat, near = jax.lax.top_k(depth, min(CANDIDATES, depth.shape[1]))  # m point, c facet
    start = jnp.take_along_axis(jnp.stack([a, b], -1), near[..., None], axis=1)
    nodes = pad.points[pad.facets[near]][..., jnp.array([0, 2])]  # m point, c facet, a node, i (x, z)
    closer = jax.vmap(_newton, in_axes=(1, 1, None), out_axes=1)
    settled = jax.lax.fori_loop(0, 6, lambda _, at: closer(nodes, at, frozen), start)
    best = jnp.argmax(jnp.where(flat > OUTSIDE, _depth(settled), OUTSIDE), axis=1)[:, None]
    facet = jnp.take_along_axis(near, best, axis=1)[:, 0]
    settled = jnp.take_along_axis(settled, best[..., None], axis=1)[:, 0]
    nodes = jnp.take_along_axis(nodes, best[..., None, None], axis=1)[:, 0]
    at = _newton(nodes, jax.lax.stop_gradient(settled), target)
    inside = _depth(at) > -0.05
    return facet, shapes(at[:, 0], at[:, 1]), inside


_located = eqx.filter_jit(locate)


def _depth(at: Float[Array, "*m 2"]) -> Float[Array, "*m"]:
    """The least barycentric coordinate: below 0 outside of a facet."""
    return jnp.minimum(jnp.min(at, axis=-1), 1.0 - jnp.sum(at, axis=-1))


def _newton(nodes: Float[Array, "m 6 2"], at: Float[Array, "m 2"], target: Float[Array, "m 2"]) -> Float[Array, "m 2"]:
    """One step towards the parameters at which each facet passes through its target in x-z."""
    shape, slope = shapes(at[:, 0], at[:, 1]), slopes(at[:, 0], at[:, 1])
    miss = target - jnp.einsum("ma,mai->mi", shape, nodes)
    j = jnp.einsum("mda,mai->mid", slope, nodes)  # i (x, z), d (a, b)
    det = j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]
    det = jnp.where(det == 0, 1.0, det)
    step_a = (j[:, 1, 1] * miss[:, 0] - j[:, 0, 1] * miss[:, 1]) / det
    step_b = (j[:, 0, 0] * miss[:, 1] - j[:, 1, 0] * miss[:, 0]) / det
    return at + jnp.clip(jnp.stack([step_a, step_b], -1), -1.0, 1.0)
