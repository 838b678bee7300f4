"""Intervals from repeats: the fit made again on data that might as well have been measured.

- `parametric`: readings of the best model plus new noise of the size that the fit believes in. Right where the model is.
- `case`: whole cases (rows, or the groups handed in: an indentation, a trial) drawn with replacement. It takes neither the model nor the
  noise at its word, but needs many cases.

Efron & Tibshirani, An Introduction to the Bootstrap (1993), chapters 6, 9 and 13. Every repeat starts at the best fit and shares its
compiled program: only the rows are weighed anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from .fit import Fit, fit
from .uncertainty import Uncertainty, uncertainty
from .weighing import AbstractWeighing, Counted, Redrawn

KINDS = ("parametric", "case")
LEVEL = 1e-4  # relative gradient of a repeat
FEWEST_CASES = 5  # in a measurement, below which its rows are drawn one by one
REGULAR = 0.15  # by which widths of intervals may differ before a problem is called irregular

Tell = Callable[[float, str], object]


@dataclass(frozen=True)
class Bootstrap:
    """Repeats of a fit.

    - `raw` (repeats, p): where each that settled ended. `failed`: how many did not.
    - `seed`: of every draw.
    """

    best: Fit
    kind: str
    raw: np.ndarray
    failed: int
    seed: int

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Ends of the percentile interval in the parameter's unit; NaN with fewer than twenty repeats."""
        j = self.best.problem.names.index(name)
        if len(self.raw) < 20:
            return math.nan, math.nan
        ends = np.quantile(self.raw[:, j], [0.5 - level / 2, 0.5 + level / 2])
        low, high = (float(self.best.problem.parameters[j].natural(end)) for end in ends)
        return low, high

    def covariance(self) -> np.ndarray:
        """(p, p) of the raw parameters."""
        return np.atleast_2d(np.cov(self.raw.T))


def bootstrap(
    best: Fit,
    *,
    kind: str = "parametric",
    repeats: int = 200,
    seed: int = 0,
    cases: Mapping[str, np.ndarray] | None = None,
    tell: Tell = lambda share, doing: None,
) -> Bootstrap:
    """Fit `repeats` times again, from the best fit on.

    **Arguments:** `cases` gives, by measurement, a label (rows,) for each row: rows of one label are drawn together.

    **Raises** `ValueError` for an unknown kind, or a fit that is not settled.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of bootstrap {kind!r}; choose {' or '.join(KINDS)}")
    if not best.settled:
        raise ValueError(f"the fit is not settled ({best.reason}): nothing can be repeated around it")
    random, known = np.random.default_rng(seed), uncertainty(best)
    draw = _parametric(best, known) if kind == "parametric" else _cases(best, cases or {})
    kept, failed = [], 0
    for number in range(repeats):
        tell(number / repeats, f"{kind} bootstrap {number + 1} of {repeats}")
        found = fit(best.problem, start=best.raw, weighing=draw(random), gradient_tolerance=LEVEL, max_steps=40)
        kept += [found.raw] if found.settled else []
        failed += not found.settled
    return Bootstrap(best, kind, np.array(kept).reshape(-1, best.raw.size), failed, seed)


def _parametric(best: Fit, known: Uncertainty) -> Callable[[np.random.Generator], AbstractWeighing]:
    """New noise for every row; where sigma was assumed, of the size that the residuals have."""
    assumed = np.zeros(best.residual.size, bool)
    for block, rows in best.problem.blocks.items():
        assumed[rows] = best.problem.sigma_source.get(block) == "assumed"
    size = np.ones(best.residual.size)
    if known.noise_dof > 0 and math.isfinite(known.noise_dof):
        size[assumed] = math.sqrt(float(np.sum(best.residual[assumed] ** 2)) / known.noise_dof)
    return lambda random: Redrawn(best.residual + size * random.standard_normal(best.residual.size))


def _cases(best: Fit, cases: Mapping[str, np.ndarray]) -> Callable[[np.random.Generator], AbstractWeighing]:
    blocks = {name: rows for name, rows in best.problem.blocks.items() if name != "prior"}

    def draw(random: np.random.Generator) -> AbstractWeighing:
        weight = np.ones(best.residual.size)
        for name, rows in blocks.items():
            _, label = np.unique(labels_of(cases.get(name), rows.stop - rows.start), return_inverse=True)
            count = np.bincount(random.integers(0, label.max() + 1, label.max() + 1), minlength=label.max() + 1)
            weight[rows] = count[label]
        return Counted(weight)

    return draw


def labels_of(labels: np.ndarray | None, rows: int) -> np.ndarray:
    """The labels of a measurement's cases, or one for each row where there are too few of them to draw from."""
    if labels is None or len(np.unique(labels)) < FEWEST_CASES:
        return np.arange(rows)
    return np.asarray(labels)


def agreement(known: Uncertainty, name: str, low: float, high: float) -> float:
    """Width of an interval over that of the linearised one, both on the scale that the parameter was fitted on; 1 in a regular problem."""
    one = known[name]
    if one.lower > 0 and low > 0:
        return math.log(high / low) / math.log(one.upper / one.lower)
    return (high - low) / (one.upper - one.lower)
