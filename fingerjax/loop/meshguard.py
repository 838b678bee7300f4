"""What the mesh adds to a residual: measured on one finer solve, taken out, and what may be left of it counted as noise.

    D = f_(s h) - f_h at the optimum,     f -> f + D,     Sigma_disc = rho^2 |D_i| |D_j| exp(-|x_i - x_j|^2 / 2)

with coordinates in thirds of their range, rows of two conditions of a block half as alike. An error that falls with the power p of the
element size leaves rho = s^p / (1 - s^p) of D: a quarter where the finer mesh has half the size. Small effects are not to be named where
what may be left could look like one:

    lambda = |Q L^-1 rho D|^2 <= 1   and   |J^+ L^-1 rho D| <= 0.2 standard deviations of every parameter

A misfit is the mesh's own where lambda is too large and an error twice as large as D would make as much of it: a mesh that converges in
first order leaves as much as D.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .refit import Optimum
from .subject import AbstractSubject, Evaluation, Rows
from .whitening import Projection

RHO = 0.25  # where the finer mesh has half the element size
ORDER = math.log2((1 + RHO) / RHO)
LEAST = 0.1  # of D may always be left
LARGEST_LAMBDA, LARGEST_SHIFT = 1.0, 0.2
REACH = 1.0 / 3.0  # length of the kernel, in ranges of a coordinate
ELSEWHERE = 0.5  # correlation between conditions of one block


@dataclass(frozen=True, eq=False)
class MeshGuard:
    """What is known of the mesh.

    - `offset` (rows,): D. `left` (rows, rows): Sigma_disc.
    - `reach`: misfit, in the noise alone, that an error of twice D would make, and `misfit` what there is above chance.
    - `excess`: lambda; `shift` (p,): of the raw parameters in standard deviations; `raw_shift` (p,): the same in raw numbers.
    """

    offset: Float[np.ndarray, "rows"]
    left: Float[np.ndarray, "rows rows"]
    excess: float
    shift: Float[np.ndarray, "p"]
    raw_shift: Float[np.ndarray, "p"]
    reach: float = 0.0
    misfit: float = 0.0
    rho: float = RHO
    checked: bool = True

    @property
    def passed(self) -> bool:
        return not self.checked or (self.excess <= LARGEST_LAMBDA and bool((np.abs(self.shift) <= LARGEST_SHIFT).all()))

    @property
    def blind(self) -> bool:
        """Whether what is left may look like an effect, or only like another value of a parameter."""
        return self.checked and self.excess > LARGEST_LAMBDA

    @property
    def guilty(self) -> bool:
        """Whether the mesh could have made all of the misfit."""
        return self.blind and self.misfit <= self.reach

    @property
    def gate(self) -> str:
        return "not checked" if not self.checked else "passed" if self.passed else "failed"

    @property
    def margin(self) -> float:
        """By how much a score must exceed its critical value, so that what is left of the mesh's error cannot have made it."""
        return 0.0 if self.passed else math.sqrt(max(self.excess, 0.0))


def unchecked(rows: int, p: int) -> MeshGuard:
    """Of a subject that has no finer mesh."""
    return MeshGuard(np.zeros(rows), np.zeros((rows, rows)), math.nan, np.full(p, math.nan), np.full(p, math.nan), checked=False)


def correction(
    subject: AbstractSubject, raw: Float[np.ndarray, "p"], phi: Mapping[str, float], here: Evaluation | None = None
) -> Float[np.ndarray, "rows"] | None:
    """D at a point, where the model is `here`; None where there is no finer mesh, or one of the two gave no answer."""
    finer = subject.finer(raw, phi)
    if finer is None or not np.isfinite(finer).all():
        return None
    here = subject.evaluate(raw, phi, ()) if here is None else here
    return np.asarray(finer, dtype=float) - here.prediction if here.usable else None


def share_left(refinement: float) -> float:
    """rho, from the element size of the finer mesh over that of the mesh."""
    return max(1.0 / (refinement**-ORDER - 1.0), LEAST)


def leftover(rows: Rows, offset: Float[np.ndarray, "rows"], rho: float = RHO) -> Float[np.ndarray, "rows rows"]:
    """Sigma_disc, block by block."""
    whole = np.zeros((len(rows), len(rows)))
    for name, where in rows.blocks.items():
        condition = rows.condition[where]
        alike = np.where(condition[:, None] == condition, 1.0, ELSEWHERE)
        for values in rows.coordinates.get(name, {}).values():
            span = float(np.ptp(values))
            place = np.asarray(values, dtype=float) / (REACH * span) if span > 0 else np.zeros(len(condition))
            alike = alike * np.exp(-0.5 * (place[:, None] - place) ** 2)
        size = rho * np.abs(offset[where])
        whole[where, where] = np.outer(size, size) * alike
    return whole


def guard(best: Optimum, offset: Float[np.ndarray, "rows"], left: Float[np.ndarray, "rows rows"], rho: float = RHO) -> MeshGuard:
    """How far what may be left of the mesh's error reaches, at an optimum of the sample that has both in it."""
    sample, p = best.sample, len(best.raw)
    whitened = sample.columns(rho * offset[:, None])[:, 0]
    raw = (best.projection.inverse @ whitened)[:p]
    sd = np.sqrt(np.diag(best.projection.covariance()))[:p]
    shift = np.divide(raw, sd, out=np.zeros(p), where=sd > 0)
    bare = sample.corrected(offset, -left)
    projection = Projection.of(bare.jacobian(best.at, best.raw))
    reach = 4.0 * float(np.sum(projection(bare.columns(offset[:, None])[:, 0]) ** 2))
    residual = projection(bare.residual(best.at, best.raw))
    misfit = float(np.sum(residual**2)) - (residual.size - projection.rank)
    return MeshGuard(offset, left, float(np.sum(best.projection(whitened) ** 2)), shift, raw, reach, misfit, rho)
