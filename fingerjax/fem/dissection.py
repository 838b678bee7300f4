"""In which order a sparse matrix's unknowns are eliminated: nested dissection (George, 1973).

A graph is cut in two by taking few nodes away, and so are its halves. What belongs to different halves is never coupled by elimination,
so the fewer nodes a cut takes, the less fills in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

SMALL = 200  # unknowns that are eliminated together without a cut: fewer are not worth a front of their own
WHERE = (0.45, 0.5, 0.55)  # of the weight: where cuts are tried
UNEVEN = 0.5  # of a cut's weight that halves of zero and all would count for


@dataclass(frozen=True)
class Part:
    """Nodes that are eliminated together, in their order, and the parts (none or two) that come before them."""

    nodes: np.ndarray
    children: tuple[int, ...]


def dissect(graph: sp.csr_matrix, weight: np.ndarray) -> list[Part]:
    """The parts of a symmetric graph (n, n), children before parents; `weight` (n,): unknowns of each node."""
    dissection = _Dissection(graph, weight)
    dissection.cut(np.arange(len(weight)))
    return dissection.parts


class _Dissection:
    def __init__(self, graph: sp.csr_matrix, weight: np.ndarray):
        self.parts: list[Part] = []
        self._graph, self._weight = graph, weight
        self._place, self._placed = np.full(len(weight), -1), 0

    def cut(self, nodes: np.ndarray) -> int:
        """Dissect some nodes; the number of their last part."""
        if self._weight[nodes].sum() <= SMALL:
            return self._add(nodes, ())
        first, second = _halves(self._graph[nodes][:, nodes], self._weight[nodes])
        if not first.any() or not second.any():
            return self._add(nodes, ())
        begin = self._placed
        one = self.cut(nodes[first])
        middle = self._placed
        return self._add(self._along(nodes[~first & ~second], begin, middle), (one, self.cut(nodes[second])))

    def _add(self, nodes: np.ndarray, children: tuple[int, ...]) -> int:
        self._place[nodes] = self._placed + np.arange(len(nodes))
        self._placed += len(nodes)
        self.parts.append(Part(nodes, children))
        return len(self.parts) - 1

    def _along(self, nodes: np.ndarray, begin: int, end: int) -> np.ndarray:
        """The nodes of a cut in the order of their first neighbours in one half: what a part of it is coupled to then lies together."""
        rows = self._graph[nodes]
        place = self._place[rows.indices]
        first = np.full(len(nodes), end)
        inside = (place >= begin) & (place < end)
        np.minimum.at(first, np.repeat(np.arange(len(nodes)), np.diff(rows.indptr))[inside], place[inside])
        return nodes[np.argsort(first, kind="stable")]


def _halves(graph: sp.csr_matrix, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool: two parts of a graph that do not touch; the rest is the lightest cut of those tried."""
    best, least = (np.zeros(len(weight), bool),) * 2, np.inf
    for along in _directions(graph):
        order = np.argsort(along, kind="stable")
        before = np.cumsum(weight[order])
        for share in WHERE:
            left = np.zeros(len(order), bool)
            left[order[: np.searchsorted(before, share * before[-1])]] = True
            cut = _cover(graph, left)
            first, second = left & ~cut, ~left & ~cut
            one, other = weight[first].sum(), weight[second].sum()
            cost = weight[cut].sum() * (1 + UNEVEN * abs(one - other) / max(one + other, 1))
            if cost < least:
                best, least = (first, second), cost
    return best


def _directions(graph: sp.csr_matrix) -> list[np.ndarray]:
    """Orders of the nodes along two ways through the graph, by steps between neighbours: its length, and one across."""
    one = _steps(graph, int(np.argmax(_steps(graph, 0))))
    end = int(np.argmax(one))
    other = _steps(graph, end)
    aside = _steps(graph, int(np.argmax(np.minimum(one, other))))
    opposite = _steps(graph, int(np.argmax(aside)))
    slightly = 0.5 / (1 + max(one.max(), aside.max()))  # parts ties
    return [one - other + slightly * aside, aside - opposite + slightly * one]


def _steps(graph: sp.csr_matrix, start: int) -> np.ndarray:
    """From one node to each; one more than to the farthest where there is no way."""
    steps = csgraph.dijkstra(graph, unweighted=True, indices=start)
    far = np.isfinite(steps)
    return np.where(far, steps, steps[far].max() + 1)


def _cover(graph: sp.csr_matrix, left: np.ndarray) -> np.ndarray:
    """(n,) bool: fewest nodes that touch every edge between `left` and the others, from a greatest matching (König, 1931)."""
    ours, theirs = np.flatnonzero(left), np.flatnonzero(~left)
    across = graph[ours][:, theirs]
    ours, theirs = ours[np.diff(across.indptr) > 0], theirs[np.unique(across.indices)]
    across = graph[ours][:, theirs]
    partner = csgraph.maximum_bipartite_matching(across, perm_type="column")
    row, column = np.repeat(np.arange(len(ours)), np.diff(across.indptr)), across.indices
    loose, matched, alone = partner[row] != column, np.flatnonzero(partner >= 0), np.flatnonzero(partner < 0)
    # From those without a partner, over to the right by any other edge and back to the left by a partner's only.
    root = len(ours) + len(theirs)
    tails = np.concatenate([row[loose], len(ours) + partner[matched], np.full(len(alone), root)])
    heads = np.concatenate([len(ours) + column[loose], matched, alone])
    ways = sp.csr_matrix((np.ones(len(tails), np.int8), (tails, heads)), shape=(root + 1, root + 1))
    reached = np.zeros(root + 1, bool)
    reached[csgraph.breadth_first_order(ways, root, return_predecessors=False)] = True
    cut = np.zeros(len(left), bool)
    cut[ours[~reached[: len(ours)]]] = True
    cut[theirs[reached[len(ours) : root]]] = True
    return cut
