"""Elimination in the order of a nested dissection: the order keeps apart what it must, and the factorisation answers as a dense one."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerjax.fem.assembly import Assembled
from fingerjax.fem.body import material
from fingerjax.fem.dissection import SMALL, Part, _cover, dissect
from fingerjax.fem.frontal import Frontal
from fingerjax.fem.stiffness import Elastic

from .fem_tools import cube_body

SKIN = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}, 0.48)


def lattice(*sides: int) -> sp.csr_matrix:
    """Neighbours on a lattice, diagonal entries among them."""
    graph = sp.eye(1)
    for side in sides:
        line = sp.diags([np.ones(side - 1), np.ones(side), np.ones(side - 1)], [-1, 0, 1])
        graph = sp.kron(graph, line)
    return sp.csr_matrix(graph)


def upper(matrix: sp.csr_matrix) -> sp.csr_matrix:
    found = sp.csr_matrix(sp.triu(matrix))
    found.sort_indices()
    return found


def definite(graph: sp.csr_matrix, seed: int) -> sp.csr_matrix:
    """A positive definite matrix with the entries of a graph."""
    random = sp.csr_matrix((np.random.default_rng(seed).normal(size=graph.nnz), graph.indices, graph.indptr), shape=graph.shape)
    symmetric = random + random.T
    return sp.csr_matrix(symmetric + sp.diags(np.asarray(abs(symmetric).sum(axis=1)).ravel() + 1.0))


def above(parts: list[Part]) -> np.ndarray:
    """(parts, parts) bool: whether a part comes after another in the same branch, or is it."""
    found = np.eye(len(parts), dtype=bool)
    for number, part in enumerate(parts):
        for child in part.children:
            found[number] |= found[child]
    return found


@pytest.mark.parametrize("sides", [(12, 11, 10), (2000,), (40, 40)])
def test_every_node_is_in_one_part_and_branches_do_not_touch(sides: tuple[int, ...]) -> None:
    graph = lattice(*sides)
    parts = dissect(graph, np.full(graph.shape[0], 3))
    assert len(parts) > 10
    assert np.array_equal(np.sort(np.concatenate([part.nodes for part in parts])), np.arange(graph.shape[0]))
    owner = np.empty(graph.shape[0], int)
    for number, part in enumerate(parts):
        owner[part.nodes] = number
        assert all(child < number for child in part.children)
        assert part.children or 3 * len(part.nodes) <= SMALL
    row, column = graph.nonzero()
    related = above(parts)
    assert (related | related.T)[owner[row], owner[column]].all()


def test_the_first_cut_of_a_lattice_is_about_as_thin_as_the_lattice() -> None:
    parts = dissect(lattice(30, 10, 10), np.ones(3000, int))
    assert 100 <= len(parts[-1].nodes) <= 180  # graph distance cuts askew where steps may be diagonal


@given(seed=st.integers(0, 2**32 - 1), nodes=st.integers(2, 40), share=st.floats(0.0, 0.4))
@settings(max_examples=60, deadline=None)
def test_a_cover_touches_every_edge_across_and_is_as_small_as_a_greatest_matching(seed: int, nodes: int, share: float) -> None:
    random = sp.random(nodes, nodes, share, random_state=seed)
    graph = sp.csr_matrix(random + random.T + sp.eye(nodes))
    left = np.random.default_rng(seed).random(nodes) < 0.5
    cut = _cover(graph, left)
    row, column = graph.nonzero()
    across = left[row] & ~left[column]
    assert (cut[row] | cut[column])[across].all()
    matching = sp.csgraph.maximum_bipartite_matching(sp.csr_matrix(graph[left][:, ~left]), perm_type="column")
    assert cut.sum() == (matching >= 0).sum()


SHAPES = ["lattice", "loose", "full", "apart"]


@given(seed=st.integers(0, 1000), share=st.sampled_from([0.0, 0.05, 0.5, 1.0]), shape=st.sampled_from(SHAPES))
@settings(max_examples=40, deadline=None)
def test_it_answers_as_a_dense_factorisation(seed: int, share: float, shape: str) -> None:
    random = np.random.default_rng(seed)
    graphs = {
        "lattice": lattice(9, 8, 7),
        "loose": sp.csr_matrix((sp.random(300, 300, 0.004, random_state=seed) + sp.eye(300)) @ sp.eye(300)),
        "full": sp.csr_matrix(np.ones((240, 240))),
        "apart": sp.csr_matrix(sp.block_diag([lattice(7, 6, 6), lattice(400), sp.eye(30)])),
    }
    K = definite(graphs[shape], seed)
    kept = random.random(K.shape[0]) < share
    entries = upper(K)
    factor = Frontal(entries.indptr, entries.indices, kept if share else None)
    for scale in (1.0, 2.5):  # the second time in memory that the first one left
        dense = scale * K.toarray()
        schur = factor.factor(scale * entries.data)
        assert schur.shape == (kept.sum(), kept.sum())
        if kept.any():
            np.testing.assert_allclose(np.linalg.inv(schur), np.linalg.inv(dense)[np.ix_(kept, kept)], rtol=1e-9, atol=1e-12)
        for columns in (0, 1, 3):
            right = random.normal(size=(K.shape[0], columns))
            np.testing.assert_allclose(dense @ factor.solve(right), right, rtol=1e-9, atol=1e-9)


def test_what_it_returns_is_the_callers_to_overwrite() -> None:
    K = definite(lattice(6, 6, 6), 0)
    kept, entries = np.arange(216) % 5 == 0, upper(K)
    factor = Frontal(entries.indptr, entries.indices, kept)
    factor.factor(entries.data)[:] = np.nan
    right = np.ones((216, 1))
    np.testing.assert_allclose(K @ factor.solve(right), right, rtol=1e-10)


def test_directions_of_a_node_are_eliminated_together_and_little_fills_in() -> None:
    body = cube_body(6, layers=4)
    K = Elastic(body, SKIN.lame()).matrix(Assembled(body, upper=True))
    factor = Frontal(K.indptr, K.indices)
    assert all(front.own % 3 == 0 and len(front.rows) % 3 == 0 for front in factor._fronts)
    stored = sum(front.own * (front.own + len(front.rows)) for front in factor._fronts)
    assert stored < 0.25 * K.shape[0] ** 2
