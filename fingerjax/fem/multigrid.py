"""One V-cycle of multigrid as the preconditioner: quadratic tetrahedra, then linear ones, then aggregates with rigid-body modes.

The transfers are made once for a mesh, at equal moduli, and kept; the levels below are formed anew from the moduli inside compiled code,
since every level is affine in the Lame parameters (Galerkin throughout). A stale hierarchy would cost iterations, never accuracy, and is
not differentiated. The cycle runs in single precision: it has to be good, not exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pyamg
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from .affine import Terms
from .assembly import chunks, element_matrices
from .body import Body
from .element import EDGES
from .groups import Groups, strong_groups, within
from .krylov import Field
from .operator import Lame, apply
from .sliced import Sliced, sliced

EQUAL = (12.0, 0.5)  # Lame parameters at which the transfers are made, the same in every layer: a Poisson's ratio of 0.48


class Midsides(eqx.Module):
    """From the corners of quadratic tetrahedra to all their nodes: a midside moves by the mean of its two corners."""

    parents: Int[Array, "nodes 2"]
    corners: int = eqx.field(static=True)

    def prolong(self, coarse: Float[Array, "corners 3"]) -> Field:
        return jnp.asarray(0.5, coarse.dtype) * coarse[self.parents].sum(axis=1)

    def restrict(self, fine: Field) -> Float[Array, "corners 3"]:
        half = jnp.asarray(0.5, fine.dtype) * fine
        return jnp.zeros((self.corners, 3), fine.dtype).at[self.parents].add(half[:, None])


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
    """The frozen part of the preconditioner for one body; `midsides` and `groups` are absent for linear tetrahedra."""

    midsides: Midsides | None
    groups: Groups | None
    corners: Sliced
    corner_groups: Groups
    aggregates: Aggregates


def hierarchy(body: Body, *, coarsest: int = 900) -> Hierarchy:
    """Build the transfers of a body on the host, once for a mesh.

    `coarsest` bounds the unknowns of the last level, which is factorised densely at every change of the moduli.
    """
    used, parents, tets = _corners(body)
    corner_tets = np.searchsorted(used, tets[:, :4])
    free = np.asarray(body.free)[used] > 0
    matrices = [_corner_terms(body, part) for part in chunks(body)]
    corners, groups = _sparse_level(corner_tets, np.asarray(body.layer), free, matrices)
    aggregates = _aggregates(np.asarray(body.nodes)[used], free, corners, _layers(body), coarsest)
    if body.order == 1:
        return Hierarchy(None, None, corners, groups, aggregates)
    midsides = Midsides(jnp.asarray(parents, jnp.int32), len(used))
    return Hierarchy(midsides, _fine_groups(body), corners, groups, aggregates)


def _layers(body: Body) -> int:
    return int(np.asarray(body.layer).max()) + 1


def _corners(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes that are corners, the two corners (as numbered among those) behind each node, and the elements."""
    tets = np.asarray(body.tets)
    used = np.unique(tets[:, :4])
    number = np.full(len(body.free), -1)
    number[used] = np.arange(len(used))
    parents = np.stack([number, number], axis=1)
    if body.order == 2:
        parents[tets[:, 4:].ravel()] = number[tets[:, :4]][:, EDGES].reshape(-1, 2)
    return used, parents, tets


def _corner_terms(body: Body, part: slice) -> tuple[np.ndarray, np.ndarray]:
    """Element matrices (e, 4, 3, 4, 3) seen from the corners: a midside moves by the mean of its two corners, unless it is held."""
    size = body.tets.shape[1]
    share = np.eye(4)
    if body.order == 2:
        share = np.concatenate([share, 0.5 * (share[EDGES[:, 0]] + share[EDGES[:, 1]])])
    moves = np.asarray(body.moves)[np.asarray(body.tets)[part]]
    held = (each * moves[:, :, :, None, None] * moves[:, None, None, :, :] for each in _shaped(element_matrices(body, part), size))
    first, second = (np.einsum("ac,eaibj,bd->ecidj", share, each, share, optimize=True) for each in held)
    return (first, second) if body.sliding is None else (_apart(first, moves[:, :4]), _apart(second, moves[:, :4]))


