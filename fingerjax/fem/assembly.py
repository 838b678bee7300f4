"""The stiffness as a sparse matrix on the host, for direct factorisation and for the coarse levels of multigrid."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property
from weakref import WeakValueDictionary

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from .body import Body
from .springs import Springs

BODIES = 3  # whose sums are kept
CHUNK = 20_000  # elements whose matrices are held at a time


def chunks(body: Body) -> Iterator[slice]:
    """The elements in portions whose matrices fit into memory."""
    return (slice(begin, begin + CHUNK) for begin in range(0, len(body.tets), CHUNK))


def element_matrices(body: Body, part: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness (e, 3a, 3a) of a part of the elements, per unit of Lame's first parameter and per unit of shear modulus, mm."""
    weight = np.asarray(body.weight)[part]
    inverse = np.broadcast_to(np.asarray(body.inverse)[part], (*weight.shape, 3, 3))
    slope = np.einsum("qak,eqkj->eqaj", np.asarray(body.slopes), inverse, optimize=True)
    outer = np.einsum("eq,eqai,eqbj->eaibj", weight, slope, slope, optimize=True)
    square = np.einsum("eaibi->eab", outer)[:, :, None, :, None] * np.eye(3)[None, None, :, None, :]
    size = outer.shape[1] * 3
    shear = np.swapaxes(outer, 2, 4) + square
    return _volumetric(body, weight, slope, outer).reshape(-1, size, size), shear.reshape(-1, size, size)


