"""Nodes of a column mesh follow the thickness of its layers, and their derivatives agree with differences of whole meshes."""

from __future__ import annotations

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SAME_ARITHMETIC
from test_columns import skin

from fingerjax.errors import InputError
from fingerjax.geometry.presets import preset
from fingerjax.mesh import finger_from_columns
from fingerjax.mesh.columns import INSIDE, Columns, Rays, columns
from fingerjax.mesh.jacobian import determinants
from fingerjax.mesh.thickness import NodeMap, node_map


@cache
def made() -> Columns:
    """A structured column mesh of the monkey."""
    solid = preset("monkey")
    return columns(solid, *skin(solid))


def remade(factors: np.ndarray) -> Columns:
    """The same elements on layers so many times as thick, every interface found again by bisection."""
    rays, mesh = Rays(preset("monkey"), factors=tuple(float(f) for f in factors)), made()
    soft = mesh.t < INSIDE
    vertices = mesh.vertices.copy()
    vertices[soft] = rays.position(mesh.feet[soft], mesh.t[soft])
    return dataclasses.replace(mesh, rays=rays, vertices=vertices)


def test_unchanged_layers_give_the_meshed_nodes() -> None:
    mesh = made()
    moved = node_map(mesh).positions(jnp.ones(3))
    SAME_ARITHMETIC.check(moved, finger_from_columns(mesh, "").nodes)


def tangent(where: NodeMap, direction: np.ndarray) -> np.ndarray:
    return np.asarray(jax.jvp(where.positions, (jnp.ones(3),), (jnp.asarray(direction),))[1])


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 1.0, -1.0)])
def test_derivatives_agree_with_meshes_made_anew(direction: tuple[float, float, float]) -> None:
    """Interfaces found again on rays of the thicker and thinner finger, midsides too."""
    step = 1e-4
    ends = [remade(1.0 + sign * step * np.array(direction)) for sign in (1, -1)]
    nodes = [finger_from_columns(each, "").nodes for each in ends]
    mesh = made()
    where = node_map(mesh)
    slope = (nodes[0] - nodes[1]) / (2 * step)
    found = tangent(where, np.array(direction))
    # Elements that are pulled straight may be others where a layer changes: those midsides are left out.
    pulls = np.stack([node_map(each).pull for each in ends] + [where.pull])
    same = np.r_[np.ones(len(mesh.vertices), bool), np.ptp(pulls, axis=0) == 0]
    assert same.mean() > 0.98 and np.abs(found).max() > 0.1
    np.testing.assert_allclose(found[same], slope[same], atol=1e-7)


def test_skin_bone_and_cut_stay_and_the_adipose_tissue_gives_way() -> None:
    mesh = made()
    finger, where = finger_from_columns(mesh, ""), node_map(mesh)
    moved = np.asarray(where.positions(jnp.array([1.2, 0.9, 1.05])))
    still = np.zeros(len(moved), bool)
    still[finger.skin] = True
    still |= finger.bone
    SAME_ARITHMETIC.check(moved[still], finger.nodes[still])
    assert np.abs(moved[finger.proximal, 2]).max() == 0.0
    assert determinants(moved, finger.tets).min() > 0


def test_reverse_and_forward_derivatives_agree() -> None:
    where = node_map(made())
    weight = np.random.default_rng(0).normal(size=where.feet.shape)
    gradient = jax.grad(lambda f: jnp.sum(weight * where.positions(f)))(jnp.ones(3))
    forward = [np.sum(weight * tangent(where, axis)) for axis in np.eye(3)]
    np.testing.assert_allclose(gradient, forward, rtol=1e-10)


def test_layers_that_leave_no_adipose_tissue_are_refused() -> None:
    where = node_map(made())
    where.check(np.array([1.1, 1.1, 1.0]))
    with pytest.raises(InputError, match="no adipose tissue is left"):
        where.check(np.array([1.0, 8.0, 1.0]))
