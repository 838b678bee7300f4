"""The operator against ground truth: constant strain, rigid motion, manufactured solutions, balance of forces and energy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.fem import element
from fingerjax.fem.assembly import Assembled
from fingerjax.fem.body import material
from fingerjax.fem.compliance import displacement
from fingerjax.fem.krylov import conjugate_gradients
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.operator import apply, internal_force, strain_energy
from fingerjax.fem.solver import MultigridCG
from fingerjax.layers import SOFT_LAYERS

from .fem_tools import consistent_load, cube_body, integrate

SKIN = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.02, "fibrous": 0.03}, 0.48)


def warp(nodes: np.ndarray) -> np.ndarray:
    x, y, z = nodes.T
    bump = np.sin(np.pi * x) * np.sin(np.pi * y) * np.sin(np.pi * z)
    return nodes + 0.04 * bump[:, None] * np.array([1.0, -0.7, 0.5])


@pytest.mark.parametrize("degree", range(1, 8))
def test_quadrature_integrates_every_monomial_of_its_degree(degree):
    points, weights = element.quadrature(degree)
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            c = degree - a - b
            exact = np.prod([np.prod(np.arange(1.0, k + 1)) for k in (a, b, c)]) / np.prod(np.arange(1.0, a + b + c + 4))
            assert np.sum(weights * points[:, 0] ** a * points[:, 1] ** b * points[:, 2] ** c) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_shape_functions_are_one_at_their_node_and_sum_to_one(order):
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    nodes = corners if order == 1 else np.concatenate([corners, corners[element.EDGES].mean(axis=1)])
    assert np.allclose(element.shape(nodes, order), np.eye(len(nodes)), atol=1e-14)
    points, _ = element.quadrature(4)
    assert np.allclose(element.shape(points, order).sum(axis=1), 1.0)
    assert np.allclose(element.slopes(points, order).sum(axis=1), 0.0, atol=1e-13)


@pytest.mark.parametrize(("order", "degree", "bent"), [(1, 1, False), (2, 2, False), (2, 5, True)])
def test_patch_of_constant_strain_carries_no_interior_force(order, degree, bent):
    body = cube_body(3, order=order, degree=degree, warp=warp if bent else None, held=lambda x: np.zeros(len(x), bool), layers=1)
    strain = np.array([[0.01, 0.004, -0.002], [0.003, -0.02, 0.006], [0.001, 0.005, 0.015]])
    u = jnp.asarray(np.asarray(body.nodes) @ strain.T)
    force = np.asarray(internal_force(body, SKIN.lame(), u))
    inside = np.all((np.asarray(cube_body(3, order=order).nodes) % 1.0 > 1e-9), axis=1)
    assert inside.sum() > 5
    assert np.abs(force[inside]).max() <= 1e-10 * np.abs(force).max()


def test_rigid_motion_gives_no_force():
    body = cube_body(2, warp=warp, layers=4, held=lambda x: np.zeros(len(x), bool))
    turn = np.array([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]])
    u = jnp.asarray(np.asarray(body.nodes) @ turn.T + np.array([1.0, -2.0, 0.5]))
    stiff = internal_force(body, SKIN.lame(), jnp.asarray(np.asarray(body.nodes) * 0.3))
    assert jnp.abs(internal_force(body, SKIN.lame(), u)).max() <= 1e-12 * jnp.abs(stiff).max()


def test_operator_is_the_assembled_matrix_and_the_slope_of_the_energy():
    body = cube_body(2, warp=warp, layers=4)
    lame = SKIN.lame()
    u = jax.random.normal(jax.random.key(1), body.nodes.shape) * body.free[:, None]
    assembled = Assembled(body, upper=False)
    force = np.asarray(apply(body, lame, u)).ravel()[assembled.free]
    matrix = assembled.matrix(np.asarray(lame))
    assert np.allclose(force, matrix @ np.asarray(u).ravel()[assembled.free], rtol=0, atol=1e-13 * np.abs(force).max())
    slope = jax.grad(strain_energy, argnums=2)(body, lame, u)
    assert jnp.allclose(body.free[:, None] * slope, apply(body, lame, u), atol=1e-13)


def manufactured(x):
    bump = jnp.prod(jnp.sin(jnp.pi * x))
    return bump * jnp.array([1.0, -0.5, 0.8]) * jnp.array([1.0 + x[1], 1.0, 1.0 - 0.5 * x[0]])


def body_force(E: float, nu: float):
    lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))

    def sigma(x):
        gradient = jax.jacfwd(manufactured)(x)
        return lam * jnp.trace(gradient) * jnp.eye(3) + mu * (gradient + gradient.T)

    return jax.jit(jax.vmap(lambda x: -jnp.einsum("ijj->i", jax.jacfwd(sigma)(x))))


@pytest.mark.parametrize(("order", "meshes", "rates"), [(1, (6, 12), (2.0, 1.0)), (2, (4, 8), (3.0, 2.0))])
def test_manufactured_solution_converges_at_the_rate_of_the_element(order, meshes, rates):
    E, nu = 1.0, 0.3
    force, errors = body_force(E, nu), []
    for divisions in meshes:
        body = cube_body(divisions, order=order, held=lambda x: np.any((x < 1e-9) | (x > 1 - 1e-9), axis=1))
        tissue = material(dict.fromkeys(SOFT_LAYERS, E), nu)
        solution = displacement(body, MultigridCG(hierarchy(body)), tissue, jnp.asarray(consistent_load(body, force)))
        assert solution.converged
        errors.append(errors_of(body, np.asarray(solution.displacement)))
    observed = np.log2(np.array(errors[0]) / np.array(errors[1])) / np.log2(meshes[1] / meshes[0])
    assert np.all(np.abs(observed - rates) <= 0.15), observed


def errors_of(body, u):
    """L2 errors of the displacement and of its gradient."""
    position, weight, values, gradient = integrate(body)
    flat = position.reshape(-1, 3)
    exact = np.asarray(jax.vmap(manufactured)(flat)).reshape(position.shape)
    slope = np.asarray(jax.vmap(jax.jacfwd(manufactured))(flat)).reshape(*position.shape, 3)
    ue = u[np.asarray(body.tets)]
    difference = np.einsum("qa,eai->eqi", values, ue) - exact
    tilt = np.einsum("eqaj,eai->eqij", gradient, ue) - slope
    return np.sqrt(np.sum(weight * (difference**2).sum(-1))), np.sqrt(np.sum(weight * (tilt**2).sum((-1, -2))))


def test_reactions_balance_the_load_and_work_balances_energy():
    body = cube_body(3, warp=warp, layers=4)
    load = jnp.zeros(body.nodes.shape).at[np.flatnonzero(np.asarray(body.nodes)[:, 1] < 1e-9), 1].set(1e-3)
    solution = displacement(body, MultigridCG(hierarchy(body), tolerance=1e-12), SKIN, load)
    reaction = internal_force(body, SKIN.lame(), solution.displacement) * (1 - body.free[:, None])
    assert jnp.abs(reaction.sum(axis=0) + load.sum(axis=0)).max() <= 1e-8 * load.sum()
    energy = strain_energy(body, SKIN.lame(), solution.displacement)
    assert 2 * energy == pytest.approx(float(jnp.vdot(load, solution.displacement)), rel=1e-9)


def test_a_solve_cut_short_says_so():
    body = cube_body(3, layers=4)
    load = jnp.zeros(body.nodes.shape).at[0, 1].set(1.0)
    short = displacement(body, MultigridCG(hierarchy(body), max_steps=3), SKIN, load)
    assert not short.converged
    assert short.iterations == 3
    assert short.residual > 1e-8


def test_a_load_of_zero_is_answered_at_once_and_a_sparse_load_is_not():
    body = cube_body(2)
    lame = SKIN.lame()
    solve = lambda load: conjugate_gradients(lambda u: apply(body, lame, u), lambda r: r, load, tolerance=1e-6, max_steps=2000)  # noqa: E731
    nothing = solve(jnp.zeros(body.nodes.shape))
    assert nothing.iterations == 0 and nothing.converged and not jnp.any(nothing.displacement)
    sparse = solve(jnp.zeros(body.nodes.shape).at[0, 1].set(1e-9))
    assert sparse.iterations > 5 and sparse.converged
