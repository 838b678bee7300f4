"""Where the parameters of a fit may go: their limits, the longest step, and plateaus on which none should be taken."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..parameters import Parameter
from .evaluation import Point

LARGEST_CHANGE = 3.0  # of a log or logit parameter in one step: a factor of twenty
LAST_LOGIT = 11.5  # raw limits of a logit parameter: 1e-5 of its span from either end
PERFECT = 1e-3  # residuals of this many sigma count as perfect: a smaller one is not worth a step
FAINT = 0.03  # sigma by which a factor e in a parameter moves all residuals together, below which it is left where it is


@dataclass(frozen=True)
class Box:
    """The raw limits. A logit parameter stops just short of its own, where its slope is still a number."""

    lower: np.ndarray
    upper: np.ndarray
    largest_change: np.ndarray
    linked: np.ndarray

    @classmethod
    def around(cls, parameters: tuple[Parameter, ...]) -> Box:
        bounds = [_raw_limits(parameter) for parameter in parameters]
        linked = np.array([parameter.link != "identity" for parameter in parameters])
        change = np.where(linked, LARGEST_CHANGE, math.inf)
        return cls(np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds]), change, linked)

    def pinched(self, where: dict[int, float]) -> Box:
        """The box in which some parameters, by number, stay at a raw value."""
        lower, upper = self.lower.copy(), self.upper.copy()
        for number, raw in where.items():
            lower[number] = upper[number] = raw
        return replace(self, lower=lower, upper=upper)

    def idle(self, point: Point) -> np.ndarray:
        """(p,) bool: parameters that no step should move, for they are at a limit or too faint to be seen from here."""
        return self.held(point) | self.faint(point)

    def faint(self, point: Point) -> np.ndarray:
        """(p,) bool: log and logit parameters on a plateau, whose optimum would lie at infinity if they were followed.

        They faded on the way here, and by now a factor e in one of them changes all residuals together by less than `FAINT` of their
        own spread. Looked at anew at every point.
        """
        if point.fading is None:
            return np.zeros(len(point.raw), bool)
        with np.errstate(over="ignore", invalid="ignore"):
            spread = max(math.sqrt(point.chi2 / max(point.residual.size - point.raw.size, 1)), PERFECT)
            lengths = np.linalg.norm(point.jacobian, axis=0)
            slope = np.abs(point.jacobian.T @ point.residual)
            return self.linked & (point.fading != 0) & (lengths < FAINT * spread) & (slope < FAINT * spread**2)

    def held(self, point: Point) -> np.ndarray:
        """(p,) bool: at a limit, with a residual that would fall beyond it."""
        with np.errstate(over="ignore", invalid="ignore"):
            slope = point.jacobian.T @ point.residual
        return ((point.raw <= self.lower) & (slope > 0)) | ((point.raw >= self.upper) & (slope < 0))

    def inside(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The point that a step from `start` to `end` may reach: shortened as a whole, then clipped."""
        change = end - start
        with np.errstate(invalid="ignore"):
            share = np.max(np.where(change == 0.0, 0.0, np.abs(change) / self.largest_change), initial=0.0)
        return np.clip(start + change / max(share, 1.0), self.lower, self.upper)


def _raw_limits(parameter: Parameter) -> tuple[float, float]:
    if parameter.link == "logit":
        return -LAST_LOGIT, LAST_LOGIT
    return parameter.raw_limits()


def relative_gradient(residual: np.ndarray, jacobian: np.ndarray) -> float:
    """Largest |J_j . r| / (|J_j| |r|): the cosine between the residual and what a parameter could change.

    Residuals of less than `PERFECT` sigma count as that, so that an exact fit has an end.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    seen = lengths > 0
    size = max(float(np.linalg.norm(residual)), PERFECT * math.sqrt(residual.size))
    cosines = np.abs(jacobian[:, seen].T @ residual) / (lengths[seen] * size)
    return float(np.max(cosines, initial=0.0))
