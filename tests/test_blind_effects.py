"""The blind laboratory's effects do what their names say, and vanish where they should: each against theory or a known limit."""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.blind import bricks, flesh, friction, instruments, pressing, protocol, shapes, stiffening, touch
from tests.blind.flesh import Flesh
from tests.blind.protocol import Rig, felt
from tests.blind.shapes import HUMAN, Divisions

COARSE = Divisions(pad=1.0, flank=2.0, palmar=15.0, dorsal=30.0, cap=15.0, layers=(1, 1, 1, 1))
FLESH = Flesh(HUMAN, (0.16, 0.022, 0.013, 0.019), COARSE, 11.5)
SITE, PLATE, LINE, BALL = HUMAN.site, touch.flat_plate(), touch.line(), touch.sphere(3.0)
SETTLED = 1e-3
"""Contact and another law found in turn, each to a few parts in ten thousand."""


def finger(**changes) -> pressing.Plain:
    return pressing.Plain(flesh.body_of(replace(FLESH, **changes)))


def force(one: pressing.Pressing, travel: float = 1.0, indenter: touch.Indenter = PLATE) -> float:
    return one.press(indenter, SITE, travel).force


@pytest.fixture(scope="module")
def plain() -> pressing.Plain:
    return finger()


def test_plain_pressing_is_that_of_the_shipped_laboratories(plain):
    contact = touch.press(plain.body, PLATE, at=SITE, travel=1.0)
    seen = plain.press(PLATE, SITE, 1.0)
    assert seen.force == pytest.approx(contact.force, rel=1e-9)
    assert np.allclose(seen.deflection, touch.deflection(plain.body, contact), atol=1e-9)


def test_a_nail_on_springs_gives_way_and_a_stiff_bed_holds_it(plain):
    soft, softer, stiff = (force(finger(bed=bed)) for bed in (0.05, 0.02, 1e3))
    assert softer < soft < force(plain)
    assert stiff == pytest.approx(force(plain), rel=2e-3)


@pytest.fixture(scope="module")
def block() -> bricks.Bricks:
    return shapes.block_bricks(np.array([0, 1, 2.0]), np.array([0, 1, 2.0]), np.array([0, 1.5, 3.0]), held="none")


def test_springs_under_a_level_face_have_their_energy(block):
    faces = touch.outer_faces(block)
    springs = flesh.bedding(block, faces, 0.3)
    across, along = (np.tile(axis, len(block.nodes)) for axis in ((0.0, 0.1, 0.0), (0.1, 0.0, 0.0)))
    assert across @ springs @ across == pytest.approx(0.3 * 6.0 * 0.01, rel=1e-10)
    assert along @ springs @ along == pytest.approx(0.1 * 6.0 * 0.01, rel=1e-10)


def test_a_stretched_film_has_the_energy_of_plane_stress(block):
    film = flesh.membrane(block, touch.outer_faces(block), 0.7)
    a, b, c = 0.01, -0.004, 0.006  # strains along x and z, and the shear angle between
    x, _, z = block.nodes.T
    move = np.stack([a * x + 0.5 * c * z, 0.3 * x, b * z + 0.5 * c * x], 1).ravel()
    energy = 0.7 / (1 - 0.09) * (a**2 + b**2 + 0.6 * a * b + 0.35 * c**2) * 6.0
    assert move @ film @ move == pytest.approx(energy, rel=1e-10)


@pytest.mark.parametrize(
    ("changes", "sign"),
    [
        ({"film": 0.06}, 1),
        ({"poisson": (0.43, 0.43, 0.48, 0.48)}, -1),
        ({"poisson": (0.48, 0.48, 0.43, 0.43)}, -1),
        ({"callus": 5.0, "callus_at": 0.0}, 1),
        ({"finger": replace(HUMAN, epidermis=0.65)}, 1),
        ({"finger": flesh.OffsetBone(**vars(HUMAN), bone_rise=0.4)}, -1),
    ],
    ids=["film", "skin softer in bulk", "flesh softer in bulk", "callus", "thick epidermis", "bone away from the pad"],
)
def test_the_plate_feels_what_is_below_it(plain, changes, sign):
    assert sign * (force(finger(**changes)) / force(plain) - 1.0) > 3e-3


