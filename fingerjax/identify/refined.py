"""A fit on one mesh brought to where finer meshes would put it, and what of the mesh's error is left in it.

    d = r_fine(theta) - r(theta),        theta <- argmin |r + d|^2        until theta no longer moves

The defect d is computed at few places on the fine mesh; every step of the fit stays on the coarse one (defect correction: Stetter,
Numer. Math. 29, 1978). The answer is that of the fine mesh, and so are profiles, repeats and samples of the corrected problem, as far as
the defect stays as it is.

Elements that are too stiff and elements that are too soft enclose what both would reach on a mesh fine enough. Where the finest mesh is
there with softer ones too, the fit is corrected to the middle between the two. What may lie anywhere between two ends has a third of its
squared half-width for variance (Guide to the Expression of Uncertainty in Measurement, JCGM 100:2008, 4.3.7).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..forward.problem import Health, Problem
from .evaluation import residuals_at
from .fit import Fit, fit
from .uncertainty import uncertainty

STILL = 0.05  # standard errors by which a correction may still move a parameter
ROUNDS = 6  # on each mesh


class Corrected(eqx.Module):
    """Residuals on one mesh, with the `defect` (rows,) that another mesh adds to them."""

    residuals: Callable[[Array], tuple[Array, Health]]
    defect: Float[Array, " rows"]

    def __call__(self, raw: Float[Array, " p"]) -> tuple[Float[Array, " rows"], Health]:
        residual, health = self.residuals(raw)
        return residual + self.defect, health


@dataclass(frozen=True)
class Refined:
    """A fit corrected to finer and finer meshes.

    - `fits`: the one on the coarse mesh, then one for each finer mesh and one for the softer elements, all on the coarse mesh's elements.
    - `shifts` (meshes, p): by how much each finer mesh moved the raw parameters.
    - `softened` (p,): by how much half the way to softer elements moved them on the finest mesh, None where there were none.
    """

    fits: tuple[Fit, ...]
    shifts: np.ndarray
    softened: np.ndarray | None = None

    @property
    def best(self) -> Fit:
        """The fit with the finest mesh's readings, half-way to those of its softer elements where they are known."""
        return self.fits[-1]

    @property
    def spread(self) -> np.ndarray:
        """(p, p) covariance of what the finest mesh leaves: as if one more mesh could move all parameters together by its own shift.

        With two finer meshes or more, by that shift times the ratio in which the last two fell, which is the whole of what is left where
        they go on so: a geometric row. To that comes the move to softer elements.
        """
        last = self.shifts[-1]
        if len(self.shifts) > 1:
            fell = float(np.linalg.norm(last)) / max(float(np.linalg.norm(self.shifts[-2])), 1e-300)
            last = last * (fell / (1 - fell) if fell < 0.5 else 1.0)
        left = np.outer(last, last)
        return left if self.softened is None else left + np.outer(self.softened, self.softened) / 3


def corrected(problem: Problem, defect: np.ndarray) -> Problem:
    """The problem with a defect (rows,) added to its residuals."""
    added, prepare = jnp.asarray(defect), problem.prepare
    residuals = Corrected(problem.residuals, added)
    if prepare is None:
        return dataclasses.replace(problem, residuals=residuals)
    return dataclasses.replace(problem, residuals=residuals, prepare=lambda raw: Corrected(prepare(raw), added))


def refined(
    best: Fit, finer: Sequence[Problem], *, softer: Problem | None = None, tell: Callable[[float, str], object] = lambda share, doing: None
) -> Refined:
    """Correct a settled fit to each of `finer`, the same problem on finer meshes, the coarsest of them first.

    **Arguments:** `softer`: the last of these problems with softer elements (`dilatation="mean"`).

    A correction that does not settle ends the row there; so does a finer mesh whose solves fail.

    **Raises** `ValueError` for a fit that is not settled, or a finer problem with other parameters.
    """
    if not best.settled:
        raise ValueError(f"the fit is not settled ({best.reason}): there is nothing to correct")
    fits, shifts = [best], []
    count = len(finer) + (softer is not None)
    for number, problem in enumerate((*finer, *([] if softer is None else [softer]))):
        if problem.names != best.problem.names:
            raise ValueError(f"the finer problem fits {', '.join(problem.names)}, not {', '.join(best.problem.names)}")
        of_last = number == len(finer)
        tell(number / count, "correcting to softer elements" if of_last else f"correcting to mesh {number + 1} of {len(finer)}")
        found = _corrected_to(best.problem, (finer[-1], problem) if of_last else (problem,), fits[-1])
        if found is None:
            break
        shifts.append(found.raw - fits[-1].raw)
        fits.append(found)
    moved = np.array(shifts).reshape(-1, best.raw.size)
    whole = softer is not None and len(moved) == count
    return Refined(tuple(fits), moved[:-1], moved[-1]) if whole else Refined(tuple(fits), moved)


def _corrected_to(coarse: Problem, fine: tuple[Problem, ...], begun: Fit) -> Fit | None:
    """The fit with the mean of what several problems read."""
    found = begun
    for _ in range(ROUNDS):
        here, *there = (residuals_at(problem, found.raw) for problem in (coarse, *fine))
        known = [each for each in there if each is not None]
        if here is None or len(known) < len(there):
            return None
        before, found = found.raw, fit(corrected(coarse, np.mean(known, axis=0) - here), start=found.raw)
        if not found.settled:
            return None
        error = np.sqrt(np.diag(uncertainty(found).covariance))
        if np.all(np.abs(found.raw - before) <= STILL * np.where(np.isfinite(error), error, np.inf)):
            return found
    return None
