"""One V-cycle of multigrid as the preconditioner: quadratic tetrahedra, then corners and bundles of midsides, then aggregates of corners.

The transfers are made once for a mesh, at equal moduli, and kept; the levels below are formed anew from the moduli inside compiled code,
since every level is affine in the Lame parameters (Galerkin throughout). A stale hierarchy would cost iterations, never accuracy, and is
not differentiated. The cycle runs in single precision: it has to be good, not exact.
"""

from __future__ import annotations

from collections.abc import Callable
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
from .chebyshev import Reach, smoother
from .element import EDGES
from .groups import Groups, gathered, strong_groups, within
from .krylov import Field
from .operator import Lame, apply
from .sliced import Parts, Sliced, pairs_of, sliced

EQUAL = (12.0, 0.5)  # Lame parameters at which the transfers are made, the same in every layer: a Poisson's ratio of 0.48
FINE: Reach = (3, 15.0)  # of smoothing; products with the quadratic tetrahedra are what a cycle costs
CORNERS: Reach = (8, 60.0)
LINEAR: Reach = (4, 20.0)  # where corners are all there is
BUNDLED = 0.2  # coupling from which on midsides belong to one bundle


class Midsides(eqx.Module):
    """From corners and bundles of midsides to all nodes: a midside moves by the mean of its two corners, and by its bundle beside that.

    Where elements are needles, their long edges' midsides hold fast to one another: how these move against their corners, evenly over
    many needles, is seen neither by the corners nor by a smoother that reaches a few nodes. Bundles are what sees it.

    `parents` (n, 3): two corners and a bundle, numbered after the corners; `share` (n, 3): what they count for, zero where none is.
    """

    parents: Int[Array, "nodes 3"]
    share: Float[Array, "nodes 3"]
    count: int = eqx.field(static=True)

    def prolong(self, coarse: Float[Array, "count 3"]) -> Field:
        return jnp.sum(self.share[:, :, None] * coarse[self.parents], axis=1)

    def restrict(self, fine: Field) -> Float[Array, "count 3"]:
        return jnp.zeros((self.count, 3), fine.dtype).at[self.parents].add(self.share[:, :, None] * fine[:, None])


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
    """The frozen part of the preconditioner for one body; `midsides` and `groups` are absent for linear tetrahedra.

    `corners` holds the bundles of midsides too, numbered after the corners.
    """

    midsides: Midsides | None
    groups: Groups | None
    corners: Sliced
    corner_groups: Groups
    aggregates: Aggregates


def hierarchy(body: Body, *, coarsest: int = 900) -> Hierarchy:
    """Build the transfers of a body on the host, once for a mesh.

    `coarsest` bounds the aggregates of the last level, six unknowns each, which is factorised densely at every change of the moduli.
    """
    tets, layer, free = np.asarray(body.tets), np.asarray(body.layer), np.asarray(body.free) > 0
    used = np.unique(tets[:, :4])
    number = np.full(len(free), -1)
    number[used] = np.arange(len(used))
    midsides = groups = None
    below, moving = number[tets[:, :4]], free[used]
    if body.order == 2:
        coupling = _coupling(body)
        groups = _fine_groups(body, strong_groups(coupling))
        bundle = _bundles(coupling, (number < 0) & np.asarray(body.moves > 0).all(axis=1))
        midsides = _midsides(tets, number, bundle)
        below = np.concatenate([below, np.where(bundle >= 0, len(used) + bundle, -1)[tets[:, 4:]]], axis=1)
        moving = np.concatenate([moving, np.full(midsides.count - len(used), True)])
    seen = below >= 0
    matrices = ((part, _seen_from_below(body, part, seen[part, 4:])) for part in chunks(body))
    corners = sliced(np.where(seen, below, below[:, :1]), layer, moving, matrices)
    modes = np.zeros((3 * len(moving), 6))
    modes[: 3 * len(used)] = rigid_body_modes(np.asarray(body.nodes)[used])
    layers = int(layer.max()) + 1
    aggregates = _aggregates(modes, moving, corners, layers, coarsest)
    return Hierarchy(midsides, groups, corners, _sparse_groups(corners, layers), aggregates)


