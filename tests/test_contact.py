"""Contact on an elastic half-space: Hertz, flat punch, exact complementarity, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from halfspace import compliance, lattice

from fingerjax.contact.complementarity import complementary
from fingerjax.contact.footprint import first_contact, interface
from fingerjax.contact.indentation import press, recovered
from fingerjax.contact.indenter import Cylinder, FlatCylinder, FlatPlate, Line, Point, Sphere
from fingerjax.contact.nodal import at_nodes
from fingerjax.contact.pad import node_area, pad
from fingerjax.contact.triangle import HATS
from fingerjax.errors import InputError

MODULUS, EDGE = 1.7, 1.0 / 3.0  # E* in MPa; three facet edges to a millimetre
SKIN = lattice(10, EDGE)
PAD = pad(SKIN)
BODY = jnp.asarray(compliance(SKIN, np.asarray(PAD.nodes), EDGE, MODULUS, periods=24))
OFFSETS = [(0.0, 0.0), (0.043, 0.07), (EDGE / 2, EDGE / 4)]


@jax.jit
def pressed(indenter, origin, travel, scale=1.0):
    return press(scale * BODY, interface(PAD, indenter, origin), travel=travel)


@jax.jit
def loaded(indenter, origin, force, scale=1.0):
    return press(scale * BODY, interface(PAD, indenter, origin), force=force)


def test_the_half_space_knows_a_uniform_disc():
    """Centre of a disc under pressure p: u = 2 p a / E* (Johnson 1985, eq. 3.26)."""
    disc = interface(PAD, FlatCylinder(1.0), (0.0, 0.0))
    u = BODY @ disc.load.sum(axis=1)
    middle = np.argmin(np.linalg.norm(np.asarray(PAD.points)[:, [0, 2]], axis=1))
    assert float(u[middle]) == pytest.approx(2.0 / MODULUS, rel=0.01)


@pytest.mark.parametrize("offset", OFFSETS)
def test_hertz(offset):
    """R = 20 mm, a = 4 edges: F = 4/3 E* a^3 / R, p0 = 2 E* a / (pi R) (Johnson 1985, eqs. 4.22-4.24)."""
    a, skin = 4 * EDGE, lattice(14, EDGE)
    wide = pad(skin)
    half_space = jnp.asarray(compliance(skin, np.asarray(wide.nodes), EDGE, MODULUS, periods=24))
    contact = jax.jit(press)(half_space, interface(wide, Sphere(20.0), offset), travel=a**2 / 20)
    assert float(contact.force) == pytest.approx(4 / 3 * MODULUS * a**3 / 20, rel=0.005)
    assert float(contact.area) == pytest.approx(np.pi * a**2, rel=0.01)
    assert float(contact.peak_pressure) == pytest.approx(2 * MODULUS * a / np.pi / 20, rel=0.015)
    assert bool(contact.settled) and not bool(contact.reached_edge)


@pytest.mark.parametrize("share", [(0.4, 0.3), (0.5, 0.02), (0.3, 0.6)])
def test_a_probe_smaller_than_the_facets_presses_where_it_stands(share):
    """No hat is under it: one pressure acts all over its end, whatever the facets are."""
    probe, at = Point(0.03, 0.003), jnp.asarray(share) * EDGE
    face = interface(PAD, probe, at)
    assert int(jnp.sum(face.area > 0)) == 1
    bore = float(face.area.sum())
    assert bore == pytest.approx(np.pi * 0.03**2, rel=0.02)
    contact = pressed(probe, at, 0.01)
    assert bool(contact.settled) and not bool(contact.reached_edge)
    forces, points = np.asarray(contact.nodal_forces), np.asarray(PAD.points)
    assert float(contact.force) == pytest.approx(forces.sum(), rel=1e-12) and float(contact.force) > 0
    assert forces @ points[:, [0, 2]] / forces.sum() == pytest.approx(np.asarray(at), abs=1e-9)
    assert float(contact.area) == pytest.approx(bore) and float(contact.peak_pressure) == pytest.approx(float(contact.force) / bore)
    along = jnp.array([1.0, 0.7])
    slope = jax.jvp(lambda to: pressed(probe, to, 0.01).force, (at,), (along,))[1]
    step = 1e-5
    ahead, behind = (float(pressed(probe, at + way * step * along, 0.01).force) for way in (1, -1))
    assert float(slope) == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-7)


def test_a_quadratic_pressure_is_recovered_from_the_hats_nearest_to_it():
    face = interface(PAD, FlatPlate(), (0.0, 0.0))
    x, z = np.asarray(PAD.position[..., 0]), np.asarray(PAD.position[..., 2])
    hats, weight, k = np.asarray(PAD.hats), np.asarray(PAD.weight), len(PAD.full)
    mass, right = np.zeros((k, k)), np.zeros(k)
    for i in range(3):
        np.add.at(right, hats[:, i], (weight * (3.0 - x**2 + 0.5 * x * z - 2.0 * z**2)) @ HATS[:, i])
        for j in range(3):
            np.add.at(mass, (hats[:, i], hats[:, j]), weight @ (HATS[:, i] * HATS[:, j]))
    middle = np.argmin(np.linalg.norm(np.asarray(PAD.points)[np.unique(PAD.facets[:, :3])][:, [0, 2]], axis=1))
    nearest = np.linalg.solve(mass, right)
    assert nearest[middle] > 3.05
    assert float(recovered(face, jnp.asarray(nearest))[middle]) == pytest.approx(3.0, abs=1e-4)


@pytest.mark.parametrize("offset", OFFSETS)
def test_hertz_held_at_nodes(offset):
    """The same sphere where no node of the skin may lie inside of it."""
    a, skin = 4 * EDGE, lattice(14, EDGE)
    wide = pad(skin)
    half_space = jnp.asarray(compliance(skin, np.asarray(wide.nodes), EDGE, MODULUS, periods=24))
    contact = jax.jit(press)(half_space, at_nodes(wide, Sphere(20.0), offset), travel=a**2 / 20)
    assert float(contact.force) == pytest.approx(4 / 3 * MODULUS * a**3 / 20, rel=0.005)
    assert float(contact.area) == pytest.approx(np.pi * a**2, rel=0.02)
    assert float(contact.peak_pressure) == pytest.approx(2 * MODULUS * a / np.pi / 20, rel=0.04)
    assert bool(contact.settled) and not bool(contact.reached_edge)
    moved = wide.points + (half_space @ contact.nodal_forces)[:, None] * jnp.array([0.0, 1.0, 0.0])
    x, y, z = (moved - jnp.array([offset[0], 0.0, offset[1]])).T
    sphere = first_contact(wide, Sphere(20.0), offset) + a**2 / 20 + Sphere(20.0).surface(x, z)
    assert float((sphere - y).max()) < 1e-12 and float(contact.nodal_forces.min()) >= 0


def test_a_uniform_pressure_is_gathered_from_the_forces_it_puts_on_nodes():
    plate = at_nodes(PAD, FlatPlate())
    forces = interface(PAD, FlatPlate()).load.sum(axis=1)
    assert float(forces[np.unique(PAD.facets[:, :3])].max()) < 1e-9  # vertices bear nothing
    np.testing.assert_allclose(plate.gathered @ forces, 1.0, rtol=1e-9)
    np.testing.assert_allclose(plate.area, node_area(PAD), rtol=1e-12)
    assert float(node_area(PAD).sum()) == pytest.approx(float(PAD.weight.sum()))


def test_a_line_is_not_held_at_nodes():
    with pytest.raises(InputError, match="hats"):
        at_nodes(PAD, Line())


@pytest.mark.parametrize("offset", OFFSETS)
def test_flat_punch(offset):
    """F = 2 E* a d (Johnson 1985, section 3.5)."""
    contact = pressed(FlatCylinder(1.0), offset, 0.1)
    assert float(contact.force) == pytest.approx(2 * MODULUS * 0.1, rel=0.02)
    assert float(contact.area) == pytest.approx(np.pi, rel=0.01)


@pytest.mark.parametrize(
    ("indenter", "travel"),
    [(Sphere(3.0), 0.2), (FlatCylinder(0.8, 0.1), 0.1), (Cylinder(2.0), 0.05), (Line(), 0.05)],
)
def test_complementarity_is_exact(indenter, travel):
    face = interface(PAD, indenter, (0.02, -0.05))
    contact = press(BODY, face, travel=travel)
    on = np.asarray(face.area) > 0
    mean_gap = (face.load.T @ (BODY @ contact.nodal_forces) - face.overlap - travel * face.area)[
        on
    ] / face.area[on]
    pressure = np.asarray(contact.pressure)[on]
    assert contact.settled and pressure.min() >= 0 and mean_gap.min() > -1e-9 * travel
    assert np.abs(pressure * mean_gap).max() < 1e-9 * pressure.max() * travel
    assert float(contact.force) == pytest.approx(float(face.area @ contact.pressure))
    assert float(contact.force) == pytest.approx(float(contact.nodal_forces.sum()))


@pytest.mark.parametrize("indenter", [Sphere(3.0), FlatCylinder(0.8, 0.1)])
def test_force_control_undoes_displacement_control(indenter):
    for travel in (0.01, 0.1, 0.2):
        forward = pressed(indenter, (0.02, -0.05), travel)
        back = loaded(indenter, (0.02, -0.05), forward.force)
        assert back.settled and float(back.travel) == pytest.approx(travel, rel=1e-9)
        assert np.asarray(back.pressure) == pytest.approx(np.asarray(forward.pressure), abs=1e-9)


def test_glued_skin_is_held_where_it_was_overlapped():
    face = interface(PAD, Line(), (0.0, 0.05))
    contact = press(BODY, face, travel=0.1, glued=True)
    held = (face.load.T @ (BODY @ contact.nodal_forces))[contact.active] / face.area[contact.active]
    assert np.asarray(held) == pytest.approx(0.1)


@pytest.mark.parametrize("seed", range(12))
def test_any_positive_definite_matrix_settles(seed):
    """Also far from anything elastic, where exchanging all violated members can go round in circles."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(40, 40))
    matrix, overlap = jnp.asarray(root @ root.T + 1e-3 * np.eye(40)), jnp.asarray(random.normal(size=40))
    every = jnp.ones(40, bool)
    for asked in ({"travel": jnp.asarray(0.1)}, {"force": jnp.asarray(0.7)}):
        found = complementary(matrix, overlap, every, **asked, max_steps=5000)
        gap = matrix @ found.force - overlap - found.travel
        assert found.settled and found.force.min() >= 0 and gap.min() > -1e-8
        assert np.abs(np.asarray(found.force * gap)).max() < 1e-8
    assert float(found.force.sum()) == pytest.approx(0.7)


