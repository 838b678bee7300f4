"""Quadratic tetrahedra with pressure constant in each element: the same operator in three forms, and the same answer where that is due."""

from __future__ import annotations

import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import locking
from fingerjax.fem import assembly
from fingerjax.fem.assembly import Assembled
from fingerjax.fem.body import body, material
from fingerjax.fem.compliance import displacement
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.operator import apply, internal_force, strain_energy
from fingerjax.fem.solver import MultigridCG
from fingerjax.mesh.bodies import block

from .fem_tools import cube_body
from .test_mechanics import SKIN, warp


def nowhere(x: np.ndarray) -> np.ndarray:
    return np.zeros(len(x), bool)


@pytest.mark.parametrize(("degree", "bent"), [(2, False), (5, True)])
def test_patch_of_constant_strain_carries_no_interior_force(degree: int, bent: bool) -> None:
    one = cube_body(3, degree=degree, warp=warp if bent else None, held=nowhere, dilatation="mean")
    strain = np.array([[0.01, 0.004, -0.002], [0.003, -0.02, 0.006], [0.001, 0.005, 0.015]])
    force = np.asarray(internal_force(one, SKIN.lame(), jnp.asarray(np.asarray(one.nodes) @ strain.T)))
    inside = np.all(np.asarray(cube_body(3).nodes) % 1.0 > 1e-9, axis=1)
    assert inside.sum() > 5
    assert np.abs(force[inside]).max() <= 1e-10 * np.abs(force).max()


def bending(nodes: np.ndarray, dilatation: float) -> jax.Array:
    """A field of quadratic displacements whose dilatation is the same everywhere."""
    x, y, z = nodes.T
    return jnp.asarray(np.stack([x**2 + dilatation * x, -2 * x * y + z**2, x * y + y**2], axis=1))


def test_fields_of_constant_dilatation_are_answered_alike() -> None:
    """Stiffness agrees on them, and on no other field."""
    mean, pointwise = (cube_body(2, layers=4, held=nowhere, dilatation=one) for one in ("mean", "pointwise"))
    nearly = material({"epidermis": 0.18, "dermis": 0.018, "adipose": 0.02, "fibrous": 0.03}, 0.4999).lame()
    u = bending(np.asarray(mean.nodes), 0.3)
    expected = internal_force(pointwise, nearly, u)
    assert jnp.allclose(internal_force(mean, nearly, u), expected, rtol=0, atol=1e-12 * jnp.abs(expected).max())
    other = jnp.asarray(np.asarray(mean.nodes) ** 2)
    assert strain_energy(mean, nearly, other) < 0.99 * strain_energy(pointwise, nearly, other)


def test_operator_is_the_assembled_matrix_and_the_slope_of_the_energy() -> None:
    one = cube_body(2, warp=warp, layers=4, dilatation="mean")
    lame, assembled = SKIN.lame(), Assembled(one, upper=False)
    u = jax.random.normal(jax.random.key(1), one.nodes.shape) * one.free[:, None]
    matrix, force = assembled.matrix(np.asarray(lame)), np.asarray(apply(one, lame, u)).ravel()[assembled.free]
    assert np.allclose(force, matrix @ np.asarray(u).ravel()[assembled.free], rtol=0, atol=1e-13 * np.abs(force).max())
    slope = jax.grad(strain_energy, argnums=2)(one, lame, u)
    assert jnp.allclose(one.free[:, None] * slope, apply(one, lame, u), atol=1e-13)


def test_bodies_of_the_same_elements_share_where_their_stiffness_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    mean, pointwise, more = (cube_body(3, layers=layers, dilatation=form) for layers, form in ((3, "mean"), (3, "pointwise"), (2, "mean")))
    monkeypatch.setattr(assembly, "_PATTERNS", weakref.WeakValueDictionary())  # none that other tests hold
    one, other = Assembled(mean, upper=True), Assembled(pointwise, upper=True)
    assert one.pattern is other.pattern
    assert Assembled(mean, upper=False).pattern is not one.pattern and Assembled(more, upper=True).pattern is not one.pattern
    matrices = [np.asarray(each.matrix(np.asarray(SKIN.lame())).todense()) for each in (one, other)]
    assert not np.allclose(*matrices)  # of their own, in the same places
    gone = weakref.ref(one.pattern)
    del one
    assert gone() is other.pattern
    del other
    gc.collect()
    assert gone() is None


def test_linear_tetrahedra_know_no_difference() -> None:
    one, other = (cube_body(2, order=1, dilatation=form) for form in ("mean", "pointwise"))
    u = jax.random.normal(jax.random.key(2), one.nodes.shape)
    force = internal_force(other, SKIN.lame(), u)
    assert jnp.allclose(internal_force(one, SKIN.lame(), u), force, rtol=0, atol=1e-13 * jnp.abs(force).max())


def test_multigrid_solves_it() -> None:
    one = body(block((2.0, 1.0, 2.0), (4, 2, 4)), bone="held", dilatation="mean")
    load = jnp.zeros(one.nodes.shape).at[np.flatnonzero(np.asarray(one.nodes)[:, 1] < 1e-9), 1].set(1e-3)
    solution = displacement(one, MultigridCG(hierarchy(one)), SKIN, load)
    assert solution.converged and solution.iterations < 200


def test_an_unknown_form_is_refused() -> None:
    with pytest.raises(ValueError, match="choose one of pointwise, mean"):
        body(block(), bone="held", dilatation="constant")


def test_the_locking_table_has_a_row_for_each_form_and_mesh() -> None:
    """The quick one: errors against the finest quadratic mesh, linear elements locking and the mean dilatation not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(locking, "RATIOS", (0.3, 0.4999))
        figures = list(locking.main(True))
    error = {(one.figure, float(one.note.split()[-1])): one.value for one in figures}
    assert len(error) == 2 * 4
    assert error["P1, 1377 nodes", 0.4999] > 10 * error["P1, 1377 nodes", 0.3] > 50
    assert 0 < error["P2, 1377 nodes", 0.3] < error["P2, 1377 nodes", 0.4999] < 10
    assert abs(error["P2, mean dilatation, 1377 nodes", 0.4999]) < 5
    assert "| P1, 1377 nodes | +" in locking.page(figures)
