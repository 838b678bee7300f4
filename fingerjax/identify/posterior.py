"""Intervals from samples: where the parameters may lie, given the data, without taking the model for straight near its optimum.

    p(theta | data)  ~  exp(-chi2_s / 2) chi2_a^(-n_a / 2)        inside the limits

flat in the raw parameters, so in the logarithm of a modulus; `chi2_s` of the rows whose noise is known (and of priors), `chi2_a` of the n_a
rows whose noise was assumed, their common variance integrated out under Jeffreys' prior (Box & Tiao 1973, section 2.4). Where the model is
straight these are the linearised intervals.

Metropolis and Hastings, two proposals in turn (a cycle of kernels: Tierney, Ann. Stat. 22, 1994): a place drawn anew from Student's
distribution with the fit's own covariance, which hardly ever repeats itself where the problem is regular, and a step from where the
chain is, for where it is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .box import Box
from .evaluation import residuals_at
from .fit import Fit
from .uncertainty import uncertainty

TAILS = 5.0  # degrees of freedom of the places drawn anew: tails as heavy as any that one expects
STRIDE = 2.38  # over sqrt(p): the length of a step relative to the spread (Gelman, Roberts & Gilks 1996)
MIXED, ENOUGH = 1.1, 100.0  # split R-hat and effective draws between which and chains are believed

Tell = Callable[[float, str], object]


@dataclass(frozen=True)
class Posterior:
    """Chains of samples.

    - `raw` (chains, steps, p). `accepted`: share of proposals taken, of places drawn anew and of steps.
    - `evaluations`: runs of the model, without derivatives. `seed`: of every draw.
    """

    best: Fit
    raw: np.ndarray
    accepted: tuple[float, float]
    evaluations: int
    seed: int

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Ends of the central interval in the parameter's unit; NaN where the chains are not mixed."""
        j = self.best.problem.names.index(name)
        if not self.mixed:
            return math.nan, math.nan
        ends = np.quantile(self.raw[..., j], [0.5 - level / 2, 0.5 + level / 2])
        low, high = (float(self.best.problem.parameters[j].natural(end)) for end in ends)
        return low, high

    def covariance(self) -> np.ndarray:
        """(p, p) of the raw parameters."""
        return np.atleast_2d(np.cov(self.raw.reshape(-1, self.raw.shape[-1]).T))

    @property
    def effective(self) -> float:
        """How many independent samples tell as much, for the parameter of which they tell least."""
        return min(effective(self.raw[..., j]) for j in range(self.raw.shape[-1]))

    @property
    def apart(self) -> float:
        """Largest split R-hat: 1 where all halves of all chains agree."""
        return max(split_ratio(self.raw[..., j]) for j in range(self.raw.shape[-1]))

    @property
    def mixed(self) -> bool:
        """Whether the chains agree, and have enough samples for the ends of an interval."""
        return self.apart < MIXED and self.effective >= ENOUGH

    def verdict(self) -> str:
        """How far the samples can be believed, in one clause."""
        count = f"{self.raw.shape[0] * self.raw.shape[1]} samples, worth {self.effective:.0f} independent ones"
        return count if self.mixed else f"{count}: chains do not agree yet (split R-hat {self.apart:.2f}); take more steps"


def sample(best: Fit, *, steps: int = 250, chains: int = 4, seed: int = 0, tell: Tell = lambda share, doing: None) -> Posterior:
    """Sample around a settled fit; each step is one run of the model. A place whose solves fail is never taken.

    **Raises** `ValueError` for a fit that is not settled, has a parameter without an interval, or was made with a robust loss.
    """
    if not best.settled:
        raise ValueError(f"the fit is not settled ({best.reason}): there is nothing to sample around")
    if best.problem.loss != "linear":
        raise ValueError(f"samples need a likelihood, and the loss {best.problem.loss!r} is none: fit with squares")
    covariance = uncertainty(best).covariance
    lost = [name for name, size in zip(best.problem.names, np.diag(covariance), strict=True) if not math.isfinite(size)]
    if lost:
        raise ValueError(f"no interval for {', '.join(lost)}: fix or tie what the data do not see, then sample")
    walk = _Walk(best, np.linalg.cholesky(covariance), np.random.default_rng(seed))
    raw = np.zeros((chains, steps, len(covariance)))
    for chain in range(chains):
        place = walk.anew()
        while not math.isfinite(walk.density(place)):
            place = walk.anew()
        known = walk.density(place)
        for step in range(steps):
            tell((chain + step / steps) / chains, f"sample {chain * steps + step + 1} of {chains * steps}")
            place, known = walk.move(place, known, fresh=step % 2 == 0)
            raw[chain, step] = place
    taken = tuple(walk.taken[fresh] / max(walk.tried[fresh], 1) for fresh in (True, False))
    return Posterior(best, raw, (taken[0], taken[1]), walk.evaluations, seed)


