"""How large a misfit, and the largest score, get when nothing is missing: one simulation for many effects, grids, signs and blocks.

    eps ~ N(0, I), in each block times sqrt(nu_b / chi2_nu_b), as its noise is known from nu_b degrees of freedom only
    max over effects of the statistic of Q eps,     |P eps|^2 on what can be predicted, on what bends slowly, and on that
                                                    in which kinds of measurement may differ, of which the rarer one counts

Westfall & Young (1993), max-T. The draws live on the rows, not on the effects, so that the order or the names of effects change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy import stats

from .sample import Sample
from .score import Ranking, statistics

DRAWS = 10000


@dataclass(frozen=True, eq=False)
class Law:
    """What chance gives: draws, rising."""

    draws: Float[np.ndarray, "draws"]

    def p(self, statistic: float) -> float:
        """Probability of at least this much."""
        above = self.draws.size - int(np.searchsorted(self.draws, statistic, side="left"))
        return (above + 1.0) / (self.draws.size + 1.0)


@dataclass(frozen=True, eq=False)
class Rarest:
    """What chance gives of several statistics at once, of which the rarest counts.

    - `laws`: of each. `least`: of every draw its smallest p value, rising.
    """

    laws: tuple[Law, ...]
    least: Float[np.ndarray, "draws"]

    @classmethod
    def of(cls, draws: Sequence[Float[np.ndarray, "draws"]]) -> Rarest:
        laws = tuple(Law(np.sort(one)) for one in draws)
        pairs = zip(laws, draws, strict=True)
        each = [(1.0 + law.draws.size - np.searchsorted(law.draws, one)) / (law.draws.size + 1.0) for law, one in pairs]
        return cls(laws, np.sort(np.min(each, axis=0)) if each else np.zeros(0))

    def p(self, statistics: Sequence[float]) -> float:
        """Probability that one of them is at least as rare as the rarest of these; NaN where there is none."""
        if not self.laws:
            return math.nan
        rarest = min(law.p(one) for law, one in zip(self.laws, statistics, strict=True))
        return (float(np.searchsorted(self.least, rarest, side="right")) + 1.0) / (self.least.size + 1.0)


@dataclass(frozen=True, eq=False)
class Critical:
    """The laws of the tests.

    - `value`: of the largest score, exceeded with probability `alpha`; inf where no effect can be tested.
    - `largest`, `omnibus`, `smooth`, `agreement`: the laws. `effective`: how many independent two-sided tests would need the same `value`.
    """

    alpha: float
    value: float
    largest: Law
    omnibus: Law
    smooth: Law
    agreement: Rarest
    columns: int
    effective: float


def critical(
    sample: Sample,
    ranking: Ranking,
    predictable: Float[np.ndarray, "sample a"],
    smooth: Float[np.ndarray, "sample b"],
    splits: Sequence[Float[np.ndarray, "sample _"]] = (),
    *,
    alpha: float = 0.05,
    seed: int = 0,
) -> Critical:
    """Simulate the tests. **Arguments:** `predictable`, `smooth`, each of `splits`: orthonormal, and orthogonal to J."""
    noise = _chance(sample.size, tuple((tuple(members.tolist()), dof) for members, dof in sample.parts()), seed)
    laws = [Law(np.sort(draws)) for draws in (_maxima(ranking, noise), _squares(predictable, noise), _squares(smooth, noise))]
    value = float(np.quantile(laws[0].draws, 1.0 - alpha)) if ranking.blocks else math.inf
    columns = sum(block.shape[1] for _, block in ranking.blocks)
    agreement = Rarest.of([_squares(basis, noise) for basis in splits])
    return Critical(alpha, value, laws[0], laws[1], laws[2], agreement, columns, _effective(value, sample, alpha))


def _maxima(ranking: Ranking, noise: Float[np.ndarray, "sample draws"]) -> Float[np.ndarray, "some"]:
    if not ranking.blocks:
        return np.zeros(0)
    scores = np.concatenate([block for _, block in ranking.blocks], axis=1).T @ noise
    largest, start = np.zeros(noise.shape[1]), 0
    for columns, block in ranking.blocks:
        here = scores[start : start + block.shape[1]]
        largest = np.maximum(largest, statistics(columns, here, block.T @ block))
        start += block.shape[1]
    return largest


def _squares(basis: Float[np.ndarray, "sample k"], noise: Float[np.ndarray, "sample draws"]) -> Float[np.ndarray, "draws"]:
    return np.sum((basis.T @ noise) ** 2, axis=0)


@lru_cache(maxsize=1)
def _chance(rows: int, parts: tuple[tuple[tuple[int, ...], float], ...], seed: int) -> Float[np.ndarray, "rows draws"]:
    """The draws; the same for every look at one sample, so that they are kept."""
    random = np.random.default_rng(seed)
    noise = random.standard_normal((rows, DRAWS))
    for members, dof in parts:
        if math.isfinite(dof):
            noise[list(members)] /= np.sqrt(random.chisquare(dof, DRAWS) / dof)
    return noise


def _effective(value: float, sample: Sample, alpha: float) -> float:
    known = [dof for _, dof in sample.parts() if math.isfinite(dof)]
    one = 2.0 * float(stats.t.sf(value, sum(known)) if known else stats.norm.sf(value))
    return math.log1p(-alpha) / math.log1p(-one) if 0.0 < one < 1.0 else 0.0