def test_a_bone_without_rise_is_the_plain_bone_and_rises_towards_the_nail():
    z, theta = np.array([3.0, 9.0]), np.array([-90.0])
    same, higher = (flesh.OffsetBone(**vars(HUMAN), bone_rise=rise) for rise in (0.0, 0.4))
    assert np.allclose(same.radius(4, z, theta), HUMAN.radius(4, z, theta))
    assert np.all(higher.radius(4, z, theta) < HUMAN.radius(4, z, theta))
    assert np.all(higher.radius(4, z, -theta) > HUMAN.radius(4, z, -theta))


def test_a_gradient_leaves_the_mean_of_the_layer():
    graded = replace(FLESH, divisions=COARSE.scaled(1.0, (1, 2, 1, 1)), graded=0.4)
    mesh = graded.mesh()
    factor = flesh._local(graded, mesh)[mesh.layer == 2]
    assert factor.mean() == pytest.approx(1.0)
    assert set(factor.round(12)) == {0.6, 1.4}


@pytest.fixture(scope="module")
def stiff() -> stiffening.Stiffening:
    return stiffening.Stiffening(replace(FLESH, stiffening=12.0))


def anew(one: pressing.Plain, **changes) -> pressing.Plain:
    """The same body, with another law and no memory."""
    other = copy.copy(one)
    vars(other).update(changes, _last={})
    return other


def test_skin_that_does_not_stiffen_is_linear(plain, stiff):
    still = anew(stiff, flesh=FLESH)
    for travel in (0.5, 1.0):
        seen, linear = still.press(PLATE, SITE, travel), plain.press(PLATE, SITE, travel)
        assert seen.force == pytest.approx(linear.force, rel=SETTLED)
        assert np.allclose(seen.deflection, linear.deflection, atol=SETTLED * travel)


def test_stiffening_skin_answers_more_the_deeper(plain, stiff):
    growth = [force(stiff, travel) / force(plain, travel) for travel in (0.3, 0.8, 1.3)]
    assert 1.0 < growth[0] < growth[1] < growth[2]