class _Walk:
    """The two proposals around one fit."""

    def __init__(self, best: Fit, root: np.ndarray, random: np.random.Generator):
        self.best, self.root, self.random = best, root, random
        self.box = Box.around(best.problem.parameters)
        self.assumed = np.zeros(best.residual.size, bool)
        for block, rows in best.problem.blocks.items():
            self.assumed[rows] = best.problem.sigma_source.get(block) == "assumed"
        self.taken, self.tried, self.evaluations = {True: 0, False: 0}, {True: 0, False: 0}, 0
        self._last: tuple[np.ndarray, float] | None = None

    def density(self, raw: np.ndarray) -> float:
        """Logarithm of the posterior, up to a constant; -inf outside the limits and where a solve fails."""
        if np.any(raw < self.box.lower) or np.any(raw > self.box.upper):
            return -math.inf
        if self._last is not None and np.array_equal(self._last[0], raw):
            return self._last[1]
        self.evaluations += 1
        residual = residuals_at(self.best.problem, raw)
        found = -math.inf if residual is None else log_posterior(residual, self.assumed)
        self._last = (raw, found)
        return found

    def anew(self) -> np.ndarray:
        p = len(self.root)
        wide = math.sqrt(TAILS / self.random.chisquare(TAILS))
        return self.best.raw + wide * (self.root @ self.random.standard_normal(p))

    def _proposed(self, raw: np.ndarray) -> float:
        """Logarithm of the density with which `anew` gives a place."""
        away = np.linalg.solve(self.root, raw - self.best.raw)
        return -0.5 * (TAILS + len(raw)) * math.log1p(float(away @ away) / TAILS)

    def move(self, place: np.ndarray, known: float, fresh: bool) -> tuple[np.ndarray, float]:
        """One proposal, taken or not."""
        p = len(place)
        trial = self.anew() if fresh else place + STRIDE / math.sqrt(p) * (self.root @ self.random.standard_normal(p))
        there = self.density(trial)
        gain = there - known + (self._proposed(place) - self._proposed(trial) if fresh else 0.0)
        self.tried[fresh] += 1
        if math.log(self.random.uniform()) >= gain:
            return place, known
        self.taken[fresh] += 1
        return trial, there


def log_posterior(residual: np.ndarray, assumed: np.ndarray) -> float:
    """-chi2_s/2 - n_a/2 log chi2_a of whitened residuals (rows,)."""
    found = -0.5 * float(np.sum(residual[~assumed] ** 2))
    if assumed.any():
        found -= 0.5 * int(assumed.sum()) * math.log(float(np.sum(residual[assumed] ** 2)))
    return found


def effective(draws: np.ndarray) -> float:
    """Effective number of samples of one parameter (chains, steps): autocorrelation summed while its pairs are positive (Geyer 1992)."""
    chains, steps = draws.shape
    away = draws - draws.mean()
    whole = float(np.mean(away**2))
    if whole == 0:
        return 1.0
    spectrum = np.fft.rfft(away, 2 * steps, axis=1)
    lagged = np.fft.irfft(np.abs(spectrum) ** 2, axis=1)[:, :steps].mean(axis=0) / steps / whole
    pairs = lagged[: 2 * (steps // 2)].reshape(-1, 2).sum(axis=1)
    positive = pairs[: int(np.argmax(pairs <= 0))] if np.any(pairs <= 0) else pairs
    return float(min(chains * steps / max(2 * np.minimum.accumulate(positive).sum() - 1, 1e-3), chains * steps))


def split_ratio(draws: np.ndarray) -> float:
    """Split R-hat of one parameter (chains, steps): spread of all over that within halves of chains (Gelman et al. 2013, section 11.4)."""
    half = draws.shape[1] // 2
    halves = np.concatenate([draws[:, :half], draws[:, -half:]])
    within, between = float(halves.var(axis=1, ddof=1).mean()), half * float(halves.mean(axis=1).var(ddof=1))
    return math.sqrt((half - 1) / half + between / half / within) if within > 0 else math.inf
