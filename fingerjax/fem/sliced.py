"""The stiffness as a sparse matrix inside compiled code: nodes with about equally many neighbours lie together, in a slice padded alike.

The faster form for linear tetrahedra, of which some twenty meet in a node; for quadratic ones the matrix-free product is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from .affine import Affine, Terms
from .operator import Lame

SHARES = (0.0, 0.4, 0.7, 0.88, 0.96, 1.0)  # of the nodes, by number of neighbours: where slices begin and end
Rows = tuple[Float[Array, "_ 3 _"], ...]
Parts = tuple[np.ndarray, np.ndarray]  # per unit of each Lame parameter


class Sliced(eqx.Module):
    """A stiffness between n nodes, affine in the Lame parameters.

    - `neighbours`: of the nodes of each slice (n_s, w_s), filled up with node 0.
    - `place` (n,): where each node stands among the slices, one after the other.
    - `entries`: three rows of 3 w_s numbers for each node of a slice, slice after slice.
    """

    neighbours: tuple[Int[Array, "_ _"], ...]
    place: Int[Array, " n"]
    entries: Affine

    def rows(self, lame: Lame) -> Rows:
        """The numbers of each slice (n_s, 3, 3 w_s) at these Lame parameters."""
        ends = np.cumsum([9 * each.size for each in self.neighbours])[:-1]
        parts = jnp.split(self.entries(lame), ends)
        return tuple(part.reshape(len(each), 3, -1) for part, each in zip(parts, self.neighbours, strict=True))

    def multiply(self, rows: Rows, u: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        slices = zip(rows, self.neighbours, strict=True)
        return jnp.concatenate([jnp.einsum("nik,nk->ni", part, u[each].reshape(len(each), -1)) for part, each in slices])[self.place]

    def unknowns(self) -> tuple[np.ndarray, np.ndarray]:
        """The row and the column, numbered 3 node + direction, of each entry."""
        node, begin = np.argsort(np.asarray(self.place)), 0
        rows, columns = [], []
        for each in map(np.asarray, self.neighbours):
            shape = len(each), 3, 3 * each.shape[1]
            row = 3 * node[begin : begin + len(each), None] + np.arange(3)
            column = np.repeat(3 * each, 3, axis=1) + np.tile(np.arange(3), each.shape[1])
            rows.append(np.broadcast_to(row[:, :, None], shape).ravel())
            columns.append(np.broadcast_to(column[:, None], shape).ravel())
            begin += len(each)
        return np.concatenate(rows), np.concatenate(columns)

    def matrix(self, lame: Lame | np.ndarray) -> sp.csr_matrix:
        """The same on the host, (3n, 3n)."""
        size = 3 * len(self.place)
        matrix = sp.csr_matrix((np.asarray(self.entries(jnp.asarray(lame))), self.unknowns()), shape=(size, size))
        matrix.eliminate_zeros()  # among them what rows are filled up with
        return matrix


def pairs_of(tets: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of nodes that share an element, as row * nodes + column, sorted; and which pair each element's are, (e, a, a)."""
    flat = (tets[:, :, None].astype(np.int64) * nodes + tets[:, None, :]).ravel()
    pairs, which = np.unique(flat, return_inverse=True)
    return pairs, which.reshape(len(tets), tets.shape[1], tets.shape[1])


def sliced(tets: np.ndarray, layer: np.ndarray, free: np.ndarray, matrices: Iterable[tuple[slice, Parts]]) -> Sliced:
    """Add up element matrices (e, a, 3, a, 3), per unit of each Lame parameter, between the free ones (n,) of the nodes of `tets` (e, a).

    The matrices come for one part of the elements after another.
    """
    n = len(free)
    pairs, which = pairs_of(tets, n)
    row, column = np.divmod(pairs, n)
    valence = np.bincount(row, minlength=n)
    slot = np.arange(len(pairs)) - np.repeat(np.cumsum(valence) - valence, valence)
    order = np.argsort(valence, kind="stable")
    cuts = np.unique([round(share * n) for share in SHARES])
    slices = [order[begin:end] for begin, end in itertools.pairwise(cuts)]
    width = np.repeat([max(int(valence[nodes].max()), 1) for nodes in slices], np.diff(cuts))
    place = np.argsort(order)
    begin = np.concatenate([[0], np.cumsum(9 * width)])
    filled = np.zeros((n, int(width.max())), np.int32)
    filled[row, slot] = column
    terms = Terms(int(begin[-1]))
    at = np.where(free[row] & free[column], begin[place[row]] + 3 * slot, -1)
    for part, parts in matrices:
        terms.add_rows(at[which[part]], 3 * width[place[row]][which[part]], layer[part], parts)
    neighbours = tuple(jnp.asarray(filled[nodes, : width[place[nodes[0]]]]) for nodes in slices)
    return Sliced(neighbours, jnp.asarray(place, jnp.int32), terms.affine())