def test_the_force_of_stiffening_is_the_slope_of_its_energy(stiff):
    one, random = stiff, np.random.default_rng(1)
    at, step = 0.05 * random.normal(size=(2, 3 * len(one.mesh.nodes)))

    def energy(u: np.ndarray) -> float:
        slope = np.einsum("eqaj,eai->eqij", one.gradient, u.reshape(-1, 3)[one.mesh.bricks[one.skin]])
        strain = 0.5 * (slope + slope.swapaxes(-1, -2))
        deviator = strain - np.trace(strain, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3.0
        return float((one.weight * one.shear[:, None] * 6.0 * (deviator**2).sum((-1, -2)) ** 2).sum())

    quotient = (energy(at + 1e-5 * step) - energy(at - 1e-5 * step)) / 2e-5
    assert one.extra_force(at) @ step == pytest.approx(quotient, rel=1e-6)


@pytest.fixture(scope="module")
def rough() -> friction.Rubbing:
    return friction.Rubbing(FLESH, 0.5)


def test_rough_contact_is_stiffer_and_obeys_coulomb(plain, rough):
    smooth = anew(rough, friction=0.0)
    assert force(smooth) == pytest.approx(force(plain), rel=SETTLED)
    assert 1.0 < force(rough) / force(plain) < 1.5
    _, forces = rough._last[PLATE, SITE]
    sideways = np.hypot(forces[0], forces[2])
    assert 0.1 * 0.5 * forces[1].sum() < sideways.sum() <= 0.5 * forces[1].sum() * (1 + SETTLED)


def test_friction_must_be_pressed_in_order(rough):
    rough = anew(rough)
    rough.press(PLATE, SITE, 0.2)
    with pytest.raises(ValueError, match="in order"):
        rough.press(PLATE, SITE, 0.1)
    rough.rest()
    assert rough.press(PLATE, SITE, 0.1).force > 0.0


@pytest.mark.parametrize("rig", [Rig(friction=0.5), Rig(sticky=(4e-4, 0.05)), Rig(late=0.05, frame=0.8)], ids=["rough", "sticky", "loose"])
def test_a_finger_goes_through_all_recordings_of_a_laboratory(rig):
    seen = protocol.elastic(FLESH, rig, protocol.THIN_PAD)
    assert set(seen.curves) == {"plate_force", "sphere_force", "plate_hold"} and seen.lines["wedge_profile"].shape[0] == 4
    for travel, force_ in seen.curves.values():
        assert np.all(np.diff(travel) > 0) and np.all(np.diff(force_) > 0)


def test_adhesion_pulls_and_vanishes_with_its_strength(plain):
    none, weak, strong = (force(pressing.Sticky(plain.body, strength, 0.05), 0.6) for strength in (0.0, 2e-4, 4e-4))
    assert none == pytest.approx(force(plain, 0.6), rel=1e-6)
    assert strong < weak < none
    assert none - strong == pytest.approx(2 * (none - weak), rel=0.25)


def test_a_late_zero_shifts_the_travel(plain):
    late = felt(Rig(late=0.1), plain, PLATE, SITE, 1.0)
    assert late.force == pytest.approx(force(plain, 1.0 - 0.1 * protocol.SHARES["flat_plate"]), rel=1e-9)
    assert felt(Rig(late=0.1), plain, PLATE, SITE, 0.05).force == 0.0


def test_a_giving_frame_takes_its_share_of_the_travel(plain):
    seen = felt(Rig(frame=0.8), plain, PLATE, SITE, 1.0).force
    taken = 0.8 * protocol.FRAME_TURN * np.log1p(seen / protocol.FRAME_TURN)
    assert seen < force(plain)
    assert seen == pytest.approx(force(plain, 1.0 - taken), rel=2e-3)


def test_a_slide_moves_the_site(plain):
    slid = felt(Rig(slide=0.3, slide_per_mm=0.2), plain, BALL, SITE, 0.5)
    assert slid.force == pytest.approx(plain.press(BALL, SITE + 0.4, 0.5).force, rel=1e-9)


def middle(one: pressing.Plain, seen: pressing.Felt) -> float:
    z = one.body.mesh.nodes[one.body.watched, 2]
    return float((z * seen.deflection).sum() / seen.deflection.sum())


def test_a_plate_that_falls_away_towards_the_tip_presses_nearer_the_hand(plain):
    level, tilted = (felt(Rig(tilt=tilt), plain, PLATE, SITE, 0.6) for tilt in (0.0, 6.0))
    assert middle(plain, tilted) < middle(plain, level) - 0.1


def test_a_blunt_wedge_takes_its_neighbours_along(plain):
    sharp, blunt = (felt(Rig(blunt=radius), plain, LINE, SITE, 1.0).deflection for radius in (0.0, 0.8))
    near = np.abs(plain.body.mesh.nodes[plain.body.watched, 2] - SITE)
    assert np.all(blunt[(near > 0.4) & (near < 2.0)] > sharp[(near > 0.4) & (near < 2.0)])


def test_a_bad_spindle_swings_about_the_travel(plain):
    quarter = protocol.PITCH / 4
    assert felt(Rig(screw=0.04), plain, PLATE, SITE, quarter).force == pytest.approx(force(plain, quarter + 0.04), rel=1e-9)


def test_what_does_not_go_together_is_refused():
    with pytest.raises(ValueError, match="one at a time"):
        protocol.finger_of(replace(FLESH, stiffening=1.0), Rig(friction=0.3))


TIME = np.arange(0.0, 8.0, protocol.FINE)
TRAVEL = np.interp(TIME, [0, 1, 7, 8], [0, 1.2, 1.2, 0.2])


def test_relaxation_of_a_step_is_its_power_law():
    force_ = np.full_like(TIME, 0.3)
    seen = instruments.relaxing(0.4, 0.8)(TIME, TRAVEL, force_)
    assert np.allclose(seen, 0.3 * (1 - 0.4 * (1 - (1 + TIME / 0.8) ** -0.6)), atol=1e-12)


def test_hysteresis_takes_nothing_on_the_way_down_and_its_share_on_the_way_back():
    force_ = TRAVEL.copy()
    seen = instruments.lossy(0.25)(TIME, TRAVEL, force_)
    assert np.array_equal(seen[TIME <= 7.0], force_[TIME <= 7.0])
    assert seen[-1] == pytest.approx(0.75 * force_[-1], rel=1e-2)


def test_a_lag_is_late_on_a_ramp():
    ramp = 0.1 * TIME
    seen = instruments.lagging(0.12)(TIME, TRAVEL, ramp)
    assert seen[-1] == pytest.approx(ramp[-1] - 0.1 * 0.12, abs=0.1 * protocol.FINE)


def test_zero_and_gain_of_the_load_cell():
    force_ = TRAVEL.copy()
    assert np.allclose(instruments.offset(0.02)(TIME, TRAVEL, force_) - force_, 0.02)
    assert np.allclose(instruments.gaining(1.1)(TIME, TRAVEL, force_), 1.1 * force_)
    drift = instruments.drifting(0.002)(TIME, TRAVEL, force_) - force_
    assert drift[0] == 0.0 and drift[1] == pytest.approx(0.002 * TIME[1], rel=1e-2)
    swing = instruments.swinging(0.01, 2.0)(TIME, TRAVEL, force_) - force_
    assert np.abs(swing).max() == pytest.approx(0.01, rel=1e-3)


def dent(at: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (at / 2.0) ** 2)


def test_cameras_enlarge_turn_and_bend():
    at = np.linspace(-6.0, 6.0, 25)
    assert np.allclose(instruments.enlarging(0.05)(dent, 1.05 * at), 1.05 * dent(at))
    flat = instruments.turned(1.0)(np.zeros_like, at)
    assert np.allclose(flat, np.tan(np.radians(1.0)) * at)
    bent = instruments.barrel(0.08, 6.0)(dent, at)
    assert bent[12] == 1.0 and np.all(bent[at != 0] < dent(at[at != 0]))


def test_nerves_saturate_bend_hum_and_tire():
    rates, times = np.linspace(0.0, 100.0, 201)[:, None].repeat(2, 1), np.array([0.3, 3.0])
    full = instruments.saturating(90.0)(rates, times)[:, 0]
    assert full[1] == pytest.approx(rates[1, 0], rel=5e-3) and full.max() < 90.0
    bent = instruments.bending(0.7)(rates, times)[:, 0]
    assert bent[80] == pytest.approx(40.0) and np.all(np.diff(bent) > 0) and np.abs(np.diff(bent)).max() < 1.3
    hum = instruments.humming(5.0)(rates, times)[:, 0]
    assert hum[0] == 5.0 and hum[-1] == pytest.approx(100.0, rel=1e-2)
    tired = instruments.tiring(0.1)(rates, times)
    assert np.allclose(tired[:, 0], rates[:, 0]) and np.allclose(tired[:, 1], 10**-0.1 * rates[:, 1])


def test_a_trace_is_monotone_between_readings_and_exact_at_them():
    curve = np.array([[0.0, 0.3, 0.7, 1.2], [0.0, 0.02, 0.08, 0.19]])
    found = protocol.Elastic({}, np.zeros(0), {"plate": curve}, {})
    assert np.allclose(found.force("plate", curve[0]), curve[1], atol=1e-12)
    assert all(a <= b for a, b in pairwise(found.force("plate", np.linspace(0, 1.2, 60))))


def test_anderson_mixing_solves_a_linear_map():
    random = np.random.default_rng(2)
    matrix = 0.9 * np.linalg.qr(random.normal(size=(6, 6)))[0]
    right, at, mixing = random.normal(size=6), np.zeros(6), stiffening.Mixing(8)
    for _ in range(9):
        at = mixing(at, matrix @ at + right)
    assert np.allclose(at, np.linalg.solve(np.eye(6) - matrix, right), atol=1e-7)
