"""A condensed body: whichever way it was condensed, its columns read the same, and it answers loads that are not among them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from threadpoolctl import threadpool_limits

from fingerjax.fem.body import material
from fingerjax.fem.cholesky import AbstractCholesky, Indefinite
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.condensed import ByColumns, ByFactor, Stiffer, first_like, probe
from fingerjax.fem.factorised import PARTIAL_FROM
from fingerjax.fem.frontal import Frontal
from fingerjax.fem.pardiso import Pardiso, pardiso_available
from fingerjax.fem.recovery import strain_columns
from fingerjax.fem.solver import solver_for
from fingerjax.fem.stiffness import tangent
from fingerjax.fem.tissue import FiniteStrain

from .fem_tools import cube_body

needs_pardiso = pytest.mark.skipif(not pardiso_available(), reason="pypardiso is not installed")
FACTORISATIONS = [Frontal, pytest.param(Pardiso, marks=needs_pardiso)]
SKIN = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}, 0.48)


@pytest.fixture(scope="module")
def body():
    return cube_body(4, layers=4)


def columns_of(body, every):
    """Heights of nodes of the lower face, and a strain inside."""
    face = np.flatnonzero(np.asarray(body.nodes)[:, 1] < 1e-9)[::every]
    heights = sp.csc_matrix((np.ones(len(face)), (3 * face + 1, np.arange(len(face)))), shape=(3 * len(body.free), len(face)))
    return columns_from_matrix(sp.hstack([heights, strain_columns(body, np.array([0.52, 0.3, 0.47]))[0]]).tocsc())


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 9])
def test_both_solvers_condense_to_the_same(body, every):
    columns = columns_of(body, every)
    assert (columns.count >= PARTIAL_FROM) == (every == 1)
    iterated, factored = (solver_for(body, kind).condense(body, SKIN.lame(), columns) for kind in ("multigrid", "factorised"))
    assert isinstance(iterated, ByColumns) and isinstance(factored, ByFactor)
    assert iterated.held.converged and factored.held.converged and factored.held.residual < 1e-10
    size = float(jnp.abs(iterated.held.matrix).max())
    np.testing.assert_allclose(factored.held.matrix, iterated.held.matrix, atol=1e-7 * size)
    forces = jnp.asarray(np.random.default_rng(0).normal(size=(3, columns.count)))
    u, v = iterated.displacement(forces), factored.displacement(forces)
    np.testing.assert_allclose(v, u, atol=1e-7 * float(jnp.abs(u).max()))
    np.testing.assert_allclose(columns.read(v), forces @ factored.held.matrix, atol=1e-9 * float(jnp.abs(columns.read(v)).max()))
    loads = jnp.asarray(np.random.default_rng(1).normal(size=(2, *body.nodes.shape))) * body.free[:, None]
    one, other = iterated.readings(loads), factored.readings(loads)
    np.testing.assert_allclose(other, one, atol=1e-7 * float(jnp.abs(one).max()))


def test_a_material_in_proportion_takes_the_solves_of_another(body):
    columns, solver = columns_of(body, 9), solver_for(body, "multigrid")
    lame = SKIN.lame()
    softer, thrice = lame.at[:, 1].multiply(0.5), lame.at[:, :4].multiply(3.0)  # no element is bone
    assert first_like(body, [lame, softer, thrice], 0) == (0, 1.0) and first_like(body, [lame, softer, thrice], 1) == (1, 1.0)
    like, times = first_like(body, [lame, softer, thrice], 2)
    assert (like, times) == (0, pytest.approx(3.0, rel=1e-14))
    own, taken = solver.condense(body, thrice, columns), Stiffer(solver.condense(body, lame, columns), times, thrice)
    assert bool((taken.held.lame == thrice).all())
    forces = jnp.asarray(np.random.default_rng(0).normal(size=(2, columns.count)))
    loads = jnp.asarray(np.random.default_rng(1).normal(size=(2, *body.nodes.shape))) * body.free[:, None]
    for what in (lambda one: one.held.matrix, lambda one: one.displacement(forces), lambda one: one.readings(loads)):
        mine, theirs = np.asarray(what(own)), np.asarray(what(taken))
        np.testing.assert_allclose(theirs, mine, atol=1e-7 * np.abs(mine).max())


def test_an_older_condensation_still_answers_for_its_own_material(body):
    columns, solver = columns_of(body, 1), solver_for(body, "factorised")
    other = jnp.asarray([[2.0], [1.5]]) * SKIN.lame()
    first = solver.condense(body, SKIN.lame(), columns)
    second = solver.condense(body, other, columns)
    assert probe(columns, first) < 1e-10 and probe(columns, second) < 1e-10
    np.testing.assert_allclose(second.held.matrix, solver_for(body, "factorised").condense(body, other, columns).held.matrix, rtol=1e-9)


def test_a_strained_body_answers_with_a_factorisation_of_its_own_and_what_is_forgotten_is_made_again(body):
    columns, solver = columns_of(body, 9), solver_for(body, "factorised")
    linear = solver.condense(body, SKIN.lame(), columns)
    strained = [solver.reduce(tangent(body, FiniteStrain(), SKIN.lame(), s * body.nodes), columns) for s in (0.01, 0.02)]
    loads = jnp.asarray(np.random.default_rng(1).normal(size=(2, *body.nodes.shape))) * body.free[:, None]
    before = [np.asarray(one.readings(loads)) for one in (linear, *strained)]
    assert all(one.memory > 0 for one in strained) and linear.memory == 0
    solver.forget()
    assert solver.host._factor is None
    for one, found in zip((linear, *strained), before, strict=True):
        np.testing.assert_allclose(one.readings(loads), found, rtol=1e-9, atol=1e-12 * np.abs(found).max())
    assert np.abs(before[1] - before[2]).max() > 1e-3 * np.abs(before[1]).max()


def test_what_is_forgotten_leaves_the_last_answer_at_hand(body):
    columns, solver = columns_of(body, 9), solver_for(body, "factorised")
    lames = [SKIN.lame(), SKIN.lame().at[:, 1].multiply(0.5)]
    first, last = (solver.condense(body, lame, columns) for lame in lames)
    assert solver.condense(body, lames[0], columns) is first
    solver.forget()
    assert solver.condense(body, lames[1], columns) is last
    again = solver.condense(body, lames[0], columns)
    assert again is not first
    np.testing.assert_allclose(again.held.matrix, first.held.matrix, rtol=1e-9)


def test_a_body_whose_constants_all_moved_in_proportion_is_not_factorised_again(body, monkeypatch):
    columns, solver = columns_of(body, 9), solver_for(body, "factorised")
    first = solver.condense(body, SKIN.lame(), columns)
    fresh = solver_for(body, "factorised").condense(body, 3.0 * SKIN.lame(), columns)
    monkeypatch.setattr(type(solver.host._factor), "factor", lambda *_: pytest.fail("factorised once more"))
    found = solver.condense(body, 3.0 * SKIN.lame(), columns)
    assert found.unscaled == (first, pytest.approx(3.0, rel=1e-14))
    np.testing.assert_allclose(found.held.matrix, fresh.held.matrix, rtol=1e-9)
    forces = jnp.asarray(np.random.default_rng(0).normal(size=(2, columns.count)))
    np.testing.assert_allclose(found.displacement(forces), fresh.displacement(forces), atol=1e-9)


@pytest.mark.parametrize("how", FACTORISATIONS)
def test_the_schur_complement_is_the_stiffness_of_what_is_kept(how: type[AbstractCholesky]):
    random = np.random.default_rng(3)
    A = sp.random(80, 80, 0.08, random_state=3)
    K = sp.csr_matrix(A @ A.T + 2.0 * sp.eye(80))
    kept = random.random(80) < 0.15
    upper = sp.triu(K, format="csr")
    upper.sort_indices()
    factor = how(upper.indptr, upper.indices, kept)
    for scale in (1.0, 3.0):
        schur = factor.factor(scale * upper.data)
        dense = scale * K.toarray()
        np.testing.assert_allclose(np.linalg.inv(schur), np.linalg.inv(dense)[np.ix_(kept, kept)], atol=1e-12)
        right = random.normal(size=(80, 2))
        np.testing.assert_allclose(dense @ factor.solve(right), right, atol=1e-10)


@pytest.mark.parametrize("how", FACTORISATIONS)
def test_a_matrix_that_is_not_positive_definite_is_refused(how: type[AbstractCholesky]):
    upper = sp.csr_matrix(np.triu(np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.5], [0.0, 0.5, 1.0]])))
    factor = how(upper.indptr, upper.indices)
    with pytest.raises(Indefinite, match="not positive definite"):
        factor.factor(upper.data)


def test_the_last_few_bodies_are_kept_and_still_answer(body):
    columns, solver = columns_of(body, 9), solver_for(body, "factorised")
    one, other = (solver.condense(body, times * SKIN.lame(), columns) for times in (1.0, jnp.asarray([[2.0], [1.5]])))
    assert solver.condense(body, SKIN.lame(), columns) is one
    forces = jnp.asarray(np.random.default_rng(0).normal(size=(2, columns.count)))
    for each in (one, other, one):
        read = columns.read(each.displacement(forces))
        np.testing.assert_allclose(read, forces @ each.held.matrix, atol=1e-9 * float(jnp.abs(read).max()))


@pytest.mark.parametrize("every", [1, 9])
def test_columns_that_were_asked_for_before_are_not_solved_for_again(body, every, monkeypatch):
    columns, solver = columns_of(body, every), solver_for(body, "factorised")
    heights = columns.matrix()[:, :-6]
    elsewhere = strain_columns(body, np.array([0.3, 0.52, 0.4]))[0]
    moved = columns_from_matrix(sp.hstack([elsewhere, heights[:, ::-1]]).tocsc())
    fresh = solver_for(body, "factorised").condense(body, SKIN.lame(), moved)
    solver.condense(body, SKIN.lame(), columns)
    monkeypatch.setattr(type(solver.host._factor), "factor", lambda *_: pytest.fail("factorised once more"))
    found = solver.condense(body, SKIN.lame(), moved)
    np.testing.assert_allclose(found.held.matrix, fresh.held.matrix, atol=1e-10 * float(jnp.abs(fresh.held.matrix).max()))
    forces = jnp.asarray(np.random.default_rng(0).normal(size=(2, moved.count)))
    np.testing.assert_allclose(found.displacement(forces), fresh.displacement(forces), atol=1e-9)
    assert found.held.converged and found.held.residual < 1e-10


@needs_pardiso
def test_what_several_threads_analysed_can_be_factored_where_there_are_fewer():
    """MKL itself ends the process here, at this size and above."""
    side = sp.diags([-1.0, 2.1, -1.0], [-1, 0, 1], (23, 23))
    K = sp.csr_matrix(sp.kronsum(sp.kronsum(side, side), side))
    upper, right = sp.csr_matrix(sp.triu(K)).sorted_indices(), np.ones((K.shape[0], 1))
    Pardiso(upper.indptr, upper.indices).factor(upper.data)  # loads MKL, before which nothing can be limited
    with threadpool_limits(2):
        factor = Pardiso(upper.indptr, upper.indices)
        factor.factor(upper.data)
    for threads in (1, 2):
        with threadpool_limits(threads):
            factor.factor(threads * upper.data)
            np.testing.assert_allclose(threads * (K @ factor.solve(right)), right, atol=1e-10)
