"""Tissue laws: derivatives against differences, small strain, rotation, closed forms, the null of each, and what they do where they end."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.fem.assembly import Assembled, element_matrices
from fingerjax.fem.body import material
from fingerjax.fem.energy import density, internal_force, smallest_volume, total_energy
from fingerjax.fem.operator import internal_force as linear_force
from fingerjax.fem.operator import strain_energy
from fingerjax.fem.stiffness import element_tangents, tangent
from fingerjax.fem.tissue import Exponential, FiniteStrain, Linear, log_remainder, relative_growth

from .fem_tools import cube_body

SKIN = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}, 0.48)
LAME, LAYER = jnp.array([0.7, 0.2]), jnp.asarray(1)
B = jnp.array([0.0, 3.0, 0.5, 8.0, 0.0])
TISSUES = {
    "linear": Linear(),
    "neo-Hookean": FiniteStrain(),
    "half way": FiniteStrain(0.5),
    "stiffening": Exponential(Linear(), B),
    "stiffening at finite strain": Exponential(FiniteStrain(), B),
}
NULLS = {
    "homotopy 0": FiniteStrain(0.0),
    "b 0": Exponential(Linear(), 0.0 * B),
    "both": Exponential(FiniteStrain(0.0), 0.0 * B),
}


def gradient(scale, key=0):
    return scale * jax.random.normal(jax.random.key(key), (3, 3))


def rotation():
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    K = np.cross(np.eye(3), axis)
    return jnp.asarray(np.eye(3) + np.sin(1.1) * K + (1 - np.cos(1.1)) * K @ K)


@eqx.filter_jit
def law(tissue, H):
    """Energy, stress and stiffness at a displacement gradient."""
    return tuple(of(H, LAME, LAYER) for of in (tissue.density, jax.grad(tissue.density), jax.hessian(tissue.density)))


@pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)
def test_stress_and_stiffness_match_differences(tissue):
    H, h, way = gradient(0.15), 1e-4, gradient(1.0, key=1)
    (ahead, stress_ahead, _), (behind, stress_behind, _) = law(tissue, H + h * way), law(tissue, H - h * way)
    _, stress, stiffness = law(tissue, H)
    assert (ahead - behind) / (2 * h) == pytest.approx(float(jnp.sum(stress * way)), rel=1e-6)
    change = jnp.einsum("ijkl,kl->ij", stiffness, way)
    np.testing.assert_allclose((stress_ahead - stress_behind) / (2 * h), change, atol=1e-6 * float(jnp.abs(change).max()))


@pytest.mark.parametrize("tissue", TISSUES.values(), ids=TISSUES)
def test_small_strain_has_the_lame_parameters(tissue):
    energy, stress, stiffness = law(tissue, jnp.zeros((3, 3)))
    assert energy == 0.0 and jnp.abs(stress).max() == 0.0
    np.testing.assert_allclose(stiffness, law(Linear(), jnp.zeros((3, 3)))[2], atol=1e-14)


@pytest.mark.parametrize("name", ["neo-Hookean", "stiffening at finite strain"])
def test_rotation_costs_no_energy_at_finite_strain(name):
    F, Q = jnp.eye(3) + gradient(0.2), rotation()
    (energy, stress, _), (turned, turned_stress, _), (before, _, _) = (law(TISSUES[name], A - jnp.eye(3)) for A in (F, Q @ F, F @ Q))
    assert turned == pytest.approx(float(energy), rel=1e-12) and before == pytest.approx(float(energy), rel=1e-12)
    assert abs(float(law(TISSUES[name], Q - jnp.eye(3))[0])) < 1e-14
    np.testing.assert_allclose(turned_stress, Q @ stress, atol=1e-13)


@pytest.mark.parametrize("tissue", NULLS.values(), ids=NULLS)
def test_null_is_linear_to_the_last_bit_and_its_slope_is_finite(tissue):
    for scale in (1e-6, 1e-2, 0.3, 3.0):  # the last one turns the tissue inside out, which Hooke's law does not mind
        assert law(tissue, gradient(scale))[0] == law(Linear(), gradient(scale))[0]
    body, u = cube_body(1, layers=4), 0.1 * jax.random.normal(jax.random.key(2), (27, 3))
    energy = eqx.filter_jit(total_energy)
    assert energy(body, tissue, SKIN.lame(), u) == energy(body, Linear(), SKIN.lame(), u)


@pytest.mark.parametrize("s", [0.02, 0.3, 1.0])
def test_homotopy_is_the_answer_to_part_of_the_displacement(s):
    H = gradient(0.2)
    energy, stress, stiffness = law(FiniteStrain(s), H)
    whole, pulled, stiff = law(FiniteStrain(), s * H)
    assert energy == pytest.approx(float(whole) / s**2, rel=1e-9)
    np.testing.assert_allclose(stress, pulled / s, atol=1e-11)
    np.testing.assert_allclose(stiffness, stiff, atol=1e-11)


@pytest.mark.parametrize("order", range(3))
def test_the_logs_remainder_is_smooth_where_its_series_ends(order):
    """-1/3 + x/4 - x^2/5 + ... to sixty terms, against both branches and their derivatives."""
    function = log_remainder
    for _ in range(order):
        function = jax.grad(function)
    function = jax.jit(function)
    for x in (-0.4, -0.101, -0.099, 0.0, 1e-6, 0.099, 0.101, 0.4):
        falling = [np.prod([n - k for k in range(order)]) for n in range(60)]
        exact = sum((-1.0) ** (n + 1) / (n + 3) * falling[n] * x ** (n - order) for n in range(order, 60))
        assert function(jnp.asarray(x)) == pytest.approx(exact, rel=1e-9)


def test_slopes_at_null_match_differences():
    H, h = gradient(0.1), 1e-6

    def towards(s):
        return FiniteStrain(s).density(H, LAME, LAYER)

    def stiffened(b):
        return Exponential(Linear(), jnp.full(5, b)).density(H, LAME, LAYER)

    for energy in (jax.jit(towards), jax.jit(stiffened)):
        slope = jax.grad(energy)(0.0)
        assert slope == pytest.approx(float((energy(h) - energy(-h)) / (2 * h)), rel=1e-6) and slope != 0.0
    half = Linear().density(H, LAME, LAYER) ** 2 / (2 * LAME[1])
    assert jax.grad(stiffened)(0.0) == pytest.approx(float(half), rel=1e-12)


@pytest.mark.parametrize("order", range(4))
def test_relative_growth_is_smooth_where_its_series_ends(order):
    """The Taylor coefficients of (e^x - 1)/x to thirty terms, derived by hand, against both branches and their derivatives."""
    function = relative_growth
    for _ in range(order):
        function = jax.grad(function)
    function = jax.jit(function)
    for x in (0.0, 1e-9, 1e-3, 0.49, 0.51, 1.5):
        exact, term = 0.0, 1.0
        for n in range(40):
            term = term / (n + 1)  # 1/(n + 1)!
            falling = np.prod([n - k for k in range(order)])
            exact += term * falling * x ** (n - order) if n >= order else 0.0
        assert function(jnp.asarray(x)) == pytest.approx(exact, rel=1e-11)


def test_absurd_steps_are_never_a_number():
    """Energy, stress and stiffness all say so: a force of zero at an inverted element would pass for equilibrium."""
    inside_out, torn = jnp.diag(jnp.array([-1.5, 0.1, 0.1])), 60.0 * jnp.eye(3)
    for tissue, H in [
        (FiniteStrain(), inside_out),
        (FiniteStrain(0.9), inside_out),
        (Exponential(FiniteStrain(), B), inside_out),
        (Exponential(Linear(), B), torn),
        (Exponential(FiniteStrain(), B), torn),
        (Exponential(Linear(), B), 1e200 * jnp.eye(3)),
    ]:
        for value in law(tissue, H):
            assert not np.all(np.isfinite(np.asarray(value)))


def test_uniaxial_and_shear_stress_of_neo_hookean_tissue():
    lam, mu = LAME
    stretch = 1.3
    P = law(FiniteStrain(), jnp.diag(jnp.array([stretch - 1, 0.0, 0.0])))[1]
    volumetric = lam / 2 * (stretch**2 - 1)  # J dU/dJ
    np.testing.assert_allclose(P[0, 0], mu * (stretch - 1 / stretch) + volumetric / stretch, rtol=1e-12)
    np.testing.assert_allclose(P[1, 1], volumetric, rtol=1e-12)
    shear = law(FiniteStrain(), jnp.zeros((3, 3)).at[0, 1].set(0.4))[1]
    np.testing.assert_allclose(shear, mu * jnp.array([[0, 0.4, 0], [0.4, 0, 0], [0, 0, 0]]), atol=1e-14)


def test_linear_energy_and_force_are_the_operators():
    body = cube_body(2, layers=4)
    u = 0.1 * jax.random.normal(jax.random.key(0), body.nodes.shape)
    exact = linear_force(body, SKIN.lame(), u)
    found = eqx.filter_jit(internal_force)(body, Linear(), SKIN.lame(), u)
    np.testing.assert_allclose(found, exact, atol=1e-13 * float(jnp.abs(exact).max()))
    assert total_energy(body, Linear(), SKIN.lame(), u) == pytest.approx(float(strain_energy(body, SKIN.lame(), u)), rel=1e-13)
    lam, mu = np.asarray(SKIN.lame())[:, np.asarray(body.layer), None, None]
    volumetric, shear = element_matrices(body)
    elements = np.asarray(element_tangents(tangent(body, Linear(), SKIN.lame(), u)))
    np.testing.assert_allclose(elements, lam * volumetric + mu * shear, atol=1e-13 * np.abs(elements).max())


def test_force_and_tangent_are_the_energys_derivatives():
    body, tissue, lame = cube_body(2, layers=4), TISSUES["stiffening at finite strain"], SKIN.lame()
    u = 0.01 * jax.random.normal(jax.random.key(0), body.nodes.shape)
    way = jax.random.normal(jax.random.key(1), body.nodes.shape) * body.free[:, None]
    slope = eqx.filter_jit(jax.grad(total_energy, argnums=3))(body, tissue, lame, u)
    force, exact = eqx.filter_jit(lambda v: jax.jvp(lambda w: internal_force(body, tissue, lame, w), (u,), (v,)))(way)
    np.testing.assert_allclose(force, slope, atol=1e-13 * float(jnp.abs(force).max()))
    stiffness = tangent(body, tissue, lame, u)
    size = float(jnp.abs(exact).max())
    np.testing.assert_allclose(stiffness(way), exact, atol=1e-12 * size)
    for upper in (False, True):
        pattern = Assembled(body, upper=upper)
        K = stiffness.matrix(pattern)
        K = K + K.T - np.diag(K.diagonal()) if upper else K
        found = np.asarray(K @ np.asarray(way).ravel()[pattern.free]).ravel()
        np.testing.assert_allclose(found, np.asarray(exact).ravel()[pattern.free], atol=1e-12 * size)


def test_a_stiffened_layer_alone_stores_more():
    body = cube_body(2, layers=4)
    u = 0.1 * jax.random.normal(jax.random.key(0), body.nodes.shape)
    more = density(body, Exponential(Linear(), B), SKIN.lame(), u) / density(body, Linear(), SKIN.lame(), u)
    stiffened = np.asarray(B)[np.asarray(body.layer)] > 0
    assert np.all(np.asarray(more)[stiffened] > 1.0) and np.all(np.asarray(more)[~stiffened] == 1.0)


def test_the_smallest_volume_is_that_of_the_most_squeezed_point():
    body = cube_body(1)
    assert smallest_volume(body, body.nodes * jnp.array([0.1, -0.5, 0.0])) == pytest.approx(1.1 * 0.5, rel=1e-12)
    assert smallest_volume(body, body.nodes * jnp.array([0.0, -1.2, 0.0])) == pytest.approx(-0.2, rel=1e-12)
