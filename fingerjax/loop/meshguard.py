"""What the mesh adds to a residual: measured on one finer solve, taken out, and what may be left of it counted as noise.

    D = f_(s h) + H - f_h at the optimum,     f -> f + D,     Sigma_disc = a_i a_j exp(-|x_i - x_j|^2 / 2),     a^2 = (rho D)^2 + H^2 / 3

with coordinates in thirds of their range, which for a depth, a travel and a force begins at contact: a stage that creeps in a hold does not
make another state of it. Rows of two set-ups of a block are half as alike. Time is not among the coordinates: what an elastic body reads at
one depth has the same error whenever it is read. An error that falls with the power p of the element size leaves
rho = s^p / (1 - s^p) of D: a quarter where the finer mesh has half the size. Near incompressibility elements are too stiff and it falls
more slowly; others are too soft, H is half of the way from the ones to the others on the finer mesh, and the truth is taken to lie
anywhere between (JCGM 100:2008, 4.3.7). Small effects are not to be named where what may be left could look like one:

    lambda = |Q L^-1 rho D|^2 + |Q L^-1 H|^2 / 3 <= 1   and   the root of the like sum of J^+ L^-1 rho D <= 0.2 standard deviations

A misfit is the mesh's own where lambda is too large, an error twice as large as D would make as much of it, since a mesh that converges in
first order leaves as much as D where s is a half, and at least half of it looks like D and H. A mesh so coarse that what is expected to be
left would pass for an effect, were it not counted as noise, may err in another shape at every size of element: there any misfit is its own
that is no larger than D and H would make, or s / (1 - s) of them where that is more, what first order leaves; unless an effect explains it.
Where the gate fails an effect is named only if it explains more than chance and what may be left together: its score must exceed the
critical value by what the remainder, of the shape of D and H, would score for it. The smallest effect that would have been seen is larger
by as much. Where nothing is missed, and the remainder without Sigma_disc in the noise would pass the critical value, nothing is said: with
it in the noise data of such a mesh fit whatever they miss, and lambda, which has it there, counts no more than the settings that it drowns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import lsq_linear

from .refit import Optimum
from .sample import Sample
from .subject import AbstractSubject, Evaluation, Rows
from .whitening import Projection

RHO = 0.25  # where the finer mesh has half the element size
ORDER = math.log2((1 + RHO) / RHO)
LEAST = 0.1  # of D may always be left
BETWEEN = math.sqrt(1.0 / 3.0)  # standard deviation of what lies anywhere between -1 and 1
LARGEST_LAMBDA, LARGEST_SHIFT = 1.0, 0.2
TWICE = 2.0  # what a mesh may leave at the worst, in D and in H
ALIKE = 0.5  # share of a misfit that looks like the mesh's error, from which on the mesh may have made all of it
REACH = 1.0 / 3.0  # length of the kernel, in ranges of a coordinate
ELSEWHERE = 0.5  # correlation between set-ups of one block
TIME = "time"  # the coordinate in which no mesh errs
FROM_CONTACT = ("depth", "displacement", "force")  # coordinates that are zero where a finger is touched first


@dataclass(frozen=True, eq=False)
class Correction:
    """What finer meshes add to a prediction: `offset` (rows,), D, and `softness` (rows,), H, zero where no softer elements are known."""

    offset: Float[np.ndarray, "rows"]
    softness: Float[np.ndarray, "rows"]

    def left(self, rows: Rows, rho: float = RHO) -> Float[np.ndarray, "rows rows"]:
        """Sigma_disc, block by block."""
        whole = np.zeros((len(rows), len(rows)))
        for name, where in rows.blocks.items():
            setup = rows.setups[where]
            alike = np.where(setup[:, None] == setup, 1.0, ELSEWHERE)
            for along, values in rows.coordinates.get(name, {}).items():
                if along == TIME:
                    continue
                ends = (*values, 0.0) if along in FROM_CONTACT else values
                span = float(np.ptp(ends))
                place = np.asarray(values, dtype=float) / (REACH * span) if span > 0 else np.zeros(len(setup))
                alike = alike * np.exp(-0.5 * (place[:, None] - place) ** 2)
            size = np.hypot(rho * self.offset[where], self.softness[where] * BETWEEN)
            whole[where, where] = np.outer(size, size) * alike
        return whole


@dataclass(frozen=True, eq=False)
class MeshGuard:
    """What is known of the mesh.

    - `offset` (rows,): D. `left` (rows, rows): Sigma_disc.
    - `reach`: misfit, in the noise alone, that an error of twice D would make, `misfit` what there is above chance, and `alike` the share
      of that which D and H would take away.
    - `remainder` (sample, 2): Q L^-1 rho D and Q L^-1 H / sqrt 3. `excess`: lambda. `drowned`: the same in the noise alone.
    - `shift` (p,): of the raw parameters in standard deviations; `raw_shift` (p,): the same in raw numbers.
    """

    offset: Float[np.ndarray, "rows"]
    left: Float[np.ndarray, "rows rows"]
    excess: float
    shift: Float[np.ndarray, "p"]
    raw_shift: Float[np.ndarray, "p"]
    reach: float = 0.0
    misfit: float = 0.0
    alike: float = 1.0
    rho: float = RHO
    checked: bool = True
    drowned: float = 0.0
    remainder: Float[np.ndarray, "sample 2"] | None = None

    @property
    def passed(self) -> bool:
        return not self.checked or (self.excess <= LARGEST_LAMBDA and bool((np.abs(self.shift) <= LARGEST_SHIFT).all()))

    @property
    def blind(self) -> bool:
        """Whether what is left may look like an effect, or only like another value of a parameter."""
        return self.checked and self.excess > LARGEST_LAMBDA

    def hides(self, critical: float) -> bool:
        """Whether what is left, which is counted as noise, could hide an effect whose score chance does not reach."""
        return self.checked and self.drowned > critical**2

    def guilty(self, critical: float) -> bool:
        """Whether the mesh could have made all of the misfit."""
        looks_like_it = self.blind and self.misfit <= self.reach and self.alike >= ALIKE
        return looks_like_it or (self.hides(critical) and self.misfit <= self.as_first_order)

    @property
    def as_corrected(self) -> float:
        """Misfit, in the noise alone, that an error of D would make."""
        return self.reach / TWICE**2

    @property
    def as_first_order(self) -> float:
        """Misfit, in the noise alone, of what an error leaves that falls with the first power of the element size; at least that of D."""
        size = (self.rho / (1.0 + self.rho)) ** (1.0 / ORDER)  # of an element of the finer mesh, as `share_left` has it
        return max(1.0, size / (1.0 - size)) ** 2 * self.as_corrected

    @property
    def gate(self) -> str:
        return "not checked" if not self.checked else "passed" if self.passed else "failed"

    def margin(self, direction: Float[np.ndarray, "sample"]) -> float:
        """By how much the score of an effect must exceed its critical value, so that what is left of the mesh's error cannot have made it.

        **Arguments:** `direction`: its trace as a unit vector, projected.
        """
        return 0.0 if self.passed or self.remainder is None else float(np.linalg.norm(direction @ self.remainder))


def unchecked(rows: int, p: int) -> MeshGuard:
    """Of a subject that has no finer mesh."""
    return MeshGuard(np.zeros(rows), np.zeros((rows, rows)), math.nan, np.full(p, math.nan), np.full(p, math.nan), checked=False)


def correction(
    subject: AbstractSubject, raw: Float[np.ndarray, "p"], phi: Mapping[str, float], here: Evaluation | None = None
) -> Correction | None:
    """D at a point, where the model is `here`; None where there is no finer mesh, or one of the two gave no answer."""
    finer = subject.finer(raw, phi)
    if finer is None or not np.isfinite(finer).all():
        return None
    here = subject.evaluate(raw, phi, ()) if here is None else here
    if not here.usable:
        return None
    half = subject.softness(raw, phi)
    half = np.zeros(len(finer)) if half is None or not np.isfinite(half).all() else np.asarray(half, dtype=float)
    return Correction(np.asarray(finer, dtype=float) + half - here.prediction, half)


def drift(known: Correction, sample: Sample, before: Evaluation, now: Evaluation) -> float:
    """By how many standard errors of all rows together a correction made at one point is expected to differ at another: it is taken to be
    as large a share of the change of the prediction as of the whole.
    """
    changed, offset, whole = (
        float(np.linalg.norm(sample.columns(each[:, None]))) for each in (now.prediction - before.prediction, known.offset, now.prediction)
    )
    return changed * offset / whole if whole > 0 else 0.0


def share_left(refinement: float) -> float:
    """rho, from the element size of the finer mesh over that of the mesh."""
    return max(1.0 / (refinement**-ORDER - 1.0), LEAST)


def guard(best: Optimum, known: Correction, rho: float = RHO) -> MeshGuard:
    """How far what may be left of the mesh's error reaches, at an optimum of the sample that has both in it."""
    sample, p = best.sample, len(best.raw)
    may_be = np.stack([rho * known.offset, BETWEEN * known.softness], axis=1)
    whitened = sample.columns(may_be)
    raw = (best.projection.inverse @ whitened)[:p]
    raw = np.where(np.abs(raw[:, 0]) >= np.abs(raw[:, 1]), np.sign(raw[:, 0]), np.sign(raw[:, 1])) * np.hypot(*raw.T)
    sd = np.sqrt(np.diag(best.projection.covariance()))[:p]
    shift = np.divide(raw, sd, out=np.zeros(p), where=sd > 0)
    left = known.left(sample.subject.rows, rho)
    bare = sample.corrected(known.offset, -left)
    projection = Projection.of(bare.jacobian(best.at, best.raw))
    reach = TWICE**2 * _size(projection, bare.columns(np.stack([known.offset, BETWEEN * known.softness], axis=1)))
    residual = projection(bare.residual(best.at, best.raw))
    misfit = float(np.sum(residual**2)) - (residual.size - projection.rank)
    alike = _taken(projection(bare.columns(np.stack([known.offset, known.softness], axis=1))), residual) / max(misfit, 1.0)
    remainder, drowned = best.projection(whitened), _size(projection, bare.columns(may_be))
    excess = float(np.sum(remainder**2))
    return MeshGuard(known.offset, left, excess, shift, raw, reach, misfit, alike, rho, drowned=drowned, remainder=remainder)


def _taken(columns: Float[np.ndarray, "sample k"], residual: Float[np.ndarray, "sample"]) -> float:
    """The fall of a sum of squares that columns bring, each at most twice."""
    return float(residual @ residual - 2.0 * lsq_linear(columns, residual, bounds=(-TWICE, TWICE)).cost)


def _size(projection: Projection, columns: Float[np.ndarray, "rows k"]) -> float:
    return float(sum(np.sum(projection(column) ** 2) for column in columns.T))
