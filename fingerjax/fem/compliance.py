"""What the body answers, reduced to the readings that matter: displacements under loads, and the condensed compliance of many columns.

    C = B' K(lambda, mu)^-1 B,        dC = - X' dK X   with   X = K^-1 B

The derivative in every modulus and Poisson ratio needs no further solve, because the readings and the loads are the same columns.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .body import Body, Material
from .carried import admissible
from .columns import Columns
from .krylov import Field, Solution
from .operator import Lame, internal_force
from .solver import AbstractSolver


class Compliance(eqx.Module):
    """Readings per unit load: `matrix` (m, m) = B' K^-1 B, and how well the solves behind it converged."""

    matrix: Float[Array, "m m"]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]


def compliance(body: Body, solver: AbstractSolver, material: Material, columns: Columns) -> Compliance:
    """Condense the body to the readings of `columns`; differentiable, forward and reverse, in the material."""
    matrix, iterations, residual, converged = _condensed(material.lame(), body, solver, columns)
    return Compliance(matrix, iterations, residual, converged)


def _influence(lame: Lame, body: Body, solver: AbstractSolver, columns: Columns) -> Solution:
    return solver.solve(body, jax.lax.stop_gradient(lame), columns.loads())


def _reduced(columns: Columns, solution: Solution) -> tuple[Array, Array, Array, Array]:
    matrix = columns.read(solution.displacement)
    symmetric = (matrix + matrix.T) / 2
    return symmetric, solution.iterations.max(), solution.residual.max(), solution.converged.all()


@eqx.filter_custom_jvp
def _condensed(lame: Lame, body: Body, solver: AbstractSolver, columns: Columns) -> tuple[Array, Array, Array, Array]:
    return _reduced(columns, _influence(lame, body, solver, columns))


@_condensed.def_jvp
def _condensed_jvp(primals: tuple, tangents: tuple) -> tuple:
    lame, body, solver, columns = primals
    solution = _influence(lame, body, solver, columns)
    out = _reduced(columns, solution)
    if tangents[0] is None:
        return out, (None, None, None, None)
    X = solution.displacement
    KX = jax.lax.map(lambda u: internal_force(body, tangents[0], u), X, batch_size=min(4, X.shape[0]))
    return out, (-jnp.einsum("mni,kni->mk", X, KX), None, None, None)


def displacement(body: Body, solver: AbstractSolver, material: Material, load: Field) -> Solution:
    """The displacement, mm, under nodal forces (n, 3), N; differentiable in the material and the load by the implicit rule."""
    lame = material.lame()

    def solve(_: object, right: Field) -> tuple[Field, tuple]:
        solution = solver.solve(body, jax.lax.stop_gradient(lame), right[None])
        return solution.displacement[0], (solution.iterations[0], solution.residual[0], solution.converged[0])

    u, (iterations, residual, converged) = jax.lax.custom_linear_solve(
        lambda v: _with_supports(body, lame, v), admissible(body, load), solve, symmetric=True, has_aux=True
    )
    return Solution(u, iterations, residual, converged)


def _with_supports(body: Body, lame: Lame, v: Field) -> Field:
    """The stiffness between admissible displacements and the identity on the rest, so that the operator can be inverted."""
    u = admissible(body, v)
    return admissible(body, internal_force(body, lame, u)) + (v - u)