def _apart(each: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Element matrices (e, 4, 3, 4, 3) in which the ways that a corner cannot move (e, 4, 3) touch nothing but themselves."""
    own = np.einsum("ecici->eci", each) * (1 - moves)
    apart = each * moves[:, :, :, None, None] * moves[:, None, None, :, :]
    np.einsum("ecici->eci", apart)[...] += own
    return apart


def _pairs(tets: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of nodes that share an element, as row * nodes + column, sorted; and which pair each element's are, (e, a, a)."""
    flat = (tets[:, :, None].astype(np.int64) * nodes + tets[:, None, :]).ravel()
    pairs, which = np.unique(flat, return_inverse=True)
    return pairs, which.reshape(len(tets), tets.shape[1], tets.shape[1])


def _coupling(pairs: np.ndarray, blocks: np.ndarray, free: np.ndarray) -> sp.csr_matrix:
    """Norms (n, n) of the blocks (pairs, 3, 3) between free nodes."""
    row, column = np.divmod(pairs, len(free))
    size = np.linalg.norm(blocks, axis=(1, 2)) * free[row] * free[column]
    matrix = sp.csr_matrix((size, (row, column)), shape=(len(free),) * 2)
    matrix.eliminate_zeros()
    return matrix


def _added(which: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count, 3, 3) sums of element blocks (e, a, 3, b, 3)."""
    blocks = np.moveaxis(values, 3, 2).reshape(-1, 9)
    return np.stack([np.bincount(which.ravel(), part, count) for part in blocks.T], axis=1).reshape(-1, 3, 3)


def _equal(parts: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return EQUAL[0] * parts[0] + EQUAL[1] * parts[1]


def _sparse_level(
    tets: np.ndarray, layer: np.ndarray, free: np.ndarray, matrices: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[Sliced, Groups]:
    first, second = (np.concatenate(part) for part in zip(*matrices, strict=True))
    pairs, which = _pairs(tets, len(free))
    members = strong_groups(_coupling(pairs, _added(which, _equal((first, second)), len(pairs)), free))
    level = sliced(pairs, which, layer, free, (first, second))
    return level, _groups(members, tets, layer, free, [(slice(None), (first, second))])


def _groups(
    members: np.ndarray,
    tets: np.ndarray,
    layer: np.ndarray,
    free: np.ndarray,
    matrices: Iterable[tuple[slice, tuple[np.ndarray, np.ndarray]]],
) -> Groups:
    """The groups with their blocks, from element matrices of parts of the elements."""
    group, place = within(members, len(free))
    g, s = members.shape
    terms = Terms(g * 9 * s * s)
    for part, parts in matrices:
        here, there, block = place[tets[part]][:, :, None], place[tets[part]][:, None, :], group[tets[part]]
        together = (block[:, :, None] == block[:, None, :]) & (block[:, :, None] >= 0)
        corner = np.where(together, (block[:, :, None] * 3 * s + 3 * here) * 3 * s + 3 * there, -1)
        terms.add_rows(corner, np.full(corner.shape, 3 * s), layer[part], parts)
    slot = np.where(group >= 0, group * s + place, g * s)
    return Groups(jnp.asarray(members, jnp.int32), jnp.asarray(slot, jnp.int32), terms.affine())


def _fine_groups(body: Body) -> Groups:
    tets, free, n = np.asarray(body.tets), np.asarray(body.free) > 0, len(body.free)
    a = tets.shape[1]
    pairs, which = _pairs(tets, n)
    blocks = np.zeros((len(pairs), 3, 3))
    for part in chunks(body):
        equal = _equal(element_matrices(body, part)).reshape(-1, a, 3, a, 3)
        blocks += _added(which[part], equal, len(pairs))
    members = strong_groups(_coupling(pairs, blocks, free))
    shaped = ((part, _shaped(element_matrices(body, part), a)) for part in chunks(body))
    return _groups(members, tets, np.asarray(body.layer), free, shaped)


def _shaped(parts: tuple[np.ndarray, np.ndarray], a: int) -> tuple[np.ndarray, np.ndarray]:
    return parts[0].reshape(-1, a, 3, a, 3), parts[1].reshape(-1, a, 3, a, 3)


def rigid_body_modes(nodes: np.ndarray) -> np.ndarray:
    """Three translations and three rotations (3n, 6) of nodes (n, 3), about their centre."""
    x, y, z = (nodes - nodes.mean(axis=0)).T
    modes = np.zeros((len(nodes), 3, 6))
    modes[:, range(3), range(3)] = 1.0
    modes[:, 0, 4], modes[:, 0, 5] = z, -y
    modes[:, 1, 3], modes[:, 1, 5] = -z, x
    modes[:, 2, 3], modes[:, 2, 4] = y, -x
    return modes.reshape(-1, 6)


def _aggregates(nodes: np.ndarray, free: np.ndarray, corners: Sliced, layers: int, coarsest: int) -> Aggregates:
    unknown = np.flatnonzero(np.repeat(free, 3))

    def matrix(lame: np.ndarray) -> sp.csr_matrix:
        return corners.matrix(lame)[unknown][:, unknown]

    K = matrix(np.broadcast_to(np.array(EQUAL)[:, None], (2, layers))).tobsr(blocksize=(3, 3))
    P = _prolongator(K, rigid_body_modes(nodes)[unknown], coarsest)
    parts = np.zeros((2, layers, P.shape[1], P.shape[1]))
    for kind, layer in np.ndindex(2, layers):
        unit = np.zeros((2, layers))
        unit[kind, layer] = 1.0
        parts[kind, layer] = (P.T @ (matrix(unit) @ P)).toarray()
    coo = P.tocoo()
    full = sp.csr_matrix((coo.data, (unknown[coo.row], coo.col)), shape=(3 * len(free), P.shape[1]))
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
    """Chebyshev polynomial of the stiffness preconditioned by its strong groups (Adams, Brezina, Hu & Tuminaro, 2003).

    It acts on eigenvalues from the largest down to the largest over `width`, and costs `degree` products with the stiffness.
    """

    groups: Groups
    inverse: Float[Array, "g b b"]
    largest: Float[Array, ""]
    degree: int = eqx.field(static=True, default=4)
    width: float = eqx.field(static=True, default=20.0)

    def __call__(self, operate: Callable[[Field], Field], load: Field, start: Field | None) -> Field:
        """Approximate `K^-1 load` from `start` (zero where None); the same polynomial before and after keeps the cycle symmetric."""
        upper, lower = 1.1 * self.largest, self.largest / self.width
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
        return self.groups.apply(self.inverse, r)


def smoother(groups: Groups, operate: Callable[[Field], Field], lame: Lame, precision: type) -> Smoother:
    """Inverse groups, and the largest eigenvalue of the preconditioned stiffness by a dozen power steps."""
    inverse = groups.inverse(lame).astype(precision)

    def step(v: Field, _: None) -> tuple[Field, Float[Array, ""]]:
        w = groups.apply(inverse, operate(v))
        size = jnp.linalg.norm(w)
        return w / size, size

    start = jax.random.normal(jax.random.key(0), (groups.slot.shape[0], 3), precision)
    start = jnp.where((groups.slot < groups.members.size)[:, None], start, jnp.zeros((), precision))
    _, sizes = jax.lax.scan(step, start / jnp.linalg.norm(start), None, length=12)
    return Smoother(groups, inverse, sizes[-1])


def preconditioner(body: Body, frozen: Hierarchy, lame: Lame, precision: type = jnp.float32) -> Callable[[Field], Field]:
    """The V-cycle at these moduli, as a function of a residual. Symmetric positive definite, to the precision that it runs in."""
    lame = jax.lax.stop_gradient(lame)

    def less(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)

    cycle = _corner_cycle(frozen, lame, less, precision)
    if frozen.midsides is not None and frozen.groups is not None:
        cycle = _cycle(less(body), frozen.midsides, frozen.groups, less(lame), lame, cycle, precision)

    def scaled(load: Field) -> Field:
        size = jnp.linalg.norm(load)
        unit = load / jnp.where(size > 0, size, 1.0)
        moved = cycle(unit.astype(precision)).astype(load.dtype) * size
        return moved if body.sliding is None else body.sliding * moved

    return scaled


def _corner_cycle(frozen: Hierarchy, lame: Lame, less: Callable[[Any], Any], precision: type) -> Callable[[Field], Field]:
    aggregates = frozen.aggregates
    coarse = jnp.einsum("pl,plij->ij", lame[:, : aggregates.parts.shape[1]], aggregates.parts)
    # An explicit inverse: one product per cycle instead of two triangular solves, which XLA runs column by column.
    inverse = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(coarse, lower=True), jnp.eye(len(coarse))).astype(precision)
    rows, moved = less(frozen.corners.rows(lame)), less(aggregates)

    def operate(v: Field) -> Field:
        return frozen.corners.multiply(rows, v)

    smooth = smoother(frozen.corner_groups, operate, lame, precision)

    def cycle(load: Field) -> Field:
        u = smooth(operate, load, None)
        u = u + moved.prolong(inverse @ moved.restrict(load - operate(u)))
        return smooth(operate, load, u)

    return cycle


def _cycle(
    body: Body, midsides: Midsides, groups: Groups, lame: Lame, exact: Lame, below: Callable[[Field], Field], precision: type
) -> Callable[[Field], Field]:
    def operate(v: Field) -> Field:
        return apply(body, lame, v)

    smooth = smoother(groups, operate, exact, precision)

    def cycle(load: Field) -> Field:
        u = smooth(operate, load, None)
        u = u + body.moves * midsides.prolong(below(midsides.restrict(load - operate(u))))
        return smooth(operate, load, u)

    return cycle
