"""The pad: quadrature, partition of load and area, location on curved facets, first contact, windows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from halfspace import lattice

from fingerjax.contact.footprint import first_contact, interface
from fingerjax.contact.indenter import Bar, FlatCylinder, FlatPlate, Line, Sphere
from fingerjax.contact.locate import locate, surface_functionals, surface_y
from fingerjax.contact.pad import functionals, pad
from fingerjax.contact.reach import Indentation, pad_for, windows
from fingerjax.errors import InputError
from fingerjax.geometry.presets import preset
from fingerjax.mesh import Resolution, build_finger

BOWL = lattice(
    12, 0.5, lambda x, z: (x**2 + 0.5 * z**2) / 8.0
)  # a finger pad seen from below: lowest in the middle
FLAT = lattice(8, 0.5)
faces = jax.jit(interface)


def test_loads_areas_and_weights_add_up():
    whole, face = pad(FLAT), faces(pad(FLAT), FlatPlate(), (0.0, 0.0))
    assert float(whole.weight.sum()) == pytest.approx(16.0)
    assert float(face.area.sum()) == pytest.approx(16.0)
    assert np.asarray(face.load.sum(axis=0)) == pytest.approx(np.asarray(face.area))
    # A uniform pressure on a flat quadratic triangle loads its midsides only.
    corner = np.isin(np.arange(len(whole.nodes)), np.asarray(whole.facets)[:, :3])
    assert np.abs(np.asarray(face.load.sum(axis=1))[corner]).max() < 1e-14


@pytest.mark.parametrize("radius", [0.8, 1.1])
def test_the_covered_area_is_that_of_the_indenter(radius):
    face = faces(pad(FLAT), FlatCylinder(radius), (0.07, -0.11))
    assert float(face.covered.sum()) == pytest.approx(np.pi * radius**2, rel=0.01)


def test_the_covered_area_follows_the_edge():
    def wide(w):
        return jnp.sum(faces(pad(FLAT), Bar(w), (0.0, 0.03)).covered)

    assert float(jax.grad(wide)(1.37)) == pytest.approx(4.0, rel=0.15)


def test_only_skin_that_faces_the_indenter_is_taken():
    upside_down = type(FLAT)(FLAT.nodes, FLAT.skin[:, [0, 2, 1, 5, 4, 3]])
    with pytest.raises(InputError, match="pad must be at -y"):
        pad(upside_down)


def test_a_place_beside_an_edge_that_bends_far_is_found():
    """Two triangles of a square, whose common edge bulges into one of them: straight, places in the bulge are in the wrong one."""
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]])
    middles = np.array([[1.0, 0.0], [1.2, 1.2], [0.0, 1.0], [2.0, 1.0], [1.0, 2.0]])
    x, z = np.concatenate([corners, middles]).T
    square = type(BOWL)(np.column_stack([x, 0.3 * x - 0.2 * z - 5.0, z]), np.array([[0, 1, 2, 4, 5, 6], [1, 3, 2, 7, 8, 5]]))
    at = np.linspace(0.05, 1.95, 20)
    x, z = (each.ravel() for each in np.meshgrid(at, at))
    assert surface_y(square, x, z) == pytest.approx(0.3 * x - 0.2 * z - 5.0, abs=1e-10)
    facet, shape, inside = locate(pad(square), jnp.asarray([1.08]), jnp.asarray([1.08]))
    assert inside.all() and int(facet[0]) == 0 and float(shape.sum()) == pytest.approx(1.0)


def test_surface_is_located_on_curved_facets():
    random = np.random.default_rng(0)
    x, z = random.uniform(-2.9, 2.9, (2, 50))
    assert surface_y(BOWL, x, z) == pytest.approx((x**2 + 0.5 * z**2) / 8.0, abs=1e-12)
    bent = type(BOWL)(BOWL.nodes + 0.03 * np.sin(3 * BOWL.nodes[:, [2, 0, 1]]) * [1, 0, 1], BOWL.skin)
    columns = surface_functionals(bent, np.column_stack([x, z]) * 0.8)
    assert np.asarray(columns.sum(axis=0)).ravel() == pytest.approx(np.ones(50))
    found = (
        columns.T
        @ np.column_stack([np.zeros(len(bent.nodes)), bent.nodes[:, 0], np.zeros(len(bent.nodes))]).ravel()
    )
    assert found == pytest.approx(0.8 * x, abs=1e-10)
    with pytest.raises(InputError, match="the pad lies within"):
        surface_y(BOWL, np.array([0.0, 9.0]), np.array([0.0, 0.0]))


def test_functionals_read_the_vertical_displacement():
    whole = pad(BOWL)
    u = np.random.default_rng(1).normal(size=(len(BOWL.nodes), 3))
    assert np.array_equal(functionals(whole, len(u)).T @ u.ravel(), u[np.asarray(whole.nodes), 1])


def test_first_contact_on_a_curved_pad():
    whole = pad(BOWL)
    assert float(first_contact(whole, FlatPlate(), (0.3, 0.2))) == pytest.approx(0.0, abs=1e-9)
    # A ball of radius 2 beside the lowest point: the least of x^2/8 + 2 - sqrt(4 - (x - 1)^2).
    x = np.linspace(0, 1, 100001)
    exact = np.min(x**2 / 8 + 2 - np.sqrt(4 - (x - 1) ** 2))
    assert float(first_contact(whole, Sphere(2.0), (1.0, 0.0))) == pytest.approx(exact, abs=2e-6)
    edge = float(first_contact(whole, Bar(1.0, along="z"), (1.33, 0.0)))
    assert edge == pytest.approx(0.83**2 / 8, abs=2e-4)
    assert float(first_contact(whole, Line(), (0.0, 1.2))) == pytest.approx(1.2**2 / 16, abs=3e-3)


def test_first_contact_differentiates_in_pose_and_shape():
    whole, step = pad(BOWL), 1e-4
    touch = jax.jit(lambda x0, r: first_contact(whole, Sphere(r), (x0, 0.1)))
    for argument in (0, 1):
        ends = [touch(*(np.array([1.03, 2.1]) + sign * step * np.eye(2)[argument])) for sign in (1, -1)]
        slope = (float(ends[0]) - float(ends[1])) / (2 * step)
        assert float(jax.grad(touch, argument)(1.03, 2.1)) == pytest.approx(slope, rel=1e-3, abs=1e-5)


def test_a_line_carries_its_width_times_its_length():
    face = faces(pad(FLAT), Line(0.05), (0.0, 0.13))
    assert float(face.area.sum()) == pytest.approx(4.0 * 0.05)
    assert float(face.load.sum()) == pytest.approx(4.0 * 0.05)
    across = pad(FLAT).points[:, 2] @ face.load.sum(axis=1)
    assert float(across) == pytest.approx(0.13 * 0.2)


def test_the_pad_holds_what_can_be_reached():
    small = pad_for(BOWL, [Indentation(Sphere(1.0), (0.0, 0.0), 0.2)])
    assert 0 < len(small.facets) < 0.5 * len(pad(BOWL).facets)
    face = faces(small, Sphere(1.0), (0.0, 0.0))
    pressed = np.asarray(face.overlap + 0.2 * face.area) > 0
    assert pressed.any() and not np.any(pressed & np.asarray(small.rim))


def test_windows_are_the_pad_seen_from_each_position():
    poses = [Indentation(Bar(1.0, 0.2, along="z"), (x0, 0.0), 0.3) for x0 in (-1.0, 0.0, 1.4)]
    whole = pad_for(BOWL, poses)
    many = windows(whole, poses)
    for i, pose in enumerate(poses):
        seen = jax.tree.map(lambda leaf: leaf[i], many)  # noqa: B023
        face, full = faces(seen, pose.indenter, pose.origin), faces(whole, pose.indenter, pose.origin)
        force = (
            jnp.zeros(len(whole.nodes))
            .at[seen.columns]
            .add(face.load @ jnp.where(face.overlap + 0.2 * face.area > 0, 1.0, 0.0))
        )
        assert np.asarray(force) == pytest.approx(
            np.asarray(full.load @ jnp.where(full.overlap + 0.2 * full.area > 0, 1.0, 0.0))
        )
        assert float(face.lowest) == pytest.approx(float(full.lowest), abs=1e-12)


def test_where_a_finger_was_cut_its_skin_ends_as_at_any_edge_of_the_body():
    """A plate may rest on the rim of the cut; what is left out of a pad that was chosen is still its border."""
    finger = build_finger(preset("monkey"), Resolution(1.2))
    whole = pad(finger)
    cut = np.asarray(finger.proximal)[np.asarray(whole.nodes)]
    carrying = np.unique(np.asarray(whole.facets)[:, :3])
    rim = np.zeros(len(whole.nodes), bool)
    rim[carrying[np.asarray(whole.rim)]] = True
    assert cut[carrying].any() and rim.any() and not np.any(rim & cut)
