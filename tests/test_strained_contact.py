"""A sphere on a block of nonlinear tissue: the linear engine at null, work against energy, stiffening, Newton's rate, cuts, slopes."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax._results import RESULTS
from fingerjax.contact.footprint import interface
from fingerjax.contact.indentation import press
from fingerjax.contact.indenter import Sphere
from fingerjax.contact.pad import functionals
from fingerjax.contact.reach import Indentation, pad_for
from fingerjax.contact.strained import Indenting, on_hats
from fingerjax.fem.body import assemble_body, material
from fingerjax.fem.carried import admissible
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.energy import internal_force
from fingerjax.fem.equilibrium import Newton, NodalForces, Tissue, find, slopes
from fingerjax.fem.solver import solver_for
from fingerjax.fem.tissue import Exponential, FiniteStrain
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import block

from .fem_tools import converged_quadratically
from .helpers import DIFFERENCED, SOLVED

LAME = material(dict.fromkeys(SOFT_LAYERS, 0.1), 0.45).lame()
B = jnp.full(5, 4.0)
BOTH, NULL = Exponential(FiniteStrain(), B), Exponential(FiniteStrain(0.0), 0.0 * B)  # of one structure: compiled once
DEPTH = 0.2  # mm; the contact radius is about 0.8
TIGHT = Newton(tolerance=1e-11)


class Rig:
    """A block of 4 x 2 x 4 mm, its bottom held on one side and riding along as a rigid bone on the other, and a sphere of 2 mm on it."""

    def __init__(self):
        finger = block((4.0, 2.0, 4.0), (6, 3, 6), grading=1.5)
        held = finger.bone & (finger.nodes[:, 0] < -0.1)
        self.body = assemble_body(finger.nodes, finger.tets, finger.layer, held, carried=finger.bone & ~held)
        sphere, origin = Sphere(2.0), (0.1, 1.9)
        pad = pad_for(finger, [Indentation(sphere, origin, 2 * DEPTH)])
        nodal = columns_from_matrix(functionals(pad, len(finger.nodes)))
        self.columns, self.interface = on_hats(nodal, interface(pad, sphere, origin))
        self.nodal = nodal, interface(pad, sphere, origin)
        self.solver = solver_for(self.body)

    def linear(self, **imposed):
        return eqx.filter_jit(press)(self.solver.condense(self.body, LAME, self.columns).held.matrix, self.interface, **imposed)

    def tissue(self, law, lame=LAME, solver=None):
        return Tissue(self.body, law, lame, self.solver if solver is None else solver)

    def find(self, law, newton=None, lame=LAME, start=None, solver=None, **imposed):
        return find(self.tissue(law, lame, solver), Indenting(self.columns, self.interface, **imposed), newton, start)


@pytest.fixture(scope="module")
def rig():
    return Rig()


@pytest.fixture(scope="module")
def pressed(rig):
    return rig.find(BOTH, TIGHT, travel=DEPTH)


@pytest.mark.parametrize("imposed", [{"travel": DEPTH}, {"force": 0.02}])
def test_null_tissue_is_pressed_as_by_the_linear_engine(rig, imposed):
    exact = rig.linear(**imposed)
    found = rig.find(NULL, Newton(tolerance=1e-8), **imposed)
    contact = found.state.detail
    assert found.result.ok and found.iterations == 1 and contact.settled
    np.testing.assert_array_equal(contact.active, exact.active)
    for name in ("force", "travel", "area", "pressure", "nodal_forces", "gap"):
        SOLVED.check(getattr(contact, name), getattr(exact, name))


def test_the_contact_is_complementary_where_the_skin_went(rig, pressed):
    contact, geometry = pressed.state.detail, rig.interface
    present = np.asarray(geometry.area) > 0
    gap = geometry.load.T @ rig.columns.read(pressed.state.displacement) - geometry.overlap - DEPTH * geometry.area
    gap = np.asarray(gap)[present] / np.asarray(geometry.area)[present]
    pressure = np.asarray(contact.pressure)[present]
    assert pressed.result.ok and gap.min() > -1e-9 * DEPTH and pressure.min() >= 0.0
    assert np.abs(gap[pressure > 0]).max() < 1e-9 * DEPTH and (pressure > 0).sum() > 3 and (gap > 1e-3 * DEPTH).sum() > 5
    assert contact.force == pytest.approx(float(pressed.state.force[:, 1].sum()), rel=1e-12) and not contact.reached_edge


def test_newton_is_quadratic_and_more_steps_end_at_the_same(rig, pressed):
    assert pressed.steps == 1 and converged_quadratically(pressed.history)
    steps = rig.find(BOTH, Newton(tolerance=1e-11, steps=4), travel=DEPTH)
    assert steps.steps == 4 and steps.iterations > pressed.iterations
    SOLVED.check(steps.state.detail.force, pressed.state.detail.force)
    shallow = rig.find(BOTH, TIGHT, travel=0.5 * DEPTH)
    SOLVED.check(rig.find(BOTH, TIGHT, start=shallow.state, travel=DEPTH).state.displacement, pressed.state.displacement)


def test_the_force_is_the_slope_of_the_energy_in_the_travel(rig, pressed):
    """Nothing is lost and nothing is won: the indenter's work is the energy of the tissue."""
    h = 1e-4
    more, less = (rig.find(BOTH, TIGHT, start=pressed.state, travel=DEPTH + step).energy for step in (h, -h))
    assert (more - less) / (2 * h) == pytest.approx(float(pressed.state.detail.force), rel=1e-5)


