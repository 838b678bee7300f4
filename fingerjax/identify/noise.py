"""How noisy each instrument is, where nobody said: from what the fit leaves of each, in turn with the fit.

    s_b^2 = |r_b|^2 / (n_b - tr H_bb),   H = J (J'J)^-1 J'         then the rows of b are weighed by 1/s_b and fitted again

until no s_b changes: the restricted maximum likelihood of independent blocks (Patterson & Thompson, Biometrika 58, 1971). Only measurements
whose noise is `assumed` are weighed anew; stated noise and that of replicates are taken at their word.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..forward.problem import Health, Problem
from .fit import Fit, fit

STEADY = 0.01  # relative change of every size at which they are left
ROUNDS = 12
FEWEST = 2.0  # degrees of freedom that a measurement must have left to tell its noise
FARTHEST = 1e3  # factor from the noise first assumed


class Weighed(eqx.Module):
    """Residuals with a `weight` (rows,) on each."""

    residuals: Callable[[Array], tuple[Array, Health]]
    weight: Float[Array, " rows"]

    def __call__(self, raw: Float[Array, " p"]) -> tuple[Float[Array, " rows"], Health]:
        residual, health = self.residuals(raw)
        return self.weight * residual, health


def weighed(problem: Problem, sizes: Mapping[str, float], rows: int) -> Problem:
    """The problem with the noise of each named measurement `sizes` times as large as it was taken to be."""
    weight = np.ones(rows)
    for name, size in sizes.items():
        weight[problem.blocks[name]] = 1.0 / size
    on, prepare = jnp.asarray(weight), problem.prepare
    residuals = Weighed(problem.residuals, on)
    if prepare is None:
        return dataclasses.replace(problem, residuals=residuals)
    return dataclasses.replace(problem, residuals=residuals, prepare=lambda raw: Weighed(prepare(raw), on))


def own_noise(found: Fit) -> dict[str, float]:
    """By measurement of assumed noise, the size of its residuals at the end of a fit, in units of what was assumed."""
    sizes = {}
    basis, _ = np.linalg.qr(found.jacobian)
    for name, rows in found.problem.blocks.items():
        residual = found.residual[rows]
        left = residual.size - float(np.sum(basis[rows] ** 2))
        if found.problem.sigma_source.get(name) == "assumed" and left >= FEWEST and np.any(residual != 0):
            sizes[name] = math.sqrt(float(residual @ residual) / left)
    return sizes


def with_own_noise(first: Fit) -> tuple[Fit, dict[str, float]]:
    """The fit in which every measurement of assumed noise has its own, and that noise in units of what was assumed.

    A fit that does not settle on the way, or sizes that do not, are handed back as they are: `Fit.settled` says so.
    """
    problem, found, sizes = first.problem, first, dict.fromkeys(own_noise(first), 1.0)
    for _ in range(ROUNDS):
        more = own_noise(found) if found.settled else {}
        if all(abs(math.log(size)) <= STEADY for size in more.values()):
            break
        sizes = {name: float(np.clip(sizes[name] * more.get(name, 1.0), 1 / FARTHEST, FARTHEST)) for name in sizes}
        found = fit(weighed(problem, sizes, first.residual.size), start=found.raw)
    return found, sizes
