"""Fits from many places: whether all starts end in one optimum, and if not, which start ends where.

Starts are spread over the raw parameters (logarithms of moduli) by a scrambled Sobol sequence, so that few of them cover many dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from ..forward.problem import Problem
from ..parameters import Parameter
from .fit import Fit, fit
from .workers import Remake, Tell, fits_at_once

SPREAD = 1.5 * math.log(10.0)  # of log and logit parameters to either side of their start
APART = 0.05  # raw distance over which two optima are two, unless chi2 is the same
SAME_CHI2 = 1e-4  # relative difference of chi2 within which optima are one where they are on a plateau


@dataclass(frozen=True)
class Basin:
    """One optimum: the best fit that ended there, and which starts did, by number."""

    best: Fit
    starts: tuple[int, ...]


@dataclass(frozen=True)
class Multistart:
    """Where every start ended.

    - `starts` (k, p): raw; the first is the study's own. `fits`: one for each.
    - `basins`: distinct optima, lowest chi2 first; starts that found none are in no basin.
    """

    starts: np.ndarray
    fits: tuple[Fit, ...]
    basins: tuple[Basin, ...]

    @property
    def best(self) -> Fit:
        """The lowest optimum; the first fit where no start found one."""
        return self.basins[0].best if self.basins else self.fits[0]

    @property
    def agree(self) -> bool:
        """Whether every start that found an optimum found the same."""
        return len(self.basins) == 1

    def rows(self) -> list[dict[str, object]]:
        """The basin map: start, basin (0 for none), chi2, result, start and end value of every parameter."""
        basin = {start: number for number, one in enumerate(self.basins, 1) for start in one.starts}
        found: list[dict[str, object]] = []
        for number, (raw, ended) in enumerate(zip(self.starts, self.fits, strict=True)):
            row: dict[str, object] = {"start": number + 1, "basin": basin.get(number, 0), "chi2": ended.chi2, "result": ended.result.name}
            for j, parameter in enumerate(ended.problem.parameters):
                row[f"from {parameter.name}"] = float(parameter.natural(raw[j]))
                row[f"to {parameter.name}"] = ended.best[parameter.name]
            found.append(row)
        return found

    def verdict(self) -> str:
        told = sum(len(one.starts) for one in self.basins)
        lost = len(self.fits) - told
        more = f"; {lost} found none" if lost else ""
        if not self.basins:
            return f"none of {len(self.fits)} starts found an optimum"
        if self.agree:
            return f"{told} of {len(self.fits)} starts end at one optimum{more}"
        each = ", ".join(f"{len(one.starts)} at chi2 {one.best.chi2:.4g}" for one in self.basins)
        return f"starts disagree: {len(self.basins)} optima, {each}{more}"


def multistart(
    problem: Problem,
    count: int = 8,
    *,
    seed: int = 0,
    spread: float = SPREAD,
    remake: Remake | None = None,
    workers: int = 1,
    tell: Tell = lambda share, doing: None,
) -> Multistart:
    """Fit from the problem's own start and from `count` - 1 others; several at once where there are `workers` and a way to `remake` it.

    **Arguments:** `spread` of log and logit parameters to either side of the start, as natural logarithm; identity parameters are spread
    over their limits where these are finite, else by their own size. `remake` makes the same problem in another process.
    """
    starts = _starts(problem, count, seed, spread)
    if remake is not None and workers > 1:
        there = fits_at_once(problem, remake, starts, workers, tell)
        return Multistart(starts, tuple(there), _basins(there))
    fits = []
    for number, start in enumerate(starts):
        tell(number / count, f"start {number + 1} of {count}")
        fits.append(fit(problem, start=start))
    return Multistart(starts, tuple(fits), _basins(fits))


def _starts(problem: Problem, count: int, seed: int, spread: float) -> np.ndarray:
    centre = problem.start()
    ends = np.array([_span(parameter, raw, spread) for parameter, raw in zip(problem.parameters, centre, strict=True)])
    power = max(1, math.ceil(math.log2(max(count, 2))))
    unit = qmc.Sobol(len(centre), rng=np.random.default_rng(seed)).random_base2(power)[: count - 1]
    return np.concatenate([centre[None], ends[:, 0] + unit * (ends[:, 1] - ends[:, 0])])[:count]


def _span(parameter: Parameter, raw: float, spread: float) -> tuple[float, float]:
    low, high = parameter.raw_limits()
    if parameter.link == "identity":
        size = max(abs(raw), 1.0)
        return (low if math.isfinite(low) else raw - size), (high if math.isfinite(high) else raw + size)
    return max(raw - spread, low), min(raw + spread, high)


def _basins(fits: list[Fit]) -> tuple[Basin, ...]:
    """Settled fits gathered by where they ended: near each other, or on one plateau."""
    order = sorted((number for number, one in enumerate(fits) if one.settled), key=lambda number: fits[number].chi2)
    gathered: list[list[int]] = []
    for number in order:
        home = next((group for group in gathered if _same(fits[group[0]], fits[number])), None)
        if home is None:
            gathered.append([number])
        else:
            home.append(number)
    return tuple(Basin(fits[group[0]], tuple(sorted(group))) for group in gathered)


def _same(one: Fit, other: Fit) -> bool:
    near = bool(np.max(np.abs(one.raw - other.raw)) <= APART)
    flat = abs(one.chi2 - other.chi2) <= SAME_CHI2 * max(one.chi2, 1.0)
    return near or (flat and bool(one.limits or other.limits))