def test_a_force_leads_back_to_its_travel(rig, pressed):
    found = rig.find(BOTH, TIGHT, force=pressed.state.detail.force)
    assert found.result.ok and found.state.travel == pytest.approx(DEPTH, rel=1e-8)
    SOLVED.check(found.state.displacement, pressed.state.displacement)


def test_stiffening_tissue_pushes_back_harder_the_more_the_deeper(rig):
    ratio = []
    for depth in (0.5 * DEPTH, DEPTH):
        forces = [float(rig.find(Exponential(FiniteStrain(0.0), b * B), travel=depth).state.detail.force) for b in (0.5, 1.0)]
        plain = float(rig.linear(travel=depth).force)
        assert plain < forces[0] < forces[1]
        ratio.append(forces[1] / plain)
    assert 1.005 < ratio[0] < ratio[1]


def test_columns_of_pressures_are_as_good_as_columns_of_nodes(rig, pressed):
    by_node = find(rig.tissue(BOTH), Indenting(*rig.nodal, travel=DEPTH), TIGHT)
    assert rig.columns.count < 0.4 * rig.nodal[0].count
    for name in ("force", "area", "peak_pressure"):
        SOLVED.check(getattr(by_node.state.detail, name), getattr(pressed.state.detail, name))
    SOLVED.check(by_node.state.displacement, pressed.state.displacement)


@pytest.mark.slow
def test_iterations_find_what_the_factorisation_finds(rig, pressed):
    """Without the extra, the linear body's hierarchy leads the way through the strained one's stiffness."""
    found = rig.find(BOTH, solver=solver_for(rig.body, "multigrid"), travel=DEPTH)
    assert found.result.ok and converged_quadratically(found.history)
    SOLVED.check(found.state.displacement, pressed.state.displacement)


def test_the_bone_gives_way_and_nothing_pushes_it_but_the_tissue(rig, pressed):
    u, modes = pressed.state.displacement, rig.body.modes
    assert jnp.abs(jnp.einsum("mni,ni->m", modes, u)).max() > 0.01 * DEPTH
    SOLVED.check(admissible(rig.body, u), u)
    force = eqx.filter_jit(internal_force)(rig.body, BOTH, LAME, u)
    np.testing.assert_allclose(jnp.einsum("mni,ni->m", modes, force), 0.0, atol=1e-9 * float(pressed.state.detail.force))


def test_forces_on_the_bone_are_balanced_by_the_tissue_around_it(rig):
    node = np.flatnonzero(np.abs(np.asarray(rig.body.modes)).max(axis=(0, 2)))[0]
    load = jnp.zeros(rig.body.nodes.shape).at[node].set(jnp.array([0.01, 0.02, -0.02]))
    found = find(rig.tissue(BOTH), NodalForces(load), TIGHT)
    assert found.result.ok and converged_quadratically(found.history)
    force = eqx.filter_jit(internal_force)(rig.body, BOTH, LAME, found.state.displacement)
    np.testing.assert_allclose(jnp.einsum("mni,ni->m", rig.body.modes, force - load), 0.0, atol=1e-11)


def test_too_deep_a_travel_is_cut_and_an_impossible_one_is_said_to_be(rig):
    deep = rig.find(BOTH, travel=0.9)
    assert deep.result.ok and deep.cuts > 0 and deep.smallest_volume > 0
    through = rig.find(BOTH, Newton(smallest=0.25), travel=2.5)  # the block is 2 mm thick
    assert through.result is RESULTS.no_equilibrium and through.reached < 1.0 and through.cuts > 0
    assert through.state.travel == pytest.approx(2.5 * through.reached) and through.residual < 1e-9


def law(values):
    """Modulus, stiffening and homotopy."""
    return Exponential(FiniteStrain(values[2]), jnp.full(5, values[1])), LAME * jnp.exp(values[0])


@pytest.mark.parametrize("control", ["travel", "force"])
def test_slopes_in_moduli_and_stiffening_match_differences(rig, pressed, control):
    values, h = jnp.array([0.1, 3.0, 0.7]), 1e-4
    imposed = {control: DEPTH if control == "travel" else 0.02}

    def at(v, start=None):
        tissue, lame = law(v)
        return rig.find(tissue, TIGHT, lame, start, **imposed).state

    state = at(values)
    exact = slopes(rig.tissue(*law(values)), Indenting(rig.columns, rig.interface, **imposed), state, law, values)
    for parameter in range(len(values)):
        there, back = (at(values.at[parameter].add(step), state) for step in (h, -h))
        DIFFERENCED.check((there.displacement - back.displacement) / (2 * h), exact.displacement[parameter])
        DIFFERENCED.check((there.force[:, 1].sum() - back.force[:, 1].sum()) / (2 * h), exact.force[parameter, :, 1].sum())
        DIFFERENCED.check((there.travel - back.travel) / (2 * h), exact.travel[parameter])


def test_one_of_travel_and_force_is_given(rig):
    with pytest.raises(ValueError, match="either travel= or force="):
        Indenting(rig.columns, rig.interface)