def _volumetric(body: Body, weight: np.ndarray, slope: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """Products of divergences (e, a, i, b, j): pointwise, they are those of the slopes; of means, those of the slopes' means."""
    if body.dilatation == "pointwise":
        return outer
    total = np.einsum("eq,eqai->eai", weight, slope)
    return np.einsum("eai,ebj,e->eaibj", total, total, 1 / weight.sum(axis=1), optimize=True)


class Pattern:
    """Where the element matrices of elements with these supports and layers go in the stiffness between free degrees of freedom, or in its
    `upper` triangle alone.

    - `free`: the free ones of all `unknowns`; `matrix`: sparse, a one wherever there is an entry. `used`: which entries of the element
      matrices, flattened, count at all.
    - `where`, of each of these, in sums over the elements of a layer; `layer` and `place`, of each sum, in the matrix.
    """

    def __init__(self, body: Body, *, upper: bool):
        tets, nodes = np.asarray(body.tets), len(body.free)
        self.upper, self.unknowns = upper, 3 * nodes
        self.free = np.flatnonzero(np.broadcast_to(np.asarray(body.moves) > 0, (nodes, 3)))
        # The pattern is found between nodes, nine times fewer than the numbers in it.
        row, column = np.repeat(tets, tets.shape[1], axis=1).ravel(), np.tile(tets, tets.shape[1]).ravel()
        pairs, block = np.unique(row.astype(np.int64) * nodes + column, return_inverse=True)
        matrix = _positions(pairs, nodes)[self.free][:, self.free]
        if upper:
            matrix = sp.triu(matrix, format="csr")
        matrix.sort_indices()
        self._slot = np.full(9 * len(pairs), -1, np.int32)  # of each entry of each node pair's block, among the matrix's own
        self._slot[matrix.data - 1] = np.arange(matrix.nnz)
        self._block = block.reshape(len(tets), tets.shape[1], tets.shape[1]).astype(np.int32)
        self.matrix = sp.csr_matrix((np.ones(matrix.nnz, np.int8), matrix.indices, matrix.indptr), shape=matrix.shape)
        self._place_elements(np.asarray(body.layer))

    @classmethod
    def of(cls, body: Body, *, upper: bool) -> Pattern:
        """That of a body; one that some other body has in use serves it as well."""
        said = (np.asarray(body.tets), np.asarray(body.moves) > 0, np.asarray(body.layer), np.asarray([upper, len(body.free)]))
        digest = hashlib.blake2b(b"".join(f"{part.shape}{part.dtype}".encode() + part.tobytes() for part in said)).digest()
        found = _PATTERNS.get(digest)
        if found is None:
            found = _PATTERNS[digest] = cls(body, upper=upper)
        return found

    def _place_elements(self, of: np.ndarray) -> None:
        """Where the entries of each layer's elements are added up: refilling then costs little more than reading the matrix."""
        place = self._slot[_entries(self._block)]
        self.used = place >= 0
        layer = np.repeat(of, self.used.size // len(of))[self.used]
        key = layer * np.int64(self.matrix.nnz) + place[self.used]
        kept, where = np.unique(key, return_inverse=True)
        self.where = where.astype(np.int32)
        self.layer, self.place = (part.astype(np.int32) for part in np.divmod(kept, self.matrix.nnz))

    @cached_property
    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Which entries of the element matrices, flattened, are summed, and where: found once, for tangents that come by the dozen."""
        place = self._slot[_entries(self._block)]
        entry = np.flatnonzero(place >= 0)
        return entry.astype(np.int32), place[entry].astype(np.int32)


_PATTERNS: WeakValueDictionary[bytes, Pattern] = WeakValueDictionary()


class Assembled:
    """Sparse stiffness between free degrees of freedom, refilled for other moduli, and for other bodies of the same elements, without
    looking at the pattern again.

    `upper` keeps the upper triangle alone, as a symmetric factorisation wants it.
    """

    def __init__(self, body: Body, *, upper: bool):
        self.body, self.pattern = body, Pattern.of(body, upper=upper)
        self._sums: OrderedDict[tuple[int, int], tuple[Body, np.ndarray, np.ndarray]] = OrderedDict()

    @property
    def free(self) -> np.ndarray:
        """The free ones of all unknowns."""
        return self.pattern.free

    def _summed(self, body: Body) -> tuple[np.ndarray, np.ndarray]:
        """Volumetric and shear stiffness of a body with these elements and supports, added up; the last few bodies' are kept."""
        key = id(body.weight_along), id(body.inverse_along)
        if key not in self._sums:
            while len(self._sums) >= BODIES:
                self._sums.popitem(last=False)
            on = self.pattern
            volumetric, shear = (np.bincount(on.where, part.ravel()[on.used], len(on.place)) for part in element_matrices(body))
            self._sums[key] = body, volumetric, shear
        self._sums.move_to_end(key)
        return self._sums[key][1:]

    def matrix(self, lame: np.ndarray, body: Body | None = None) -> sp.csr_matrix:
        """The stiffness, N/mm, for Lame parameters (2, layers), MPa; `body`: another one with the same elements and supports."""
        body = self.body if body is None else body
        volumetric, shear = self._summed(body)
        lam, mu = np.asarray(lame)[:, self.pattern.layer]
        data = np.bincount(self.pattern.place, lam * volumetric + mu * shear, self.pattern.matrix.nnz)
        return self._holding(data + self._sprung(lame, body.springs))

    def _sprung(self, lame: np.ndarray, springs: Springs | None) -> np.ndarray | float:
        """What springs add to the matrix's entries."""
        if springs is None:
            return 0.0
        place, kept = self._sought(np.asarray(springs.row), np.asarray(springs.column))
        return np.bincount(place, np.asarray(springs.at(jnp.asarray(lame)))[kept], self.pattern.matrix.nnz)

    def _sought(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where entries between unknowns stand among the matrix's own, and which of them are in it at all."""
        matrix = self.pattern.matrix
        number = np.full(int(self.pattern.unknowns), -1)
        number[self.free] = np.arange(len(self.free))
        row, column = number[row], number[column]
        kept = (row >= 0) & (column >= 0) & ((column >= row) | (not self.pattern.upper))
        size = matrix.shape[0]
        own = np.repeat(np.arange(size), np.diff(matrix.indptr)) * np.int64(size) + matrix.indices
        wanted = row[kept] * np.int64(size) + column[kept]
        place = np.searchsorted(own, wanted)
        if not np.array_equal(own[np.minimum(place, len(own) - 1)], wanted):
            raise ValueError("springs join nodes that share no element")
        return place, kept

    def filled(self, elements: np.ndarray, lame: np.ndarray, springs: Springs | None) -> sp.csr_matrix:
        """The matrix that given element matrices (e, 3a, 3a), N/mm, add up to, with springs beside them at some Lame parameters, MPa."""
        entry, place = self.pattern.entries
        return self._holding(np.bincount(place, elements.ravel()[entry], self.pattern.matrix.nnz) + self._sprung(lame, springs))

    def _holding(self, data: np.ndarray) -> sp.csr_matrix:
        matrix = self.pattern.matrix
        return sp.csr_matrix((data, matrix.indices, matrix.indptr), shape=matrix.shape)


def _entries(block: np.ndarray) -> np.ndarray:
    """Where each entry of the element matrices (e, 3a, 3a), flattened, is summed: its node pair's block (e, a, a), then row and column."""
    within = 3 * np.arange(3)[:, None] + np.arange(3)
    # e element, a and b nodes, i and j directions
    return (9 * block[:, :, None, :, None] + within[None, None, :, None, :]).ravel()


def _positions(pairs: np.ndarray, nodes: int) -> sp.csr_matrix:
    """A matrix whose entries say, counted from one, where in the sum over blocks each of them lies."""
    rows = np.concatenate([[0], np.cumsum(np.bincount(pairs // nodes, minlength=nodes))])
    numbers = np.arange(1, 9 * len(pairs) + 1).reshape(-1, 3, 3)
    return sp.bsr_matrix((numbers, pairs % nodes, rows), shape=(3 * nodes, 3 * nodes)).tocsr()