def _midsides(tets: np.ndarray, number: np.ndarray, bundle: np.ndarray) -> Midsides:
    """From the numbers of corners and of bundles (n,), -1 where a node is none or in none."""
    parents, corners = np.stack([number, number], axis=1), int(number.max()) + 1
    parents[tets[:, 4:].ravel()] = number[tets[:, :4]][:, EDGES].reshape(-1, 2)
    share = np.stack([np.full(len(number), 0.5), np.full(len(number), 0.5), bundle >= 0], axis=1)
    parents = np.column_stack([parents, np.where(bundle >= 0, corners + bundle, 0)])
    return Midsides(jnp.asarray(parents, jnp.int32), jnp.asarray(share), corners + int(bundle.max(initial=-1)) + 1)


def _bundles(coupling: sp.csr_matrix, midside: np.ndarray) -> np.ndarray:
    """(n,) the bundle of each midside that is strongly coupled to others, -1 elsewhere."""
    among = sp.diags(midside.astype(float))
    members = strong_groups(sp.csr_matrix(among @ coupling @ among), BUNDLED)
    return within(members[(members < len(midside)).sum(axis=1) > 1], len(midside))[0]


def _seen_from_below(body: Body, part: slice, bundled: np.ndarray) -> Parts:
    """Element matrices (e, a, 3, a, 3) between corners, and the bundles that midsides are in: `bundled` (e, 6)."""
    size = body.tets.shape[1]
    share = np.eye(size)
    share[np.arange(4, size)[:, None], EDGES[: size - 4]] = 0.5
    moves = np.broadcast_to(np.asarray(body.moves)[np.asarray(body.tets)[part]], (len(bundled), size, 3))
    seen = np.concatenate([moves[:, :4], np.broadcast_to(bundled[:, :, None], (*bundled.shape, 3))], axis=1)
    first, second = _shaped(element_matrices(body, part), size)
    sliding = body.sliding is not None
    return _shared(first, share, moves, seen, sliding), _shared(second, share, moves, seen, sliding)


def _shared(each: np.ndarray, share: np.ndarray, moves: np.ndarray, seen: np.ndarray, sliding: bool) -> np.ndarray:
    """(e, c, 3, c, 3) of an element's matrices (e, a, 3, a, 3); the ways that a sliding corner cannot move touch only themselves."""
    held = each * moves[:, :, :, None, None] * moves[:, None, None, :, :]
    whole = np.einsum("ac,eaibj,bd->ecidj", share, held, share, optimize=True)
    shared = whole * seen[:, :, :, None, None] * seen[:, None, None, :, :]
    if sliding:
        own = np.einsum("ecici->eci", whole)[:, :4] * (1 - moves[:, :4])
        np.einsum("ecici->eci", shared)[:, :4] += own
    return shared


def _equal(parts: Parts) -> np.ndarray:
    return EQUAL[0] * parts[0] + EQUAL[1] * parts[1]


def _coupling(body: Body) -> sp.csr_matrix:
    """Norms (n, n) of the stiffness's blocks between free nodes, at equal moduli."""
    tets, free, n = np.asarray(body.tets), np.asarray(body.free) > 0, len(body.free)
    a = tets.shape[1]
    pairs, which = pairs_of(tets, n)
    blocks = np.zeros((len(pairs), 9))
    for part in chunks(body):
        values = np.moveaxis(_equal(element_matrices(body, part)).reshape(-1, a, 3, a, 3), 3, 2).reshape(-1, 9)
        blocks += np.stack([np.bincount(which[part].ravel(), each, len(pairs)) for each in values.T], axis=1)
    row, column = np.divmod(pairs, n)
    matrix = sp.csr_matrix((np.linalg.norm(blocks, axis=1) * free[row] * free[column], (row, column)), shape=(n, n))
    matrix.eliminate_zeros()
    return matrix


