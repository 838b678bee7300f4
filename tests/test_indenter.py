"""Shapes: heights, edges, flanks, derivatives, and what a wrong one is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.contact import indenter as shapes
from fingerjax.errors import InputError

ALL = {
    "line": shapes.Line(),
    "point": shapes.Point(0.75, 0.25),
    "flat_plate": shapes.FlatPlate(),
    "bar": shapes.Bar(3.0, 0.3),
    "bar along z": shapes.Bar(1.0, along="z"),
    "step": shapes.Step(0.5, 2.0),
    "steep step": shapes.Step(1.0, 0.5),
    "sphere": shapes.Sphere(2.0),
    "cylinder": shapes.Cylinder(1.5, along="z"),
    "flat_cylinder": shapes.FlatCylinder(3.175),
    "grating": shapes.Grating(0.5, 1.0, 0.1),
    "uneven grating": shapes.Grating([0.5, 0.5, 3.0], [1.0, 0.75]),
    "profile": shapes.Profile([-1.0, 0.0, 1.0, 1.1], [0.0, 0.3, 0.1, -5.0]),
}
X = jnp.asarray(np.random.default_rng(1).uniform(-3, 3, (2, 400)))


@pytest.mark.parametrize("name", ALL)
def test_height_is_at_most_zero_and_reaches_it(name):
    shape = ALL[name]
    height = shape.height(*X)
    assert np.all(height <= 1e-15)
    assert np.all(np.asarray(height)[~np.asarray(shape.covers(*X))] == shapes.NOTHING)
    line = jnp.linspace(-1.0, 1.0, 2001)
    assert jnp.max(shape.height(line, line * 0)) > -1e-6 or jnp.max(shape.height(line * 0, line)) > -1e-6


@pytest.mark.parametrize("name", ALL)
def test_nothing_that_is_covered_is_steeper_than_68_degrees(name):
    shape = ALL[name]
    slope = jax.vmap(lambda x, z: jnp.hypot(*jax.grad(lambda a, b: shape.surface(a, b), (0, 1))(x, z)))(*X)
    assert np.all(np.asarray(slope)[np.asarray(shape.covers(*X))] <= np.tan(np.radians(68.0)) * (1 + 1e-9))
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("name", ALL)
def test_derivatives_in_shape_are_finite_everywhere(name):
    shape = ALL[name]
    for at in ((0.0, 0.0), (0.3, -0.2), (2.9, 2.9)):
        gradient = jax.grad(lambda s, x, z: s.surface(x, z))(shape, *map(jnp.asarray, at))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_known_heights():
    assert float(shapes.Sphere(2.0).height(1.0, 0.0)) == pytest.approx(np.sqrt(3) - 2)
    step = shapes.Step(0.5, 2.0)
    assert [float(step.height(0.3, s)) for s in (-1.0, 0.0, 0.25, 1.0)] == pytest.approx(
        [0.0, -0.25, -0.25 * (1 + np.sin(np.pi / 4)), -0.5]
    )
    bar = shapes.Bar(3.0, 0.3)
    assert float(bar.height(9.0, 1.2 + 0.1)) == pytest.approx(-(0.3 - np.sqrt(0.08)))
    reach = 1.2 + 0.3 * np.sin(np.radians(68))
    assert bar.covers(0.0, reach - 1e-6) and not bar.covers(0.0, reach + 1e-6)
    grating = shapes.Grating(0.5, 1.0)
    assert [bool(grating.covers(0.0, s)) for s in (0.2, 0.3, 1.2, 1.3, -1.6)] == [
        True,
        False,
        False,
        True,
        True,
    ]
    uneven = ALL["uneven grating"]
    assert [bool(uneven.covers(0.0, s)) for s in (-0.24, -1.5, 1.3, 1.9, 2.6, 5.4, 5.6)] == [
        True,
        False,
        True,
        False,
        True,
        True,
        False,
    ]
    assert float(shapes.Cylinder(1.0, along="z").height(0.0, 5.0)) == 0.0
    assert not ALL["profile"].covers(0.0, 1.05) and ALL["profile"].covers(0.0, 0.9)
    assert not ALL["steep step"].covers(0.0, 0.0) and ALL["steep step"].covers(0.0, 0.124)


def test_feature_is_the_smallest_length():
    assert ALL["bar"].feature == pytest.approx(0.3) and ALL["flat_plate"].feature is None
    assert shapes.Bar(3.0).feature == 3.0 and ALL["grating"].feature == pytest.approx(0.1)


def test_from_spec_builds_what_a_sidecar_names():
    bar = shapes.from_spec("bar", {"width": 3.0, "edge_radius": 0.3}, along="z")
    assert isinstance(bar, shapes.Bar) and bar.along == "z" and float(bar.width) == 3.0
    assert isinstance(shapes.from_spec("flat_plate", {}), shapes.FlatPlate)
    profile = shapes.from_spec("profile", {}, lists={"position": [0.0, 1.0], "height": [0.0, -0.2]})
    assert float(profile.height(0.0, 1.0)) == pytest.approx(-0.2)


@pytest.mark.parametrize(
    ("shape", "dimensions", "word"),
    [
        ("wedge", {}, "line"),
        ("sphere", {}, "radius"),
        ("sphere", {"width": 1.0}, "radius"),
        ("sphere", {"radius": -1.0}, "positive"),
        ("bar", {"width": 1.0, "edge_radius": 0.6}, "0.5"),
        ("profile", {}, "position"),
    ],
)
def test_a_wrong_shape_is_told_what_to_write(shape, dimensions, word):
    with pytest.raises(InputError, match=word):
        shapes.from_spec(shape, dimensions)
