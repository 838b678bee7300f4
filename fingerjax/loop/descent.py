"""A search for the least sum of squares inside bounds that stays fast where the residual at the end is large.

Gauss-Newton steps leave out how the Jacobian turns, S = sum r_i grad^2 r_i: where a model misses its data by many standard errors they
crawl. S is learned from the steps (Dennis, Gay & Welsch 1981, ACM Trans. Math. Softw. 7, 348) and put in, damped where a step leads up
(Levenberg 1944).

    minimise  g's + s'(J'J + S + d D)s / 2     inside the box,      g = J'r
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import lsq_linear

from .whitening import Projection

STEPS = 20  # damped steps
LONGEST = 1.5  # how far one may go, in raw parameters and in plausible sizes of effects
LEAST = 1e-3  # share of the Gauss-Newton curvature that is kept in every direction, whatever S says

Residual = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Place:
    """A point x (q,) with its residual (n,) and Jacobian (n, q)."""

    x: Float[np.ndarray, "q"]
    residual: Float[np.ndarray, "n"]
    jacobian: Float[np.ndarray, "n q"]

    @property
    def gradient(self) -> Float[np.ndarray, "q"]:
        return self.jacobian.T @ self.residual

    @property
    def squares(self) -> float:
        return float(self.residual @ self.residual)


def descend(
    residual: Residual,
    jacobian: Residual,
    x: Float[np.ndarray, "q"],
    lower: Float[np.ndarray, "q"],
    upper: Float[np.ndarray, "q"],
    near: float,
) -> Float[np.ndarray, "q"] | None:
    """The optimum from a start inside the bounds, to `near` standard errors; None where it is not reached in a few steps.

    `residual` gives NaN where the model has no answer: such a step is refused.
    """
    here = Place(x, residual(x), jacobian(x))
    turning, damping = np.zeros((len(x), len(x))), 0.0
    for _ in range(STEPS):
        ways = movable(here.x, here.gradient, lower, upper)
        if np.linalg.norm(Projection.of(here.jacobian[:, ways]).basis.T @ here.residual) < near:
            return here.x
        after = np.clip(here.x + _step(here, turning, damping, lower, upper), lower, upper)
        moved = residual(after)
        if np.isfinite(moved).all() and moved @ moved <= here.squares:
            there = Place(after, moved, jacobian(after))
            turning = learned(turning, here, there)
            here, damping = there, 0.1 * damping if damping > 1e-4 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
    return None


def _step(here: Place, turning: np.ndarray, damping: float, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The least of the quadratic model inside the box and within reach."""
    square = here.jacobian.T @ here.jacobian
    scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
    size, ways = np.linalg.eigh((square + turning) / np.outer(scale, scale))
    plain = np.einsum("ik,ij,jk->k", ways, square / np.outer(scale, scale), ways)
    root = np.sqrt(np.maximum(size, np.maximum(LEAST * plain, 1e-14)) + damping)
    rows = root[:, None] * ways.T * scale
    aim = -(ways.T @ (here.gradient / scale)) / root
    room = np.maximum(lower - here.x, -LONGEST) - 1e-12, np.minimum(upper - here.x, LONGEST) + 1e-12
    return lsq_linear(rows, aim, bounds=room).x


def learned(turning: Float[np.ndarray, "q q"], here: Place, there: Place) -> Float[np.ndarray, "q q"]:
    """S after a step, by the update that changes it least and agrees with the gradients at both of its ends."""
    step, change = there.x - here.x, there.gradient - here.gradient
    along = float(step @ change)
    if along <= 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
        return turning
    turned = (there.jacobian - here.jacobian).T @ there.residual
    before = float(step @ turning @ step)
    shrunk = turning * (min(1.0, abs(float(step @ turned) / before)) if before != 0.0 else 1.0)
    missing = turned - shrunk @ step
    both = np.outer(missing, change)
    return shrunk + (both + both.T) / along - float(missing @ step) * np.outer(change, change) / along**2


def movable(
    x: Float[np.ndarray, "q"], gradient: Float[np.ndarray, "q"], lower: Float[np.ndarray, "q"], upper: Float[np.ndarray, "q"]
) -> Bool[np.ndarray, "q"]:
    """Not at a bound that the sum of squares falls towards."""
    close = 1e-5 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    return ~(((x <= lower + close) & (gradient > 0)) | ((x >= upper - close) & (gradient < 0)))