def _fine_groups(body: Body, members: np.ndarray) -> Groups:
    """The groups with their blocks, from element matrices."""
    tets, layer = np.asarray(body.tets), np.asarray(body.layer)
    group, place = within(members, len(body.free))
    g, s = members.shape
    terms = Terms(g * 9 * s * s)
    for part in chunks(body):
        here, there, block = place[tets[part]][:, :, None], place[tets[part]][:, None, :], group[tets[part]]
        together = (block[:, :, None] == block[:, None, :]) & (block[:, :, None] >= 0)
        corner = np.where(together, (block[:, :, None] * 3 * s + 3 * here) * 3 * s + 3 * there, -1)
        terms.add_rows(corner, np.full(corner.shape, 3 * s), layer[part], _shaped(element_matrices(body, part), tets.shape[1]))
    return gathered(members, group, place, terms)


def _sparse_groups(stiffness: Sliced, layers: int) -> Groups:
    """Strong groups of a sparse stiffness, with their blocks."""
    K = stiffness.matrix(_everywhere(layers)).tobsr((3, 3))
    coupling = sp.csr_matrix((np.linalg.norm(K.data, axis=(1, 2)), K.indices, K.indptr), shape=(len(stiffness.place),) * 2)
    members = strong_groups(coupling)
    group, place = within(members, len(stiffness.place))
    g, s = members.shape
    entries, terms = stiffness.entries, Terms(g * 9 * s * s)
    (row, i), (column, j) = (np.divmod(each[np.asarray(entries.place)], 3) for each in stiffness.unknowns())
    together = (group[row] == group[column]) & (group[row] >= 0)
    at = np.where(together, (group[row] * 3 * s + 3 * place[row] + i) * 3 * s + 3 * place[column] + j, -1)
    terms.add(at, *(np.asarray(each) for each in (entries.layer, entries.volumetric, entries.shear)))
    return gathered(members, group, place, terms)


def _everywhere(layers: int) -> np.ndarray:
    """Equal Lame parameters (2, layers)."""
    return np.broadcast_to(np.array(EQUAL)[:, None], (2, layers))


def _shaped(parts: Parts, a: int) -> Parts:
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


def _aggregates(modes: np.ndarray, free: np.ndarray, corners: Sliced, layers: int, coarsest: int) -> Aggregates:
    """Aggregates of the free ones of n nodes, from the motions `modes` (3n, 6) that cost no energy; bundles have no part in these."""
    unknown = np.flatnonzero(np.repeat(free, 3))

    def matrix(lame: np.ndarray) -> sp.csr_matrix:
        return corners.matrix(lame)[unknown][:, unknown]

    P = _prolongator(matrix(_everywhere(layers)).tobsr(blocksize=(3, 3)), modes[unknown], coarsest)
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
    return P[:, np.flatnonzero(np.diff(P.tocsc().indptr))]  # aggregates of bundles alone have no motions


def _padded(matrix: sp.csr_matrix) -> tuple[Array, Array]:
    count = np.diff(matrix.indptr)
    slot = np.arange(max(int(count.max()), 1))
    inside = slot < count[:, None]
    at = np.minimum(matrix.indptr[:-1, None] + slot, len(matrix.data) - 1)
    return jnp.asarray(np.where(inside, matrix.data[at], 0.0)), jnp.asarray(np.where(inside, matrix.indices[at], 0), jnp.int32)


def preconditioner(body: Body, frozen: Hierarchy, lame: Lame, precision: type = jnp.float32) -> Callable[[Field], Field]:
    """The V-cycle at these moduli, as a function of a residual. Symmetric positive definite, to the precision that it runs in."""
    lame = jax.lax.stop_gradient(lame)

    def less(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)

    cycle = _corner_cycle(frozen, lame, less, precision)
    if frozen.midsides is not None and frozen.groups is not None:
        cycle = _cycle(less(body), less(frozen.midsides), frozen.groups, less(lame), lame, cycle, precision)

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

    smooth = smoother(frozen.corner_groups, operate, lame, precision, LINEAR if frozen.midsides is None else CORNERS)

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

    smooth = smoother(groups, operate, exact, precision, FINE)

    def cycle(load: Field) -> Field:
        u = smooth(operate, load, None)
        u = u + body.moves * midsides.prolong(below(midsides.restrict(load - operate(u))))
        return smooth(operate, load, u)

    return cycle
