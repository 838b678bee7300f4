"""How large the largest score gets when nothing is missing: one simulation for many effects, grids and signs at once.

    max over effects of the statistic of s sqrt(nu / chi2_nu) Q eps,   eps ~ N(0, I)

Westfall & Young (1993), max-T. The draws live on the rows, not on the effects, so that the order or the names of effects change nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from .score import Ranking, statistics

DRAWS, AT_ONCE = 12000, 2000


@dataclass(frozen=True, eq=False)
class Critical:
    """The law of the largest score.

    - `value`: exceeded with probability `alpha`; inf where nothing can be tested. `maxima`: the draws, rising.
    - `effective`: how many independent two-sided tests would need the same value.
    """

    alpha: float
    value: float
    maxima: Float[np.ndarray, "draws"]
    columns: int
    effective: float

    def p(self, statistic: float) -> float:
        """Probability of a largest score at least this large."""
        if self.maxima.size == 0:
            return 1.0
        above = self.maxima.size - int(np.searchsorted(self.maxima, statistic, side="left"))
        return (above + 1.0) / (self.maxima.size + 1.0)


def critical(ranking: Ranking, *, nu: float, alpha: float = 0.05, seed: int = 0, draws: int = DRAWS) -> Critical:
    """Simulate the largest score of all effects that can be tested; `nu` degrees of freedom tell the noise."""
    if not ranking.blocks:
        return Critical(alpha, math.inf, np.zeros(0), 0, 0.0)
    random = np.random.default_rng(seed)
    rows = ranking.blocks[0][1].shape[0]
    maxima = []
    for _ in range(draws // AT_ONCE):
        noise = random.standard_normal((rows, AT_ONCE))
        if math.isfinite(nu):
            noise /= np.sqrt(random.chisquare(nu, AT_ONCE) / nu)
        maxima.append(np.max([statistics(block, columns, noise) for columns, block in ranking.blocks], axis=0))
    found = np.sort(np.concatenate(maxima))
    value = float(np.quantile(found, 1.0 - alpha))
    return Critical(alpha, value, found, sum(block.shape[1] for _, block in ranking.blocks), _effective(value, nu, alpha))


def _effective(value: float, nu: float, alpha: float) -> float:
    one = 2.0 * float(stats.t.sf(value, nu) if math.isfinite(nu) else stats.norm.sf(value))
    return math.log1p(-alpha) / math.log1p(-one) if 0.0 < one < 1.0 else math.nan
