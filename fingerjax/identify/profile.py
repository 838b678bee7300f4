"""Profile likelihood: how far a parameter can go before the data object, with all others free to make up for it.

    chi2_j(x) = min over the others of chi2, with parameter j held at x
    interval:   chi2_j(x) - chi2_min <= t^2 V_jj / (A^-1)_jj

`t` is the quantile of the fit (normal where noise is stated, else Student's), V its covariance and A^-1 the inverse curvature: 1 where all
noise is stated, s^2 where all of it is assumed, and the adjustment of Pace, Salvan & Sartori (2011) between. Where chi2_j never rises that
far the parameter is practically not identifiable (Raue et al. 2009), and which others follow it says why.

Each side is walked outwards in the signed root of the rise, which is straight for a linear model, so that two or three points are enough;
each point is a fit that starts where the last two lead to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..parameters import Parameter
from .fit import Fit, fit
from .uncertainty import VAGUE, Uncertainty, uncertainty

REACH = math.log(1000.0)  # of a log or logit parameter from its best value: farther nobody looks
CLOSE = 0.02  # share of t within which a point counts as the end
SHORT = 0.05  # and by how much of a logarithm the end may then still be corrected
POINTS = 14  # on one side
LEVEL = 1e-4  # relative gradient at which a point of the profile is level: chi2 is then right to its square
FIRST = 0.5  # step of a parameter without a standard error: of its logarithm, or of its size

FOUND, OPEN, LIMIT, FAILED = "found", "open", "limit", "failed"


@dataclass(frozen=True)
class Profile:
    """The profile of one parameter.

    - `raw` (k,): where it was held, rising; `root` (k,): signed root of the rise of chi2 over its scale: t at an end of the interval.
    - `others` (k, p): all raw parameters there.
    - `lower`, `upper`: ends of the interval in the parameter's unit; the limit where it stops there, NaN where it is open.
    - `ends`: of each side `found`, `open` (the data never object), `limit` (they had not when the limit came) or `failed`.
    - `evaluations`: runs of the model. `lower_chi2`: a value below the fit's own, if one was met on the way.
    """

    parameter: Parameter
    names: tuple[str, ...]
    raw: np.ndarray
    root: np.ndarray
    others: np.ndarray
    lower: float
    upper: float
    ends: tuple[str, str]
    t: float
    evaluations: int
    lower_chi2: float | None = None

    @property
    def bounded(self) -> bool:
        """Whether the data object on both sides."""
        return self.ends == (FOUND, FOUND)

    @property
    def identified(self) -> bool:
        """Bounded, and for what is positive to better than a factor of ten on both sides."""
        if not self.bounded or self.parameter.link != "log":
            return self.bounded
        best = float(self.parameter.natural(self.raw[int(np.argmin(np.abs(self.root)))]))
        return max(self.upper / best, best / self.lower) < math.exp(VAGUE)

    def rows(self) -> list[dict[str, object]]:
        """Tidy rows: parameter, value, root, t."""
        value = np.asarray(self.parameter.natural(self.raw))
        head: dict[str, object] = {"parameter": self.parameter.name}
        return [{**head, "value": float(v), "root": float(r), "t": self.t} for v, r in zip(value, self.root, strict=True)]

    def follows(self, least: float = 0.2) -> dict[str, float]:
        """Others that go along on the way: their change of raw value per that of this parameter, from end to end."""
        j = self.names.index(self.parameter.name)
        span = self.others[-1] - self.others[0]
        if span[j] == 0:
            return {}
        share = span / span[j]
        return {name: float(share[i]) for i, name in enumerate(self.names) if i != j and abs(share[i]) >= least}

    def verdict(self) -> str:
        """What the data say of this parameter, in one clause; practical non-identifiability by name."""
        low, high = self.ends
        name = self.parameter.name
        if FAILED in self.ends:
            return f"{name}: the profile could not be followed to its end"
        if self.identified:
            return f"{name} is identified"
        if self.bounded:
            span = f"{self.lower:.3g} to {self.upper:.3g} {self.parameter.unit}"
            return f"{name} is practically not identifiable: anything from {span} will do"
        along = ", ".join(f"{other} (by {share:+.2g} per unit of its own)" for other, share in self.follows().items())
        why = f", because {along} makes up for it" if along else ""
        if low != FOUND and high != FOUND:
            return f"{name} is practically not identifiable: no value is ruled out{why}"
        side, end = ("above", self.lower) if high != FOUND else ("below", self.upper)
        only = "at least" if high != FOUND else "at most"
        return f"{name} is practically not identifiable {side}: the data say only {only} {end:.3g} {self.parameter.unit}{why}"


Tell = Callable[[float, str], object]


def profiles(
    best: Fit, names: Sequence[str] | None = None, *, level: float = 0.95, tell: Tell = lambda share, doing: None
) -> tuple[Profile, ...]:
    """The profile of every parameter, or of those named.

    **Arguments:** `best`, a settled fit; `tell(share, what)` hears of the progress.

    **Raises** `ValueError` for a fit that is not settled, or an unknown name.
    """
    known = uncertainty(best, level=level)
    wanted = tuple(names) if names is not None else best.problem.names
    found = []
    for number, name in enumerate(wanted):
        tell(number / len(wanted), f"profile of {name}")
        found.append(profile(best, name, known=known))
    return tuple(found)


def profile(best: Fit, name: str, *, known: Uncertainty | None = None, level: float = 0.95) -> Profile:
    """The profile of one parameter at the end of a fit, as far as its interval of `level` goes."""
    if not best.settled:
        raise ValueError(f"the fit is not settled ({best.reason}): a profile needs an optimum to start from")
    if name not in best.problem.names:
        raise ValueError(f"no parameter {name!r}; there are {', '.join(best.problem.names)}")
    way = _Way(best, name, uncertainty(best, level=level) if known is None else known)
    sides = [way.walk(side) for side in (-1, 1)]
    order = np.argsort([raw for raw, *_ in way.points])
    raw, root, others = (np.array([point[k] for point in way.points])[order] for k in range(3))
    ends = [float(way.parameter.natural(end)) if math.isfinite(end) else math.nan for _, end in sides]
    return Profile(
        way.parameter, best.problem.names, raw, root, others, ends[0], ends[1], (sides[0][0], sides[1][0]),
        way.t, way.evaluations, way.lowest if way.lowest < best.chi2 - 1e-6 * max(best.chi2, 1.0) else None,
    )  # fmt: skip


class _Way:
    """One parameter's profile while it is walked."""

    def __init__(self, best: Fit, name: str, known: Uncertainty):
        self.best, self.name, self.t = best, name, known.t
        self.number = best.problem.names.index(name)
        self.parameter = best.problem.parameters[self.number]
        self.centre = float(best.raw[self.number])
        self.scale, self.step, self.tangent = self._scales(known)
        self.points: list[tuple[float, float, np.ndarray]] = [(self.centre, 0.0, best.raw)]
        self.evaluations, self.lowest = 0, best.chi2

    def _scales(self, known: Uncertainty) -> tuple[float, float, np.ndarray]:
        """Chi-square's scale, the first step, and how the others begin to follow."""
        j = self.number
        curvature, variance = known.unscaled[:, j], known.covariance[j, j]
        tangent = np.zeros(len(self.best.raw))
        tangent[j] = 1.0
        if not math.isfinite(curvature[j]):
            scales = known.covariance.diagonal() / known.unscaled.diagonal()
            usual = float(np.nanmedian(scales)) if np.isfinite(scales).any() else max(self.best.chi2 / max(self.best.dof, 1), 1e-12)
            size = FIRST if self.parameter.link != "identity" else FIRST * max(abs(self.centre), 1.0)
            return (1.0 if known.sigma == "stated" else usual), size, tangent
        tangent = np.where(np.isfinite(curvature), curvature / curvature[j], 0.0)
        return float(variance / curvature[j]), float(self.t * math.sqrt(variance)), tangent

    def walk(self, side: int) -> tuple[str, float]:
        """(how the side ended, raw value of its end): outwards until the root passes t, then between the last two points."""
        limit, last = self._limit(side)
        inner, outer, x = (0.0, 0.0), None, min(self.step, last)
        before = self.best.raw
        if not last > 0:
            return LIMIT, limit
        for number in range(POINTS):
            root, before = self._hold(side, x, before)
            if math.isnan(root) or not math.isfinite(x):
                return FAILED, math.nan
            if abs(root - self.t) <= CLOSE * self.t:
                near = inner if outer is None or x - inner[0] < outer[0] - x else outer
                left = (self.t - root) * (x - near[0]) / (root - near[1])
                if self.parameter.link == "identity" or abs(left) <= SHORT:
                    return FOUND, self.centre + side * (x + left)
            if root < self.t and x >= last:
                return (LIMIT, limit) if last == abs(limit - self.centre) else (OPEN, math.nan)
            inner, outer = ((x, root), outer) if root < self.t else (inner, (x, root))
            if outer is None:
                grown = inner[0] * float(np.clip(self.t / max(inner[1], 1e-9), 1.1, 4.0))
                x = min(grown, last)
            else:
                crooked = number % 3 == 2 or outer[1] > 4 * self.t
                x = 0.5 * (inner[0] + outer[0]) if crooked else _between(inner, outer, self.t)
        return (FAILED, math.nan) if outer is None else (FOUND, self.centre + side * _between(inner, outer, self.t))

    def _limit(self, side: int) -> tuple[float, float]:
        """(the raw limit on this side, how far one may go)."""
        ends = self.parameter.raw_limits() if self.parameter.link != "logit" else (-11.5, 11.5)
        limit = ends[0] if side < 0 else ends[1]
        if self.best.limits.get(self.name) == ("lower" if side < 0 else "upper"):
            return limit, 0.0
        far = REACH if self.parameter.link != "identity" else 1000 * self.step
        far = math.inf if self.name in self.best.limits else far  # from a plateau the data may be far away
        return limit, min(abs(limit - self.centre), far)

    def _hold(self, side: int, x: float, before: np.ndarray) -> tuple[float, np.ndarray]:
        """Root of the rise, and all raw values, with the parameter `x` away on one side."""
        at, moved = self.centre + side * x, before[self.number] - self.centre
        straight = (before - self.best.raw) / moved if moved != 0 else self.tangent
        start = self.best.raw + straight * (at - self.centre)
        found = fit(self.best.problem, start=start, hold={self.name: at}, gradient_tolerance=LEVEL, max_steps=40)
        self.evaluations += found.evaluations
        if not found.settled:
            return math.nan, before
        self.lowest = min(self.lowest, found.chi2)
        root = math.sqrt(max(found.chi2 - self.best.chi2, 0.0) / self.scale)
        self.points.append((at, side * root, found.raw))
        return root, found.raw


def _between(inner: tuple[float, float], outer: tuple[float, float], t: float) -> float:
    """Where the straight line between two points passes t."""
    share = (t - inner[1]) / (outer[1] - inner[1])
    return inner[0] + float(np.clip(share, 0.02, 0.98)) * (outer[0] - inner[0])
