"""A compiler can be wrong, so what it makes of a large element loop is compared with NumPy.

On the CPU, jax 0.10.2 silently gives wrong numbers for a jitted `vmap(M @ v)` followed by a reduction once
more than 16384 float64 rows go through it (jax issue 39103), and on some processors for `arctan` of 50 values
and more (39352). How many rows show it depends on how the loop is shared out, hence several lengths. The tests ask the
compiler for plain code (`conftest.py`); these are run once more, in a process of their own, on the code that users have.
"""

from __future__ import annotations

import os
import subprocess
import sys

import helpers
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

ELEMENTS = (16_384, 16_385, 20_000, 40_001, 100_000)


def test_the_broken_release_is_not_installed() -> None:
    assert "0.10.2" not in (jax.__version__, jaxlib.__version__)


@pytest.mark.parametrize("elements", ELEMENTS)
def test_a_jitted_product_and_reduction_per_element_is_what_numpy_makes_of_it(elements: int) -> None:
    matrix = np.array([[2.0, -1.0, 0.5], [0.0, 3.0, 1.0], [1.0, 0.25, -2.0]])
    rows = np.arange(3.0 * elements).reshape(elements, 3) / elements
    found = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(rows)
    helpers.SAME_ARITHMETIC.check(found, np.sum((rows @ matrix.T) ** 2, axis=1))


@pytest.mark.parametrize("elements", ELEMENTS)
def test_a_jitted_strain_energy_and_its_forces_are_what_numpy_makes_of_them(elements: int) -> None:
    random = np.random.default_rng(39103)
    gradients = random.normal(size=(elements, 10, 3))  # of ten shape functions at one point
    displacement = random.normal(size=(elements, 10, 3))
    lame, shear = 0.6, 0.03  # MPa

    def energy(gradient: jax.Array, u: jax.Array) -> jax.Array:
        strain = gradient.T @ u
        strain = (strain + strain.T) / 2
        return 0.5 * lame * jnp.trace(strain) ** 2 + shear * jnp.sum(strain**2)

    found, forces = jax.jit(jax.vmap(jax.value_and_grad(energy, argnums=1)))(gradients, displacement)

    strain = np.einsum("eni,enj->eij", gradients, displacement)  # e element, n node, i j space
    strain = (strain + strain.swapaxes(1, 2)) / 2
    dilation = np.trace(strain, axis1=1, axis2=2)
    stress = lame * dilation[:, None, None] * np.eye(3) + 2 * shear * strain
    helpers.SAME_ARITHMETIC.check(found, 0.5 * lame * dilation**2 + shear * np.sum(strain**2, axis=(1, 2)))
    helpers.SAME_ARITHMETIC.check(forces, np.einsum("enj,eij->eni", gradients, stress))


@pytest.mark.parametrize("function", ["arctan", "arctan2", "sqrt", "exp", "log1p", "cos", "tanh"])
def test_elementary_functions_of_long_arrays_are_what_numpy_makes_of_them(function: str) -> None:
    values = np.linspace(0.0, 5.0, 1_001)
    arguments = (values, 5.0 - values) if function == "arctan2" else (values,)
    found = jax.jit(getattr(jnp, function))(*arguments)
    helpers.SAME_ARITHMETIC.check(found, getattr(np, function)(*arguments))


@pytest.mark.skipif(os.environ.get("XLA_FLAGS") == "", reason="these are the compiler's own options")
def test_all_of_this_holds_of_the_code_that_users_have() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(command, env=os.environ | {"XLA_FLAGS": ""}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:]
    assert f"{2 * len(ELEMENTS) + 8} passed, 1 skipped" in done.stdout
