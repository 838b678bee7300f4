"""A sparse Cholesky factorisation in dense pieces, by NumPy and SciPy alone: the multifrontal method (Duff & Reid, 1983).

Every part of a nested dissection is eliminated in a dense matrix of its own, its front: the part's unknowns, and the later ones they are
coupled to by then. What elimination leaves on these is added to the front of the part that follows. Nearly all work is done in BLAS.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.linalg import blas, lapack

from .cholesky import AbstractCholesky, Indefinite
from .dissection import dissect

Block = tuple[slice, slice]
Move = tuple[int, Block, Block]  # to which piece of a front, where in it, and from where in the remainder that is added


@dataclass
class _Front:
    """The unknowns `begin` to `end`, in the order of elimination, and `rows`, the later ones that they are coupled to.

    Its pieces are lower (m, m) and below (r, m), which hold the factor in the end, and the remainder (r, r) for the front that follows.
    """

    begin: int
    end: int
    rows: np.ndarray
    children: tuple[int, ...]
    moves: list[Move] = field(default_factory=list)  # of the remainder, into the pieces of the front that follows
    lower: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    below: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def own(self) -> int:
        return self.end - self.begin


class Frontal(AbstractCholesky):
    """Needs no extra package. The second and later factorisations find their memory in place and are the faster ones."""

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, kept: np.ndarray | None = None):
        size = len(indptr) - 1
        held = np.zeros(size, bool) if kept is None else np.asarray(kept, bool)
        label, first, graph = _joined(indptr, indices, held)
        weight, whole = np.bincount(label), held[first]
        free, last = np.flatnonzero(~whole), np.flatnonzero(whole)
        parts = dissect(graph[free][:, free], weight[free])
        order = np.concatenate([*(free[part.nodes] for part in parts), last[np.argsort(first[last])]])
        self._order = np.argsort(np.argsort(order)[label], kind="stable")
        self._last = size - int(held.sum())
        ends = np.cumsum([0, *(len(part.nodes) for part in parts)])
        self._fronts = _fronts(graph[order][:, order], weight[order], ends, [part.children for part in parts])
        self._place_entries(indptr, indices)
        self._spare: list[np.ndarray] = []  # room for remainders, kept for the next factorisation
        self._root = np.zeros((0, 0))

    def _place_entries(self, indptr: np.ndarray, indices: np.ndarray) -> None:
        """Where each of the matrix's entries goes: those of one front follow one another, its lower piece first."""
        where = np.argsort(self._order)
        row, column = where[np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))], where[indices]
        early, late = np.minimum(row, column), np.maximum(row, column)
        number = np.searchsorted([front.end for front in self._fronts], early, side="right")
        ends = np.array([*(front.end for front in self._fronts), len(self._order)])
        piece = 2 * number + (late >= ends[number])
        self._entry = np.lexsort((late, early, piece))
        early, late = early[self._entry], late[self._entry]
        cuts = np.searchsorted(piece[self._entry], np.arange(2 * len(self._fronts) + 1))
        self._entries: list[tuple[slice, np.ndarray]] = []  # of each front's two pieces: which entries, and where, column by column
        for front, a, b, c in zip(self._fronts, cuts[:-1:2], cuts[1::2], cuts[2::2], strict=True):
            self._entries.append((slice(a, b), late[a:b] - front.begin + (early[a:b] - front.begin) * front.own))
            at = np.searchsorted(front.rows, late[b:c])
            self._entries.append((slice(b, c), at + (early[b:c] - front.begin) * len(front.rows)))
        self._among_kept = slice(cuts[-1], None), (late[cuts[-1] :] - self._last, early[cuts[-1] :] - self._last)

    def factor(self, data: np.ndarray) -> np.ndarray:
        entries = np.asarray(data, float)[self._entry]
        remainders: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for number, front in enumerate(self._fronts):
            room, remainder = self._room(len(front.rows))
            self._assemble(number, entries, remainder, remainders)
            _eliminate(front, remainder)
            remainders[number] = room, remainder
        chosen, at = self._among_kept
        schur = np.zeros((len(self._order) - self._last,) * 2)
        schur[at] = entries[chosen]
        if self._fronts:
            room, remainder = remainders.pop(len(self._fronts) - 1)
            rows = self._fronts[-1].rows - self._last
            schur[np.ix_(rows, rows)] += np.tril(remainder)
            self._spare.append(room)
        schur = schur + np.tril(schur, -1).T
        self._root = _cholesky(np.array(schur, order="F"))
        return schur

    def _room(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Zeros (size, size), column by column, and the memory that they are in."""
        fit = [number for number, room in enumerate(self._spare) if room.size >= size**2]
        room = self._spare.pop(min(fit, key=lambda number: self._spare[number].size)) if fit else np.empty(size**2)
        remainder = room[: size**2].reshape((size, size), order="F")
        remainder.fill(0.0)
        return room, remainder

    def _assemble(self, number: int, entries: np.ndarray, remainder: np.ndarray, remainders: dict) -> None:
        front = self._fronts[number]
        if front.lower.shape[0] != front.own:
            front.lower, front.below = np.zeros((front.own,) * 2, order="F"), np.zeros((len(front.rows), front.own), order="F")
        pieces = front.lower, front.below, remainder
        for piece, (chosen, at) in zip(pieces[:2], self._entries[2 * number : 2 * number + 2], strict=True):
            piece.fill(0.0)
            piece.reshape(-1, order="F")[at] = entries[chosen]
        for child in front.children:
            room, left = remainders.pop(child)
            for to, there, here in self._fronts[child].moves:
                pieces[to][there] += left[here]
            self._spare.append(room)

    def solve(self, right: np.ndarray) -> np.ndarray:
        y = np.asfortranarray(np.asarray(right, float)[self._order])
        if not y.size:
            return y
        for front in self._fronts:
            if front.own:
                y[front.begin : front.end] = blas.dtrsm(1.0, front.lower, y[front.begin : front.end], lower=1)
                y[front.rows] -= front.below @ y[front.begin : front.end]
        if len(self._root):
            y[self._last :] = scipy.linalg.cho_solve((self._root, True), y[self._last :], check_finite=False)
        for front in reversed(self._fronts):
            if front.own:
                load = y[front.begin : front.end] - front.below.T @ y[front.rows]
                y[front.begin : front.end] = blas.dtrsm(1.0, front.lower, load, lower=1, trans_a=1)
        answer = np.empty_like(y)
        answer[self._order] = y
        return answer

    @property
    def memory(self) -> int:
        return self._root.nbytes + sum(front.lower.nbytes + front.below.nbytes for front in self._fronts)


def _eliminate(front: _Front, remainder: np.ndarray) -> None:
    """Factorise a front in place; of the remainder only the lower triangle is meant."""
    if not front.own:
        return
    front.lower = _cholesky(front.lower)
    if len(front.rows):
        front.below = blas.dtrsm(1.0, front.lower, front.below, side=1, lower=1, trans_a=1, overwrite_b=1)
        blas.dsyrk(-1.0, front.below, beta=1.0, c=remainder, lower=1, overwrite_c=1)


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """The lower factor, in place; what is above the diagonal is not meant."""
    if not len(matrix):
        return matrix
    lower, failed = lapack.dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise Indefinite
    return lower


def _joined(indptr: np.ndarray, indices: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, sp.csr_matrix]:
    """Unknowns with the same neighbours, such as the directions of one node, as one, and the graph of these. Kept ones stay apart.

    Returns which one each is (n,), the first unknown of each, and the graph.
    """
    size = len(kept)
    upper = sp.csr_matrix((np.ones(len(indices)), indices, indptr), shape=(size, size))
    pattern = (upper + upper.T).tocsr()
    pattern.sort_indices()
    pattern.data[:] = 1.0
    mark = pattern @ np.random.default_rng(0).random(size)  # alike where the rows are
    mark[kept] = -1.0 - np.arange(np.count_nonzero(kept))
    _, first, label = np.unique(mark, return_index=True, return_inverse=True)
    return label.reshape(-1), first, sp.csr_matrix(pattern[first][:, first])


def _fronts(graph: sp.csr_matrix, weight: np.ndarray, ends: np.ndarray, children: Sequence[tuple[int, ...]]) -> list[_Front]:
    """The fronts of parts that end at `ends` (parts + 1,) in a graph that is numbered in the order of elimination."""
    begin = np.concatenate([[0], np.cumsum(weight)])
    after: list[np.ndarray] = []
    fronts: list[_Front] = []
    for a, b, before in zip(ends[:-1], ends[1:], children, strict=True):
        touched = np.concatenate([graph.indices[graph.indptr[a] : graph.indptr[b]], *(after[child] for child in before)])
        later = np.unique(touched[touched >= b])
        rows = np.concatenate([np.zeros(0, int), *(np.arange(begin[node], begin[node + 1]) for node in later)])
        front = _Front(int(begin[a]), int(begin[b]), rows, before)
        for child in before:
            fronts[child].moves = list(_moves(fronts[child].rows, front))
        after.append(later)
        fronts.append(front)
    return fronts


def _moves(rows: np.ndarray, to: _Front) -> Iterator[Move]:
    """Lower blocks of the remainder on `rows` that stay in one piece on the way into the front that follows."""
    at = np.searchsorted(np.concatenate([np.arange(to.begin, to.end), to.rows]), rows)
    cuts = np.unique(np.concatenate([[0], np.flatnonzero(np.diff(at) != 1) + 1, [np.searchsorted(at, to.own)], [len(at)]])).tolist()
    runs = [(a, b, int(at[a])) for a, b in itertools.pairwise(cuts)]
    for number, (a, b, column) in enumerate(runs):
        for c, d, row in runs[number:]:
            piece = 0 if row < to.own else 1 if column < to.own else 2
            down, along = row - (to.own if piece else 0), column - (to.own if piece == 2 else 0)
            yield piece, (slice(down, down + d - c), slice(along, along + b - a)), (slice(c, d), slice(a, b))
