"""A rigid bone that the tissue carries: the same as a very stiff elastic one, whichever solver finds it, and differentiable."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from fingerjax.fem.body import Material, assemble_body, body, material, rigid_modes
from fingerjax.fem.carried import admissible
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.compliance import compliance, displacement
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.operator import internal_force
from fingerjax.fem.slopes import slopes
from fingerjax.fem.solver import MultigridCG, solver_for
from fingerjax.layers import BONE
from fingerjax.mesh.bodies import block

from .fem_tools import cube

TISSUE = {"epidermis": 0.18, "dermis": 0.018, "adipose": 0.012, "fibrous": 0.03}
SOLVERS = ["multigrid", "factorised"]


@pytest.fixture(scope="module")
def cut():
    """A cube with a bone in its middle and a nail on a part of its top: nodes, tets, layers, nail nodes and bone nodes."""
    nodes, tets = cube(3)
    centre = nodes[tets[:, :4]].mean(axis=1)
    layer = np.minimum((4 * centre[:, 1]).astype(int), 3)
    layer[np.all(np.abs(centre - 0.5) < 1 / 6, axis=1)] = BONE
    nail = (nodes[:, 1] > 1 - 1e-9) & (nodes[:, 2] < 0.4)
    bone = np.zeros(len(nodes), bool)
    bone[tets[layer == BONE]] = True
    return nodes, tets, layer, nail, bone


def without_bone(cut, *, held: bool):
    """The tissue around the bone, on the nodes that it uses."""
    nodes, tets, layer, nail, bone = cut
    used, soft = np.unique(tets[layer != BONE], return_inverse=True)
    nail, bone = nail[used], bone[used]
    none = np.zeros(len(used), bool)
    parts = nodes[used], soft.reshape(-1, 10), layer[layer != BONE]
    return assemble_body(*parts, nail | bone if held else nail, carried=none if held else bone)


def heights(body):
    """Columns: how high some nodes of the lower face stand."""
    face = np.flatnonzero(np.asarray(body.nodes)[:, 1] < 1e-9)
    face = face[np.lexsort(np.asarray(body.nodes)[face].T)][::7]
    shape = (3 * len(body.nodes), len(face))
    return columns_from_matrix(sp.csc_matrix((np.ones(len(face)), (3 * face + 1, np.arange(len(face)))), shape=shape))


@pytest.fixture(scope="module")
def carried(cut):
    return without_bone(cut, held=False)


@pytest.fixture(scope="module")
def columns(carried):
    return heights(carried)


def test_the_modes_are_the_six_rigid_motions(cut):
    nodes, bone = cut[0], cut[4]
    modes = rigid_modes(nodes, bone)
    flat = modes.reshape(6, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(6), atol=1e-12)
    assert np.all(modes[:, ~bone] == 0)
    turned = np.where(bone[:, None], np.cross([0.3, -0.2, 0.5], nodes - 2.0), 0.0).ravel()
    np.testing.assert_allclose(flat.T @ (flat @ turned), turned, atol=1e-12)
    assert rigid_modes(nodes, np.zeros(len(nodes), bool)).shape == (0, len(nodes), 3)


@pytest.mark.parametrize("kind", ["factorised", pytest.param("multigrid", marks=pytest.mark.slow)])
def test_a_rigid_bone_answers_as_a_very_stiff_elastic_one_and_a_held_one_does_not(cut, carried, columns, kind):
    nodes, tets, layer, nail, _ = cut
    condensed = eqx.filter_jit(compliance)(carried, solver_for(carried, kind), material(TISSUE), columns)
    assert condensed.converged and condensed.residual < 1e-8
    stiff = assemble_body(nodes, tets, layer, nail)
    elastic = compliance(stiff, solver_for(stiff, "factorised"), material(TISSUE, bone=1e6), heights(stiff))
    np.testing.assert_allclose(condensed.matrix, elastic.matrix, rtol=1e-5)
    held = without_bone(cut, held=True)
    still = eqx.filter_jit(compliance)(held, solver_for(held, kind), material(TISSUE), heights(held))
    assert np.trace(still.matrix) < 0.8 * np.trace(condensed.matrix)


@pytest.mark.parametrize("kind", SOLVERS)
def test_nothing_pushes_the_bone_but_the_tissue_around_it(carried, columns, kind):
    load = columns.loads()[2]
    found = displacement(carried, solver_for(carried, kind), material(TISSUE), load)
    assert found.converged
    u = found.displacement
    np.testing.assert_allclose(admissible(carried, u), u, atol=1e-12 * float(jnp.abs(u).max()))
    force = internal_force(carried, material(TISSUE).lame(), u)
    assert jnp.abs(jnp.einsum("mni,ni->m", carried.modes, force)).max() < 1e-7
    assert jnp.abs(carried.free[:, None] * (force - load)).max() < 1e-7


@pytest.mark.parametrize("kind", ["factorised", pytest.param("multigrid", marks=pytest.mark.slow)])
def test_derivatives_in_the_moduli_match_differences(carried, columns, kind):
    # Columns begin where they ended last, so that what is left of a residual differs between the two ends of a difference.
    solver = MultigridCG(hierarchy(carried), tolerance=1e-12) if kind == "multigrid" else solver_for(carried, kind)
    force = jnp.asarray(np.random.default_rng(1).normal(size=(2, columns.count)))
    E, nu = material(TISSUE).youngs_modulus, material(TISSUE).poisson_ratio

    def readings(x):
        return force @ solver.condense(carried, Material(E * jnp.exp(x), nu).lame(), columns).held.matrix

    directions = jnp.moveaxis(jax.jacfwd(lambda x: Material(E * jnp.exp(x), nu).lame())(jnp.zeros(5)), 2, 0)[:4]
    exact = slopes(solver.condense(carried, material(TISSUE).lame(), columns), carried, force, directions)
    h = 1e-3
    for layer in range(4):
        there, back = (readings(jnp.zeros(5).at[layer].set(step)) for step in (h, -h))
        np.testing.assert_allclose((there - back) / (2 * h), exact[:, layer], rtol=1e-5, atol=1e-6 * float(jnp.abs(exact).max()))


def test_an_unknown_bone_is_named():
    with pytest.raises(ValueError, match="unknown bone 'hard'"):
        body(block(), bone="hard")


def test_a_finger_that_nothing_holds_is_refused():
    with pytest.raises(ValueError, match="nothing holds"):
        body(block(), bone="rigid")