def test_a_warm_start_takes_one_step():
    face = interface(PAD, Sphere(3.0), (0.0, 0.0))
    cold = press(BODY, face, travel=0.2)
    warm = press(BODY, face, travel=0.2, start=cold.active)
    assert int(warm.steps) == 1 < int(cold.steps) and float(warm.force) == pytest.approx(
        float(cold.force), rel=1e-12
    )


QUESTIONS = {
    "travel": lambda v: pressed(Sphere(3.0), (0.02, -0.05), v),
    "radius": lambda v: pressed(Sphere(20 * v), (0.02, -0.05), 0.15),
    "pose": lambda v: pressed(Sphere(3.0), (v - 0.1, -0.05), 0.15),
    "softness": lambda v: pressed(Sphere(3.0), (0.02, -0.05), 0.15, 10 * v),
    "force": lambda v: loaded(Sphere(3.0), (0.02, -0.05), v),
    "radius at force": lambda v: loaded(Sphere(20 * v), (0.02, -0.05), 0.3),
    "softness at force": lambda v: loaded(Sphere(3.0), (0.02, -0.05), 0.3, 10 * v),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_derivatives_agree_with_differences_both_ways(name):
    weights = jnp.asarray(np.random.default_rng(0).normal(size=len(PAD.nodes)))

    def read(v):
        contact = QUESTIONS[name](v)
        return jnp.stack(
            [contact.force, contact.travel, weights @ contact.nodal_forces, contact.peak_pressure]
        )

    v, step = 0.153, 1e-5
    difference = (read(v + step) - read(v - step)) / (2 * step)
    assert np.array_equal(QUESTIONS[name](v - step).active, QUESTIONS[name](v + step).active)
    scale = np.abs(np.asarray(difference)).max()
    for slope in (jax.jacfwd(read)(v), jax.jacrev(read)(v)):
        assert np.asarray(slope) == pytest.approx(np.asarray(difference), rel=1e-5, abs=1e-5 * scale)


def test_positions_go_together():
    places = jnp.array([[0.0, 0.0], [0.1, 0.05], [-0.2, 0.1]])
    together = jax.vmap(lambda at: pressed(Sphere(3.0), at, 0.2))(places)
    alone = [float(pressed(Sphere(3.0), tuple(at), 0.2).force) for at in np.asarray(places)]
    assert np.asarray(together.force) == pytest.approx(alone, rel=1e-10)


def test_a_pad_chosen_too_small_is_noticed():
    assert pressed(Sphere(20.0), (1.2, 0.0), 0.1).reached_edge


def test_press_asks_for_one_of_travel_and_force():
    with pytest.raises(ValueError, match="either travel= or force="):
        press(BODY, interface(PAD, Sphere(3.0)), travel=0.1, force=0.1)
