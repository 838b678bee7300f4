"""Values and a law from one vector: the numbers of that vector, and compiled once whatever they are."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from fingerjax.effects.catalogue import catalogue
from fingerjax.fem.tissue import Exponential, FiniteStrain, Linear
from fingerjax.parameters import Parameter
from fingerjax.runners.lawful import LawAlong, Lawful

STIFF = Parameter("epidermis.modulus", 0.18, "MPa")
LAWS = tuple(effect for effect in catalogue() if effect.name in ("finite_strain", "strain_stiffening"))


def lawful(dermis: float, deep: float) -> Lawful:
    amounts = {"finite_strain": {"homotopy": jnp.asarray(1.0)}, "strain_stiffening": {"skin": jnp.asarray(0.0), "deep": jnp.asarray(deep)}}
    values = {"epidermis.modulus": jnp.asarray(0.5), "dermis.modulus": jnp.asarray(dermis)}
    return Lawful((STIFF,), LAWS, (("strain_stiffening", "skin"),), values, amounts)


def test_what_moves_comes_from_the_vector_and_what_is_held_from_the_fields() -> None:
    values, law = lawful(0.02, 3.0)(jnp.asarray([STIFF.raw(0.2), 7.0]))
    assert float(values["epidermis.modulus"]) == pytest.approx(0.2) and float(values["dermis.modulus"]) == 0.02
    assert isinstance(law, Exponential) and isinstance(law.tissue, FiniteStrain)
    assert law.stiffening.tolist() == [7.0, 7.0, 3.0, 3.0, 0.0]


def test_other_numbers_are_not_compiled_anew() -> None:
    traced = []

    @eqx.filter_jit
    def read(of: Lawful, at: jax.Array) -> jax.Array:
        traced.append(at)
        values, law = of(at)
        return values["dermis.modulus"] + law.stiffening.sum()

    found = [float(read(lawful(dermis, deep), jnp.asarray([0.0, 1.0]))) for dermis, deep in ((0.02, 3.0), (0.5, 4.0))]
    assert found == [pytest.approx(8.02), pytest.approx(10.5)] and len(traced) == 1


def test_a_law_along_one_number_is_not_compiled_anew() -> None:
    traced = []

    @eqx.filter_jit
    def slope(of: LawAlong, at: jax.Array) -> jax.Array:
        traced.append(at)
        return jax.jvp(lambda size: of(size).density(0.1 * jnp.eye(3), jnp.asarray([1.0, 0.5]), jnp.asarray(2)), (at,), (jnp.ones(()),))[1]

    stiffening = LAWS[[effect.name for effect in LAWS].index("strain_stiffening")]
    along = [LawAlong(stiffening, "deep", {"skin": jnp.asarray(skin), "deep": jnp.asarray(0.0)}) for skin in (0.0, 3.0)]
    energy = float(Linear().density(0.1 * jnp.eye(3), jnp.asarray([1.0, 0.5]), jnp.asarray(2)))
    found = [float(slope(each, jnp.asarray(0.0))) for each in along]
    assert found == [pytest.approx(energy**2 / (2 * 0.5))] * 2 and len(traced) == 1  # (e^x - 1)/x of x = b W/mu grows by x/2
