"""Groups of nodes that hold fast to one another, solved together when an error is smoothed.

Thin layers are meshed with flat elements, whose nodes across the layer are coupled far more strongly than those along it; smoothing node
by node then hardly converges, and inverting the stiffness of each strong group instead does.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from .affine import Affine, Terms
from .operator import Lame

STRONG = 0.3  # coupling |K_ij| / sqrt(|K_ii| |K_jj|) from which on two nodes belong together
LARGEST = 8  # nodes of a group


def strong_groups(coupling: sp.csr_matrix, strong: float = STRONG) -> np.ndarray:
    """(g, LARGEST) nodes of each group, filled up with n: strongest couplings first, until a group is full.

    `coupling` (n, n) holds norms of the stiffness's blocks between nodes; a node without any, as on a support, is in no group.
    """
    n = coupling.shape[0]
    own = coupling.diagonal()
    scale = sp.diags(1.0 / np.sqrt(np.where(own > 0, own, 1.0)))
    pairs = sp.triu(scale @ coupling @ scale, 1).tocoo()
    chosen = np.flatnonzero(pairs.data >= strong)
    label, members = np.arange(n), {i: [i] for i in np.flatnonzero(own > 0).tolist()}
    for k in chosen[np.argsort(-pairs.data[chosen], kind="stable")]:
        a, b = int(label[pairs.row[k]]), int(label[pairs.col[k]])
        if a != b and len(members[a]) + len(members[b]) <= LARGEST:
            members[a] += (joined := members.pop(b))
            label[joined] = a
    groups = np.full((len(members), LARGEST), n)
    for row, nodes in enumerate(members.values()):
        groups[row, : len(nodes)] = nodes
    return groups


class Groups(eqx.Module):
    """Groups of the nodes of one level, and their stiffness.

    - `members` (g, s): nodes, filled up with n. `slot` (n,): where each node stands among all members; g s where in none.
    - `blocks`: (g, 3s, 3s) entries of the stiffness within each group.
    """

    members: Int[Array, "g s"]
    slot: Int[Array, " n"]
    blocks: Affine

    def inverse(self, lame: Lame) -> Float[Array, "g b b"]:
        """The inverse of each group's stiffness; the identity where a group is filled up."""
        g, s = self.members.shape
        empty = jnp.repeat(self.members == self.slot.shape[0], 3, axis=1)
        blocks = self.blocks(lame).reshape(g, 3 * s, 3 * s)
        return inverse_blocks(blocks + jnp.where(empty, 1.0, 0.0)[:, None] * jnp.eye(3 * s))

    def apply(self, inverse: Float[Array, "g b b"], r: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        g, s = self.members.shape
        padded = jnp.concatenate([r, jnp.zeros((1, 3), r.dtype)])
        solved = jnp.einsum("gij,gj->gi", inverse, padded[self.members].reshape(g, 3 * s)).reshape(g * s, 3)
        return jnp.concatenate([solved, jnp.zeros((1, 3), r.dtype)])[self.slot]


def within(members: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) the group of each node and its place in it; -1 where it is in none."""
    group, place = np.full(nodes + 1, -1), np.full(nodes + 1, -1)
    g, s = members.shape
    group[members.ravel()], place[members.ravel()] = np.repeat(np.arange(g), s), np.tile(np.arange(s), g)
    return group[:nodes], place[:nodes]


def gathered(members: np.ndarray, group: np.ndarray, place: np.ndarray, terms: Terms) -> Groups:
    """Groups (g, s) with the terms of their blocks; `group` and `place` (n,): of each node, as from `within`."""
    slot = np.where(group >= 0, group * members.shape[1] + place, members.size)
    return Groups(jnp.asarray(members, jnp.int32), jnp.asarray(slot, jnp.int32), terms.affine())


def inverse_blocks(blocks: Float[Array, "g b b"]) -> Float[Array, "g b b"]:
    """Inverses of symmetric positive definite blocks by Gauss-Jordan sweeps, all blocks at once.

    `jnp.linalg.inv` on thousands of blocks inside compiled code has been seen to hang: its LAPACK calls wait for XLA's own threads.
    """

    def sweep(k: Int[Array, ""], A: Array) -> Array:
        pivot, row, column = A[:, k, k], A[:, k, :], A[:, :, k]
        rest = A - column[:, :, None] * row[:, None, :] / pivot[:, None, None]
        swept = rest.at[:, k, :].set(row / pivot[:, None]).at[:, :, k].set(column / pivot[:, None])
        return swept.at[:, k, k].set(-1.0 / pivot)

    return -jax.lax.fori_loop(0, blocks.shape[1], sweep, blocks)
