"""The preconditioner: every level is the Galerkin operator of the one above, and one frozen hierarchy serves the whole box of moduli."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from fingerjax.fem.body import Body, assemble_body, body, material
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.multigrid import Hierarchy, hierarchy, preconditioner
from fingerjax.fem.operator import apply
from fingerjax.fem.solver import MultigridCG
from fingerjax.fem.stiffness import Elastic
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import block
from tests.fem_tools import cube, cube_body

SKIN = material(dict(zip(SOFT_LAYERS, (1.0, 0.1, 0.1, 0.1), strict=True)), 0.48)


@pytest.fixture(scope="module")
def patchy() -> tuple[Body, Hierarchy]:
    """A cube held at nodes picked at random, midsides between free corners among them, as at the edge of a nail."""
    nodes, tets = cube(3)
    held = np.random.default_rng(0).random(len(nodes)) < 0.15
    one = assemble_body(nodes, tets, np.arange(len(tets)) % 4, held)
    return one, hierarchy(one, coarsest=40)


def moving(frozen: Hierarchy, one: Body) -> np.ndarray:
    """(count, 1) 1 where a node of the level below the quadratic tetrahedra moves: free corners, and all bundles of midsides."""
    free = np.asarray(one.free)[np.unique(np.asarray(one.tets)[:, :4])]
    bundles = 0 if frozen.midsides is None else frozen.midsides.count - len(free)
    return np.concatenate([free, np.ones(bundles)])[:, None]


def corner_field(frozen: Hierarchy, one: Body, key: int) -> jax.Array:
    free = moving(frozen, one)
    return jax.random.normal(jax.random.key(key), (len(free), 3)) * free


def test_the_corner_level_is_the_stiffness_between_corners(patchy: tuple[Body, Hierarchy]) -> None:
    one, frozen = patchy
    assert frozen.midsides is not None
    v = corner_field(frozen, one, 0)
    seen = frozen.midsides.restrict(apply(one, SKIN.lame(), frozen.midsides.prolong(v)))
    own = frozen.corners.multiply(frozen.corners.rows(SKIN.lame()), v)
    assert jnp.allclose(own, moving(frozen, one) * seen, rtol=0, atol=1e-12 * jnp.abs(own).max())


def test_the_aggregates_are_the_corner_level_between_aggregates(patchy: tuple[Body, Hierarchy]) -> None:
    frozen = patchy[1]
    below = frozen.aggregates
    v = jax.random.normal(jax.random.key(1), below.columns.shape[:1])
    lame = SKIN.lame()[:, :4]
    seen = below.restrict(frozen.corners.multiply(frozen.corners.rows(SKIN.lame()), below.prolong(v)))
    own = jnp.einsum("pl,plij,j->i", lame, below.parts, v)
    assert jnp.allclose(own, seen, rtol=0, atol=1e-12 * jnp.abs(own).max())


def test_restriction_is_the_transpose_of_prolongation(patchy: tuple[Body, Hierarchy]) -> None:
    one, frozen = patchy
    assert frozen.midsides is not None
    v, fine = corner_field(frozen, one, 2), jax.random.normal(jax.random.key(3), (len(one.free), 3))
    assert jnp.allclose(jnp.vdot(frozen.midsides.restrict(fine), v), jnp.vdot(fine, frozen.midsides.prolong(v)), rtol=1e-12)


def test_the_cycle_is_symmetric_and_shrinks_every_error(patchy: tuple[Body, Hierarchy]) -> None:
    """1 - M K contracts in energy: 0 < v'KMKv < 2 v'Kv, which fails where a level is not the Galerkin operator."""
    one, frozen = patchy
    lame, free = SKIN.lame(), one.free[:, None]
    cycle = jax.jit(preconditioner(one, frozen, lame, jnp.float64))
    v, w = (free * jax.random.normal(jax.random.key(key), (len(one.free), 3)) for key in (4, 5))
    assert jnp.allclose(jnp.vdot(w, cycle(v)), jnp.vdot(v, cycle(w)), rtol=1e-8)
    for _ in range(30):
        left = v - cycle(apply(one, lame, v))
        assert jnp.vdot(left, apply(one, lame, left)) < jnp.vdot(v, apply(one, lame, v))
        v = left / jnp.linalg.norm(left)


def test_the_sliced_form_is_the_matrix_free_product() -> None:
    one = cube_body(4, order=1, layers=4)
    frozen, u = hierarchy(one), jax.random.normal(jax.random.key(6), (len(one.free), 3)) * one.free[:, None]
    free, found = apply(one, SKIN.lame(), u), frozen.corners.multiply(frozen.corners.rows(SKIN.lame()), u)
    assert jnp.allclose(found, free, rtol=0, atol=1e-13 * jnp.abs(free).max())
    matrix = frozen.corners.matrix(SKIN.lame())
    assert np.allclose(matrix @ np.asarray(u).ravel(), np.asarray(free).ravel(), rtol=0, atol=1e-13 * np.abs(free).max())


@pytest.mark.parametrize("model", ["m43338", "m25528", "m52258", "m22228"])
def test_one_hierarchy_serves_the_box_of_moduli(thin: tuple[Body, Hierarchy], model: str) -> None:
    one, frozen = thin
    moduli = {name: 10.0 ** (int(exponent) - 4) for name, exponent in zip(SOFT_LAYERS, model[1:5], strict=True)}
    load = jnp.zeros((1, len(one.free), 3)).at[0, np.asarray(one.nodes)[:, 1] < 1e-9, 1].set(1e-3)
    solution = MultigridCG(frozen, tolerance=1e-8).held(Elastic(one, material(moduli, 0.48).lame()), load)
    assert solution.converged.all() and int(solution.iterations[0]) <= 60


def test_midsides_of_needles_move_in_bundles() -> None:
    """On one layer of columns eight times as long as wide; without bundles it takes 74 iterations."""
    assert needles(12) <= 60


def needles(across: int) -> int:
    """Iterations of a push on one layer of columns, `across` each way."""
    one = body(block((4.0, 2.8, 4.0), (across, 1, across)), bone="held")
    load = jnp.zeros((1, len(one.free), 3)).at[0, np.asarray(one.nodes)[:, 1] < 1e-9, 1].set(1e-3)
    solution = MultigridCG(hierarchy(one), tolerance=1e-8).held(Elastic(one, SKIN.lame()), load)
    assert solution.converged.all()
    return int(solution.iterations[0])


def test_columns_begin_where_they_ended_at_the_last_moduli() -> None:
    shape = block((2.0, 1.0, 2.0), (4, 3, 4))
    one = body(dataclasses.replace(shape, nail=shape.nodes[:, 2] < 1e-9), bone="rigid")
    skin = np.flatnonzero(np.asarray(one.nodes)[:, 1] < 1e-9)[:3]
    columns = columns_from_matrix(sp.csc_matrix((np.ones(3), (3 * skin + 1, np.arange(3))), shape=(3 * len(one.free), 3)))
    solver, other = (MultigridCG(hierarchy(one), tolerance=1e-8) for _ in range(2))
    solver.condense(one, SKIN.lame(), columns)
    near = 1.0001 * SKIN.lame()
    again, anew = solver.condense(one, near, columns).held, other.condense(one, near, columns).held
    assert again.converged and again.residual <= 1e-7
    assert int(again.iterations) < 0.7 * int(anew.iterations)
    assert jnp.allclose(again.matrix, anew.matrix, rtol=0, atol=1e-6 * jnp.abs(anew.matrix).max())


@pytest.fixture(scope="module")
def thin() -> tuple[Body, Hierarchy]:
    """A block of flat elements, seven times as wide as thick, as column meshes have them in the skin."""
    one = body(block((4.0, 0.8, 4.0), (6, 8, 6), interfaces=(0.1, 0.3, 0.5)), bone="held")
    return one, hierarchy(one)
