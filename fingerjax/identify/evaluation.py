"""One evaluation of the model: residuals, Jacobian and the health of every solve inside, out of one compiled pass."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..forward.problem import Health, Problem

STILL = 1e-9  # raw change below which a parameter did not move


@dataclass(frozen=True)
class Point:
    """The model at one raw vector.

    `fading` (p,), where it was reached from another point: parameters that lost sight of the data on the way, +1 upwards, -1 downwards.
    `plain`: the point as the model gave it, where its rows were weighed (`weighing`).
    """

    raw: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    converged: bool
    iterations: int
    solve_residual: float
    fading: np.ndarray | None = None
    plain: Point | None = None

    def reached_from(self, other: Point) -> Point:
        """This point, knowing which of its parameters fade."""
        moved = self.raw - other.raw
        before = np.zeros(len(moved)) if other.fading is None else other.fading
        with np.errstate(over="ignore", invalid="ignore"):
            fainter = np.linalg.norm(self.jacobian, axis=0) < np.linalg.norm(other.jacobian, axis=0)
        fading = np.where(np.abs(moved) <= STILL, before, np.sign(moved) * fainter)
        return dataclasses.replace(self, fading=fading)

    @property
    def usable(self) -> bool:
        return self.converged and bool(
            np.all(np.isfinite(self.residual)) and np.all(np.isfinite(self.jacobian))
        )

    @property
    def chi2(self) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            return float(self.residual @ self.residual)


@eqx.filter_jit
def linearise(residuals: Callable[[Array], tuple[Array, Health]], raw: Array) -> tuple[Array, Array, Health]:
    """Residuals, Jacobian and health in one pass.

    The tangents are pushed forward together with the one value that they share (`out_axes=None` insists on
    it). A `linearize` would do too, but runs a loop in the model twice: once for the value and once for the
    tangents.
    """

    def push(direction: Array) -> tuple[Array, Array, Health]:
        return jax.jvp(residuals, (raw,), (direction,), has_aux=True)

    return jax.vmap(push, out_axes=(None, 1, None))(jnp.eye(raw.size))


def evaluator(problem: Problem) -> Callable[[np.ndarray], Point]:
    """The model as a function of the raw vector, on the host.

    Compiled once per `problem.residuals`. Where that is a module (`equinox.Module`) with the data among its
    leaves, problems that differ in their data only share one compilation.
    """

    def evaluate(raw: np.ndarray) -> Point:
        at = jnp.asarray(raw)
        residuals = problem.residuals if problem.prepare is None else problem.prepare(at)
        residual, jacobian, health = jax.block_until_ready(linearise(residuals, at))
        return Point(
            raw,
            np.asarray(residual),
            np.asarray(jacobian),
            bool(health.converged),
            int(health.iterations),
            float(health.residual),
        )

    return evaluate


@eqx.filter_jit
def _read(residuals: Callable[[Array], tuple[Array, Health]], raw: Array) -> tuple[Array, Health]:
    return residuals(raw)


def residuals_at(problem: Problem, raw: np.ndarray) -> np.ndarray | None:
    """Residuals (rows,) alone, without derivatives; None where a solve inside failed or a number is not finite."""
    at = jnp.asarray(raw)
    residual, health = _read(problem.residuals if problem.prepare is None else problem.prepare(at), at)
    return np.asarray(residual) if bool(health.converged) and bool(np.all(np.isfinite(residual))) else None
