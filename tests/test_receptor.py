"""Receptor quantities against closed forms, and their derivatives where principal values repeat."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from fingerjax.measure import receptor as felt

E, NU = 0.18, 0.48


def at(*strain):
    return felt.Receptor(jnp.asarray(strain, float), jnp.asarray(E), jnp.asarray(NU))


def test_uniaxial_stress():
    one = at(NU * 0.01, -0.01, NU * 0.01, 0, 0, 0)
    assert np.asarray(one.stress) == pytest.approx([0, -E * 0.01, 0, 0, 0, 0], abs=1e-14)
    values = {name: float(quantity(one)) for name, quantity in felt.QUANTITIES.items()}
    assert values == pytest.approx(
        {
            "strain_energy_density": 0.5 * E * 1e-4,
            "maximum_compressive_strain": 0.01,
            "mean_normal_stress": E * 0.01 / 3,
            "vertical_compressive_stress": E * 0.01,
            "von_mises_stress": E * 0.01,
            "maximum_shear_stress": E * 0.005,
        }
    )


def test_simple_shear():
    one, shear = at(0, 0, 0, 0, 0, 0.02), E / (2 * (1 + NU))
    assert float(felt.maximum_compressive_strain(one)) == pytest.approx(0.01)
    assert float(felt.maximum_shear_stress(one)) == pytest.approx(shear * 0.02)
    assert float(felt.von_mises_stress(one)) == pytest.approx(np.sqrt(3) * shear * 0.02)
    assert float(felt.strain_energy_density(one)) == pytest.approx(0.5 * shear * 0.02**2)


@pytest.mark.parametrize("name", felt.QUANTITIES)
def test_derivatives_are_finite_at_repeated_principal_values(name):
    for strain in ((0.0,) * 6, (-0.01, -0.01, -0.01, 0, 0, 0), (0.005, -0.01, 0.005, 0, 0, 0)):
        slope = jax.grad(felt.QUANTITIES[name])(at(*strain))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))


@pytest.mark.parametrize("name", felt.EVERY)
def test_derivatives_agree_with_differences(name):
    def value(e, m):
        return felt.EVERY[name](felt.Receptor(e, m, jnp.asarray(NU)))

    strain, modulus = jnp.array([0.01, -0.02, 0.004, 0.003, -0.006, 0.008]), jnp.asarray(E)
    check_grads(value, (strain, modulus), order=1, modes=("fwd", "rev"), eps=1e-5, rtol=1e-5, atol=1e-9)


def test_components_are_what_they_are_called():
    one = at(0.01, -0.02, 0.004, 0.003, -0.006, 0.008)
    lam, mu = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))
    assert float(felt.COMPONENTS["strain_xz"](one)) == -0.006 and felt.UNITS["strain_xz"] == "1"
    assert float(felt.COMPONENTS["stress_yy"](one)) == pytest.approx(lam * -0.006 + 2 * mu * -0.02)
    assert float(felt.COMPONENTS["stress_xy"](one)) == pytest.approx(mu * 0.008) and felt.UNITS["stress_xy"] == "MPa"
    assert len(felt.EVERY) == 18


def test_many_receptors_at_once():
    strain = jnp.asarray(np.random.default_rng(0).normal(size=(5, 7, 6)) * 0.01)
    many = felt.Receptor(strain, jnp.full((7,), E), jnp.asarray(NU))
    for quantity in felt.QUANTITIES.values():
        assert quantity(many).shape == (5, 7)
        assert float(quantity(many)[3, 2]) == pytest.approx(float(quantity(at(*np.asarray(strain[3, 2])))))
