"""Equilibrium of nonlinear tissue under nodal forces: closed forms, the linear engine at null, Newton's rate, cuts, failures, slopes."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from fingerjax._results import RESULTS
from fingerjax.fem.body import material, reinforced
from fingerjax.fem.cholesky import Indefinite
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.energy import energy_and_force, internal_force, total_energy
from fingerjax.fem.equilibrium import Newton, NodalForces, Tissue, find, slopes
from fingerjax.fem.operator import nodal_forces
from fingerjax.fem.solver import solver_for
from fingerjax.fem.springs import bed, faces_on, facets, film, springs
from fingerjax.fem.stiffness import Elastic, Tangent, tangent
from fingerjax.fem.tissue import Exponential, FiniteStrain, Linear

from .fem_tools import converged_quadratically, cube_body
from .helpers import DIFFERENCED, SOLVED

SKIN = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}, 0.48)
EVEN = jnp.broadcast_to(jnp.array([[0.4], [0.1]]), (2, 5))
B = jnp.full(5, 2.0)


def law(homotopy=1.0, stiffening=1.0):
    """Of one structure for all tests: compiled once."""
    return Exponential(FiniteStrain(homotopy), stiffening * B)


SOLVERS = ["multigrid", "factorised"]


@pytest.fixture(scope="module")
def body():
    """A cube that hangs on its upper face y = 1."""
    return cube_body(2, layers=4)


@pytest.fixture(scope="module")
def solvers(body):
    return {kind: solver_for(body, kind) for kind in ("multigrid", "factorised")}


def exact_stress(tissue, slope):
    """First Piola-Kirchhoff stress of F = I + slope (x) e_y, by hand."""
    lam, mu = EVEN[:, 0]
    F = jnp.eye(3).at[:, 1].add(slope)
    J, cofactor = 1 + slope[1], jnp.eye(3).at[1].add(-slope / (1 + slope[1]))
    neo = mu * (F - cofactor) + lam / 2 * (J**2 - 1) * cofactor
    energy = mu / 2 * (jnp.sum(F * F) - 3 - 2 * jnp.log(J)) + lam / 4 * (J**2 - 1 - 2 * jnp.log(J))
    return neo * jnp.exp(tissue.stiffening[0] * energy / mu)


@pytest.mark.parametrize("stiffening", [0.0, 1.0], ids=["neo-Hookean", "stiffening"])
@pytest.mark.parametrize("slope", [(0.0, 0.4, 0.0), (0.0, -0.03, 0.0), (0.4, 0.1, 0.0)], ids=["pulled", "squeezed", "sheared"])
def test_homogeneous_deformations_have_their_closed_form(body, solvers, stiffening, slope):
    """All faces but the upper one are loaded with the stress; squeezed twice as much, the cube would turn out from under its load."""
    slope = jnp.array(slope)
    stress = jnp.broadcast_to(exact_stress(law(1.0, stiffening), slope), (*body.weight.shape, 3, 3))
    tissue = Tissue(body, law(1.0, stiffening), EVEN, solvers.get("factorised", solvers["multigrid"]))
    found = find(tissue, NodalForces(nodal_forces(body, stress)), Newton(tolerance=1e-11))
    assert found.result.ok and found.residual < 1e-11 and found.reached == 1.0
    np.testing.assert_allclose(found.state.displacement, (body.nodes[:, 1:2] - 1) * slope, atol=1e-9)
    assert found.smallest_volume == pytest.approx(1 + float(slope[1]), rel=1e-8)


def pull(body, size=1e-4):
    return jnp.asarray(np.random.default_rng(0).normal(size=body.nodes.shape)) * jnp.where(body.nodes[:, 1:2] < 1e-9, size, 0.0)


@pytest.mark.parametrize("kind", SOLVERS)
def test_null_tissue_answers_as_the_linear_engine_in_one_iteration(body, solvers, kind):
    load = pull(body)
    exact = solvers[kind].solve(body, SKIN.lame(), load[None]).displacement[0]
    for tissue in (Linear(), law(0.0, 0.0)):
        found = find(Tissue(body, tissue, SKIN.lame(), solvers[kind]), NodalForces(load), Newton(tolerance=1e-8))
        assert found.result.ok and found.iterations == found.steps == 1
        SOLVED.check(found.state.displacement, exact)


def test_both_solvers_find_the_same_and_newton_is_quadratic(body, solvers):
    load = pull(body)
    found = [find(Tissue(body, law(), SKIN.lame(), solver), NodalForces(load)) for solver in solvers.values()]
    for each in found:
        assert each.result.ok and each.cuts == 0 and converged_quadratically(each.history)
        force = eqx.filter_jit(internal_force)(body, law(), SKIN.lame(), each.state.displacement)
        assert jnp.linalg.norm(body.free[:, None] * (force - load)) <= 1e-9 * jnp.linalg.norm(load)
    linear = solvers["multigrid"].solve(body, SKIN.lame(), load[None]).displacement[0]
    assert jnp.abs(found[0].state.displacement - linear).max() > 0.02 * jnp.abs(linear).max()
    SOLVED.check(found[-1].state.displacement, found[0].state.displacement)


def test_both_solvers_reduce_strained_tissue_to_the_same_columns(body, solvers):
    face = np.flatnonzero(np.asarray(body.nodes)[:, 1] < 1e-9)[::4]
    shape = (3 * len(body.nodes), len(face))
    columns = columns_from_matrix(sp.csc_matrix((np.ones(len(face)), (3 * face + 1, np.arange(len(face)))), shape=shape))
    strained = find(Tissue(body, law(), SKIN.lame(), solvers["factorised"]), NodalForces(pull(body))).state
    stiffness = tangent(body, law(), SKIN.lame(), strained.displacement)
    one, other = (solver.reduce(stiffness, columns).held for solver in solvers.values())
    assert one.converged and other.converged
    SOLVED.check(other.matrix, one.matrix)
    linear = solvers["factorised"].condense(body, SKIN.lame(), columns).held.matrix
    assert jnp.abs(one.matrix - linear).max() > 0.05 * jnp.abs(linear).max()


def test_the_end_does_not_depend_on_the_steps(body, solvers):
    slope = jnp.array([0.4, 0.1, 0.0])
    load = NodalForces(nodal_forces(body, jnp.broadcast_to(exact_stress(law(), slope), (*body.weight.shape, 3, 3))))
    tissue = Tissue(body, law(), EVEN, solvers["factorised"])
    whole, eight = find(tissue, load), find(tissue, load, Newton(steps=8))
    assert whole.result.ok and eight.result.ok and whole.steps == 1 and eight.steps == 8
    SOLVED.check(whole.state.displacement, eight.state.displacement)
    half = find(tissue, NodalForces(0.5 * load.force))
    SOLVED.check(find(tissue, load, start=half.state).state.displacement, eight.state.displacement)


def test_a_search_without_an_end_says_where_it_stopped(body, solvers):
    tissue, load = Tissue(body, law(1.0, 0.0), EVEN, solvers["factorised"]), pull(body, 0.05)
    few = Newton(iterations=2, smallest=0.3)
    found = find(tissue, NodalForces(load), few)
    assert found.result is RESULTS.no_equilibrium and not found.result.ok
    assert found.reached < 1.0 and found.cuts == 2 and found.history[-1] > few.tolerance
    assert found.residual <= few.tolerance or found.reached == 0.0
    assert jnp.all(jnp.isfinite(found.state.displacement))


def test_a_tangent_that_is_not_positive_definite_is_refused(body, solvers):
    stiffness = tangent(body, Linear(), EVEN, jnp.zeros(body.nodes.shape))
    wrong = Tangent(body, EVEN, -stiffness.moduli)
    with pytest.raises(Indefinite, match="not positive definite"):
        solvers["factorised"].undo(wrong, pull(body)[None])
    assert solvers["factorised"].undo(stiffness, pull(body)[None]).converged.all()


@pytest.fixture(scope="module")
def sprung(body):
    """The cube with a bed under its lower face that does not follow the moduli, and a film on it that does."""
    nodes = np.asarray(body.nodes)
    low = facets(nodes, faces_on(np.asarray(body.tets), nodes[:, 1] < 1e-9))
    bedded = reinforced(body, springs(0.3 * bed(low, len(nodes))))
    return reinforced(bedded, springs(0.5 * film(low, len(nodes), 0.3), layer=1))


def test_springs_hold_strained_tissue_as_they_hold_linear_tissue(sprung):
    """Energy, force, tangent, and the whole equilibrium at the null of the law."""
    lame, h, solver = SKIN.lame(), 1e-5, solver_for(sprung, "factorised")
    load = sprung.moves * pull(sprung)
    linear = solver.undo(Elastic(sprung, lame), load[None]).displacement[0]
    without = solver.undo(Elastic(body_without(sprung), lame), load[None]).displacement[0]
    assert jnp.linalg.norm(without - linear) > 0.1 * jnp.linalg.norm(linear)
    found = find(Tissue(sprung, law(0.0, 0.0), lame, solver), NodalForces(load))
    assert found.result.ok
    SOLVED.check(found.state.displacement, linear)

    way = jnp.asarray(np.random.default_rng(3).standard_normal(sprung.nodes.shape))
    energy, force = energy_and_force(sprung, law(), lame, linear)
    ends = [energy_and_force(sprung, law(), lame, linear + sign * h * way) for sign in (1, -1)]
    DIFFERENCED.check((ends[0][0] - ends[1][0]) / (2 * h), jnp.sum(force * way))
    np.testing.assert_allclose(total_energy(sprung, law(), lame, linear), energy, rtol=1e-12)
    stiffness = tangent(sprung, law(), lame, linear)
    DIFFERENCED.check((ends[0][1] - ends[1][1]) / (2 * h), stiffness(way))
    moved = solver.undo(stiffness, load[None]).displacement[0]
    SOLVED.check(sprung.moves * stiffness(moved), load)


def body_without(sprung):
    return eqx.tree_at(lambda one: one.springs, sprung, None)


def test_slopes_in_moduli_and_nonlinear_parameters_match_differences(body, solvers):
    load, newton = NodalForces(pull(body)), Newton(tolerance=1e-12)
    values = jnp.array([0.1, -0.2, 1.5, 0.6])

    def of(v):
        return law(v[3], jnp.zeros(5).at[1].set(v[2])), SKIN.lame() * jnp.exp(jnp.zeros((2, 5)).at[:, :2].add(v[:2]))

    def at(v):
        return find(Tissue(body, *of(v), solvers["factorised"]), load, newton)

    found, h = at(values), 1e-4
    exact = slopes(Tissue(body, *of(values), solvers["factorised"]), load, found.state, of, values).displacement
    for parameter in range(len(values)):
        there, back = (at(values.at[parameter].add(step)).state.displacement for step in (h, -h))
        DIFFERENCED.check((there - back) / (2 * h), exact[parameter])
