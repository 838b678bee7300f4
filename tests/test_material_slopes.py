"""Slopes of a condensed body in its material: against each one solved for by itself, and against differences."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from fingerjax.fem.body import LAYERS, material, reinforced
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.condensed import AbstractCondensed, Stiffer, first_like
from fingerjax.fem.operator import internal_force
from fingerjax.fem.slopes import slopes, slopes_of_all
from fingerjax.fem.solver import solver_for
from fingerjax.fem.springs import springs

from .fem_tools import cube_body

LAME = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}, 0.48).lame()
EPS = 1e-6  # MPa


@pytest.fixture(scope="module")
def body():
    return cube_body(3, layers=4)


@pytest.fixture(scope="module")
def columns(body):
    face = np.flatnonzero(np.asarray(body.nodes)[:, 1] < 1e-9)[::5]
    heights = sp.csc_matrix((np.ones(len(face)), (3 * face + 1, np.arange(len(face)))), shape=(3 * len(body.free), len(face)))
    return columns_from_matrix(heights)


@pytest.fixture(scope="module")
def condensed(body, columns):
    return solver_for(body, "factorised").condense(body, LAME, columns)


def ways(count, seed=0):
    """Orthonormal directions; with `count` moduli moving, all constants in proportion are among them where count is 4."""
    moved = np.zeros((count, 2, len(LAYERS)))
    for number in range(count):
        moved[number, :, number] = np.asarray(LAME)[:, number]
    basis = np.linalg.qr(moved.reshape(count, -1).T)[0]
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, count)))[0]
    return jnp.asarray((basis @ turn).T.reshape(count, 2, len(LAYERS)))


def one_by_one(condensed, body, forces, directions):
    u = condensed.displacement(forces)
    return np.stack([[-condensed.readings(internal_force(body, way, each)[None])[0] for way in directions] for each in u])


class Counting(AbstractCondensed):
    """Another condensed body, and how many loads it was asked to answer."""

    def __init__(self, condensed):
        self._condensed, self.held, self.asked = condensed, condensed.held, 0

    def displacement(self, forces):
        self.asked += len(forces)
        return self._condensed.displacement(forces)

    def readings(self, loads):
        self.asked += len(loads)
        return self._condensed.readings(loads)

    def answer(self, loads):
        return self._condensed.answer(loads)


@pytest.mark.parametrize(("count", "answers"), [(4, 2 + 2 * 3), (3, 2 + 2 * 3), (1, 2 + 2)])
def test_slopes_are_those_of_each_direction_and_the_known_one_is_not_solved_for(body, columns, condensed, count, answers):
    forces, counting = jnp.asarray(np.random.default_rng(1).normal(size=(2, columns.count))), Counting(condensed)
    directions = ways(count)
    expected = one_by_one(condensed, body, forces, directions)
    np.testing.assert_allclose(slopes(counting, body, forces, directions), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert counting.asked == answers


def test_springs_that_stay_leave_no_direction_known(body, columns):
    sprung = reinforced(body, springs(sp.diags(np.full(3 * len(body.free), 1e-4)).tocoo()))
    forces = jnp.asarray(np.random.default_rng(5).normal(size=(2, columns.count)))
    counting = Counting(solver_for(sprung, "factorised").condense(sprung, LAME, columns))
    expected = one_by_one(counting._condensed, sprung, forces, ways(4))
    np.testing.assert_allclose(slopes(counting, sprung, forces, ways(4)), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert counting.asked == 2 + 2 * 4


def test_springs_that_follow_the_moduli_leave_bodies_in_proportion(body):
    stays = springs(sp.diags(np.full(3 * len(body.free), 1e-4)).tocoo())
    follows = springs(sp.diags(np.full(3 * len(body.free), 1e-2)).tocoo(), layer=1)
    for held, like in [(reinforced(body, stays), (1, 1.0)), (reinforced(body, follows), (0, 3.0))]:
        assert first_like(held, [LAME, 3.0 * LAME], 1) == pytest.approx(like)
    columns = columns_from_matrix(sp.csc_matrix(([1.0], ([1], [0])), shape=(3 * len(body.free), 1)))
    solver = solver_for(reinforced(body, follows), "factorised")
    one, three = (solver.condense(reinforced(body, follows), times * LAME, columns).held.matrix for times in (1, 3))
    np.testing.assert_allclose(three, one / 3, rtol=1e-9)


def test_slopes_agree_with_differences(body, columns, condensed):
    forces, directions, solver = (
        jnp.asarray(np.random.default_rng(2).normal(size=(1, columns.count))),
        ways(4),
        solver_for(body, "factorised"),
    )
    found = slopes(condensed, body, forces, directions)
    for number, way in enumerate(directions):
        there, back = (solver.condense(body, LAME + sign * EPS * way, columns).held.matrix for sign in (1, -1))
        expected = np.asarray(forces @ (there - back)) / (2 * EPS)
        np.testing.assert_allclose(found[:, number], expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_materials_in_proportion_share_what_they_solve(body, columns, condensed):
    forces = jnp.asarray(np.random.default_rng(3).normal(size=(3, columns.count)))
    counting = Counting(condensed)
    bodies = [counting, Stiffer(counting, 2.5), Stiffer(counting, 0.4)]
    directions = jnp.stack([ways(4, seed) for seed in range(3)])
    pushed = [forces, 2.5 * forces[:2], jnp.concatenate([0.4 * forces[1:], forces[:1]])]
    found = slopes_of_all(bodies, body, pushed, directions)
    assert counting.asked == 4 + 4 * 3  # three forces of the first, one more of the last
    for each, own, way, moved in zip(bodies, pushed, directions, found, strict=True):
        expected = one_by_one(each, body, own, way)
        np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_materials_that_move_otherwise_are_solved_by_themselves(body, columns, condensed):
    forces = jnp.asarray(np.random.default_rng(4).normal(size=(2, columns.count)))
    bodies, directions = [condensed, Stiffer(condensed, 3.0)], jnp.stack([ways(4)[:2], ways(4, 9)[:2]])
    found = slopes_of_all(bodies, body, [forces, forces], directions)
    for each, way, moved in zip(bodies, directions, found, strict=True):
        expected = one_by_one(each, body, forces, way)
        np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_no_force_or_no_direction_is_no_slope(body, columns, condensed):
    assert slopes(condensed, body, jnp.zeros((0, columns.count)), ways(4)).shape == (0, 4, columns.count)
    assert slopes(condensed, body, jnp.zeros((2, columns.count)), ways(4)[:0]).shape == (2, 0, columns.count)
