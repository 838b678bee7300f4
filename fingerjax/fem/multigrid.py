"""One V-cycle of multigrid as the preconditioner: quadratic tetrahedra, then linear ones, then aggregates with rigid-body modes.

The transfers are made once for a mesh, at equal moduli, and kept; the level below is formed anew from the moduli inside compiled code,
since every level is affine in the Lame parameters. A stale hierarchy would cost iterations, never accuracy, and is not differentiated.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pyamg
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from .assembly import Assembled
from .body import Body, Incidence, assemble_body, incidence
from .element import EDGES
from .krylov import Field
from .operator import Lame, apply, diagonal_blocks


class Midsides(eqx.Module):
    """From the corners of quadratic tetrahedra to all their nodes: a midside moves by the mean of its two corners."""

    parents: Int[Array, "nodes 2"]
    children: Incidence

    def prolong(self, coarse: Float[Array, "corners 3"]) -> Field:
        return 0.5 * coarse[self.parents].sum(axis=1)

    def restrict(self, fine: Field) -> Float[Array, "corners 3"]:
        return self.children.accumulate(0.5 * jnp.repeat(fine, 2, axis=0))


class Aggregates(eqx.Module):
    """From the rigid-body modes of aggregates of corners to all corners (smoothed aggregation; Vanek, Mandel & Brezina, 1996).

    `parts` (2, layers, c, c) is the Galerkin coarse operator per unit of each Lame parameter.
    """

    rows: Float[Array, "dofs width"]
    row_index: Int[Array, "dofs width"]
    columns: Float[Array, "c height"]
    column_index: Int[Array, "c height"]
    parts: Float[Array, "2 layers c c"]

    def prolong(self, coarse: Float[Array, " c"]) -> Field:
        return jnp.sum(self.rows * coarse[self.row_index], axis=1).reshape(-1, 3)

    def restrict(self, fine: Field) -> Float[Array, " c"]:
        return jnp.sum(self.columns * fine.reshape(-1)[self.column_index], axis=1)


class Hierarchy(eqx.Module):
    """The frozen part of the preconditioner for one body."""

    corners: Body
    midsides: Midsides | None
    aggregates: Aggregates


def hierarchy(body: Body, *, coarsest: int = 900) -> Hierarchy:
    """Build the transfers of a body on the host; about a second for ten thousand nodes.

    `coarsest` bounds the unknowns of the last level, which is factorised densely at every change of the moduli.
    """
    corners, midsides = (body, None) if body.order == 1 else _corner_body(body)
    return Hierarchy(corners, midsides, _aggregates(corners, coarsest))


def _corner_body(body: Body) -> tuple[Body, Midsides]:
    tets = np.asarray(body.tets)
    used, corner_tets = np.unique(tets[:, :4], return_inverse=True)
    corner_tets = corner_tets.reshape(-1, 4)
    corners = assemble_body(np.asarray(body.nodes)[used], corner_tets, np.asarray(body.layer), np.asarray(body.fixed)[used])
    number = np.full(len(body.free), -1)
    number[used] = np.arange(len(used))
    parents = np.stack([number, number], axis=1)
    parents[tets[:, 4:].ravel()] = corner_tets[:, EDGES].reshape(-1, 2)
    return corners, Midsides(jnp.asarray(parents, jnp.int32), incidence(parents, len(used)))


def rigid_body_modes(nodes: np.ndarray) -> np.ndarray:
    """Three translations and three rotations (3n, 6) of nodes (n, 3), about their centre."""
    x, y, z = (nodes - nodes.mean(axis=0)).T
    modes = np.zeros((len(nodes), 3, 6))
    modes[:, range(3), range(3)] = 1.0
    modes[:, 0, 4], modes[:, 0, 5] = z, -y
    modes[:, 1, 3], modes[:, 1, 5] = -z, x
    modes[:, 2, 3], modes[:, 2, 4] = y, -x
    return modes.reshape(-1, 6)


def _aggregates(corners: Body, coarsest: int) -> Aggregates:
    assembled = Assembled(corners, upper=False)
    layers = int(np.asarray(corners.layer).max()) + 1
    equal = np.ones((2, layers)) * np.array([[1.0], [1.0]])
    K = assembled.matrix(equal).tobsr(blocksize=(3, 3))
    modes = rigid_body_modes(np.asarray(corners.nodes))[assembled.free]
    P = _prolongator(K, modes, coarsest)
    parts = [[(P.T @ (assembled.part(layer, modulus) @ P)).toarray() for layer in range(layers)] for modulus in range(2)]
    full = sp.csr_matrix((3 * len(corners.free), P.shape[1]))
    full = sp.csr_matrix(sp.coo_matrix((P.data, (assembled.free[P.tocoo().row], P.tocoo().col)), shape=full.shape))
    rows, row_index = _padded(full)
    columns, column_index = _padded(sp.csr_matrix(full.T))
    return Aggregates(rows, row_index, columns, column_index, jnp.asarray(parts))


def _prolongator(K: sp.bsr_matrix, modes: np.ndarray, coarsest: int) -> sp.csr_matrix:
    """Smoothed aggregation, repeated on its own coarse level until few enough unknowns are left."""
    levels = pyamg.smoothed_aggregation_solver(
        K, B=modes, strength=("symmetric", {"theta": 0.0}), smooth=("jacobi", {"omega": 4.0 / 3.0}), max_levels=6, max_coarse=coarsest
    ).levels
    P = sp.eye(K.shape[0], format="csr")
    for level in levels[:-1]:
        P = sp.csr_matrix(P @ sp.csr_matrix(level.P))
    P.eliminate_zeros()
    return P


def _padded(matrix: sp.csr_matrix) -> tuple[Array, Array]:
    count = np.diff(matrix.indptr)
    slot = np.arange(max(int(count.max()), 1))
    inside = slot < count[:, None]
    at = np.minimum(matrix.indptr[:-1, None] + slot, len(matrix.data) - 1)
    return jnp.asarray(np.where(inside, matrix.data[at], 0.0)), jnp.asarray(np.where(inside, matrix.indices[at], 0), jnp.int32)


class Smoother(eqx.Module):
    """Chebyshev polynomial of the block-Jacobi-preconditioned stiffness (Adams, Brezina, Hu & Tuminaro, 2003)."""

    inverse_blocks: Float[Array, "nodes 3 3"]
    largest: Float[Array, ""]
    degree: int = eqx.field(static=True, default=3)

    def __call__(self, operate: Callable[[Field], Field], load: Field, start: Field | None) -> Field:
        """Approximate `K^-1 load` from `start` (zero where None); the same polynomial before and after keeps the cycle symmetric."""
        upper, lower = 1.1 * self.largest, self.largest / 8.0
        theta, delta = (upper + lower) / 2, (upper - lower) / 2
        u = jnp.zeros_like(load) if start is None else start
        r = load if start is None else load - operate(start)

        def advance(_: Int[Array, ""] | int, state: tuple) -> tuple:
            u, r, d, rho = state
            u, r = u + d, r - operate(d)
            following = 1 / (2 * theta / delta - rho)
            return u, r, following * rho * d + (2 * following / delta) * self._scale(r), following

        u, _, d, _ = jax.lax.fori_loop(0, self.degree - 1, advance, (u, r, self._scale(r) / theta, delta / theta))
        return u + d

    def _scale(self, r: Field) -> Field:
        return jnp.einsum("nij,nj->ni", self.inverse_blocks, r)


def smoother(body: Body, lame: Lame) -> Smoother:
    """Inverse diagonal blocks and the largest eigenvalue of the scaled stiffness, by a dozen power steps."""
    inverse = inverse_3x3(diagonal_blocks(body, lame))

    def step(v: Field, _: None) -> tuple[Field, Float[Array, ""]]:
        w = jnp.einsum("nij,nj->ni", inverse, apply(body, lame, v))
        size = jnp.linalg.norm(w)
        return w / size, size

    start = jax.random.normal(jax.random.key(0), body.nodes.shape) * body.free[:, None]
    _, sizes = jax.lax.scan(step, start / jnp.linalg.norm(start), None, length=12)
    return Smoother(inverse, sizes[-1])


def inverse_3x3(blocks: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """Inverses by cofactors: `jnp.linalg.inv` on tens of thousands of small blocks inside compiled code has been seen to hang."""
    a, b, c = blocks[:, :, 0], blocks[:, :, 1], blocks[:, :, 2]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return cofactors / jnp.sum(a * cofactors[:, 0], axis=1)[:, None, None]


def preconditioner(body: Body, frozen: Hierarchy, lame: Lame) -> Callable[[Field], Field]:
    """The V-cycle at these moduli, as a function of a residual. Symmetric positive definite."""
    aggregates, corners = frozen.aggregates, frozen.corners
    lame = jax.lax.stop_gradient(lame)
    coarse = jnp.einsum("pl,plij->ij", lame[:, : aggregates.parts.shape[1]], aggregates.parts)
    # An explicit inverse: one product per cycle instead of two triangular solves, which XLA runs column by column.
    inverse = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(coarse, lower=True), jnp.eye(len(coarse)))
    corner_smoother = smoother(corners, lame)

    def corner_cycle(load: Field) -> Field:
        def operate(v: Field) -> Field:
            return apply(corners, lame, v)

        u = corner_smoother(operate, load, None)
        below = aggregates.restrict(load - operate(u))
        u = u + aggregates.prolong(inverse @ below)
        return corner_smoother(operate, load, u)

    if frozen.midsides is None:
        return corner_cycle
    midsides, fine_smoother = frozen.midsides, smoother(body, lame)

    def operate(v: Field) -> Field:
        return apply(body, lame, v)

    def cycle(load: Field) -> Field:
        u = fine_smoother(operate, load, None)
        below = corners.free[:, None] * midsides.restrict(load - operate(u))
        u = u + body.free[:, None] * midsides.prolong(corner_cycle(below))
        return fine_smoother(operate, load, u)

    return cycle
