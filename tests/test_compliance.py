"""The condensed body: both solvers, and derivatives forward and reverse against differences."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from fingerjax.fem.body import Material, material
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.compliance import compliance, displacement
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.operator import internal_force
from fingerjax.fem.recovery import strain_columns
from fingerjax.fem.solver import MultigridCG, solver_for

from .fem_tools import cube_body

SKIN = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}, 0.48)
SOLVERS = ["multigrid", "factorised"]


@pytest.fixture(scope="module")
def body():
    return cube_body(3, layers=4)


@pytest.fixture(scope="module")
def columns(body):
    face = np.flatnonzero(np.asarray(body.nodes)[:, 1] < 1e-9)[::9]
    heights = sp.csc_matrix((np.ones(len(face)), (3 * face + 1, np.arange(len(face)))), shape=(3 * len(body.free), len(face)))
    strains, layer = strain_columns(body, np.array([0.52, 0.3, 0.47]))
    assert layer == 1
    return columns_from_matrix(sp.hstack([heights, strains]).tocsc())


def test_columns_survive_the_round_trip(body, columns):
    again = columns_from_matrix(columns.matrix())
    assert abs(again.matrix() - columns.matrix()).max() == 0
    u = jax.random.normal(jax.random.key(0), body.nodes.shape)
    assert jnp.allclose(columns.read(u), columns.matrix().T @ np.asarray(u).ravel())
    assert jnp.allclose(jnp.einsum("mni,ni->m", columns.loads(), u), columns.read(u))


def test_strain_columns_read_a_constant_strain_exactly(body):
    strain = np.array([[0.01, 0.002, 0.003], [0.004, -0.02, 0.005], [0.0, 0.006, 0.03]])
    u = np.asarray(body.nodes) @ strain.T
    columns, _ = strain_columns(body, np.array([0.21, 0.63, 0.77]))
    symmetric = strain + strain.T
    expected = [0.01, -0.02, 0.03, symmetric[1, 2], symmetric[0, 2], symmetric[0, 1]]
    assert np.allclose(columns.T @ u.ravel(), expected, atol=1e-13)


def test_a_point_outside_the_tissue_is_refused(body):
    with pytest.raises(ValueError, match="outside the meshed tissue"):
        strain_columns(body, np.array([0.5, -0.2, 0.5]))


@pytest.fixture(scope="module")
def single(body, columns):
    """The displacement under the third column's load, solved for alone."""
    solver = MultigridCG(hierarchy(body), tolerance=1e-11)
    return eqx.filter_jit(displacement)(body, solver, SKIN, columns.loads()[2]).displacement


def test_a_single_solve_balances_its_load(body, columns, single):
    held = internal_force(body, SKIN.lame(), single) - columns.loads()[2]
    assert jnp.abs(held * body.free[:, None]).max() < 1e-9


@pytest.mark.parametrize("kind", SOLVERS)
def test_compliance_is_what_single_solves_give(body, columns, single, kind):
    condensed = eqx.filter_jit(compliance)(body, solver_for(body, kind), SKIN, columns)
    assert condensed.converged and condensed.residual < 1e-8
    assert jnp.allclose(condensed.matrix[:, 2], columns.read(single), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("kind", ["factorised", pytest.param("multigrid", marks=pytest.mark.slow)])
def test_derivatives_in_moduli_and_poisson_ratios_match_differences(body, columns, kind):
    solver = solver_for(body, kind)
    weights = jax.random.normal(jax.random.key(3), (columns.count,) * 2)

    @eqx.filter_jit
    def reading(x, solver, body, columns):
        tissue = Material(jnp.exp(x[0]), x[1])
        return jnp.sum(weights * compliance(body, solver, tissue, columns).matrix)

    x = jnp.stack([jnp.log(SKIN.youngs_modulus), SKIN.poisson_ratio])
    forward = jax.jacfwd(reading)(x, solver, body, columns)
    reverse = jax.jacrev(reading)(x, solver, body, columns)
    assert jnp.allclose(forward, reverse, rtol=1e-10, atol=1e-10 * jnp.abs(forward).max())
    for index in [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 3)]:
        h = 3e-4 if index[0] == 0 else 1e-4
        difference = (reading(x.at[index].add(h), solver, body, columns) - reading(x.at[index].add(-h), solver, body, columns)) / (2 * h)
        assert difference == pytest.approx(float(forward[index]), rel=1e-5, abs=1e-6 * float(jnp.abs(forward).max()))


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_a_displacement_is_differentiable_in_material_and_load(body, mode):
    solver = MultigridCG(hierarchy(body), tolerance=1e-11)
    load = jnp.zeros(body.nodes.shape).at[40:60, 1].set(1e-3)

    @eqx.filter_jit
    def height(x, solver, body):
        tissue = Material(SKIN.youngs_modulus.at[1].multiply(jnp.exp(x[0])), SKIN.poisson_ratio)
        return displacement(body, solver, tissue, load * (1 + x[1])).displacement[50, 1]

    x, h = jnp.zeros(2), 1e-4
    exact = mode(height)(x, solver, body)
    for i in range(2):
        difference = (height(x.at[i].add(h), solver, body) - height(x.at[i].add(-h), solver, body)) / (2 * h)
        assert difference == pytest.approx(float(exact[i]), rel=1e-5)
