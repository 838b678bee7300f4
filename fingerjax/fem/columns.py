"""Linear readings of a displacement: what is observed and what is pressed are the same thing, seen from both ends.

A column holds, for a few nodes, the weights whose inner product with the displacements is an observation: the height of a point of
the skin, a strain component at a receptor. The same numbers are the nodal forces of the unit load that works on it.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int


class Columns(eqx.Module):
    """`m` readings of `nodes` nodes: weights (m, support, 3) at nodes (m, support), padded with zero weights."""

    node: Int[Array, "m support"]
    weight: Float[Array, "m support 3"]
    nodes: int = eqx.field(static=True)

    @property
    def count(self) -> int:
        return self.node.shape[0]

    def read(self, u: Float[Array, "*batch nodes 3"]) -> Float[Array, "*batch m"]:
        """The readings of one displacement, or of each of a batch."""
        return jnp.einsum("msi,...msi->...m", self.weight, u[..., self.node, :])

    def loads(self) -> Float[Array, "m nodes 3"]:
        """Each column as nodal forces."""
        columns = jnp.arange(self.count)[:, None]
        return jnp.zeros((self.count, self.nodes, 3)).at[columns, self.node].add(self.weight)

    def load(self, forces: Float[Array, " m"]) -> Float[Array, "nodes 3"]:
        """The nodal forces of a force on each column."""
        return jnp.zeros((self.nodes, 3)).at[self.node].add(self.weight * forces[:, None, None])

    def matrix(self) -> sp.csc_matrix:
        """The columns as a sparse matrix (3 nodes, m) on the host."""
        node, weight = np.asarray(self.node), np.asarray(self.weight)
        rows = (3 * node[..., None] + np.arange(3)).ravel()
        columns = np.repeat(np.arange(self.count), node.shape[1] * 3)
        return sp.csc_matrix((weight.ravel(), (rows, columns)), shape=(3 * self.nodes, self.count))


def columns_from_matrix(matrix: sp.spmatrix) -> Columns:
    """Columns of a sparse matrix (3 nodes, m); degrees of freedom are numbered 3 node + direction."""
    coo = sp.csc_matrix(matrix).tocoo()
    nodes, count = matrix.shape[0] // 3, matrix.shape[1]
    pairs, inverse = np.unique(np.stack([coo.col, coo.row // 3]), axis=1, return_inverse=True)
    valence = np.bincount(pairs[0], minlength=count)
    slot = np.arange(pairs.shape[1]) - np.repeat(np.cumsum(valence) - valence, valence)
    node = np.zeros((count, max(int(valence.max(initial=1)), 1)), np.int32)
    weight = np.zeros((*node.shape, 3))
    node[pairs[0], slot] = pairs[1]
    np.add.at(weight, (pairs[0][inverse], slot[inverse], coo.row % 3), coo.data)
    return Columns(jax.device_put(node), jax.device_put(weight), nodes)
