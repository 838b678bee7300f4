"""A search for the least sum of squares inside bounds that stays fast where the residual at the end is large.

Gauss-Newton steps leave out how the Jacobian turns, S = sum r_i grad^2 r_i: where a model misses its data by many standard errors they
crawl. S is learned from the steps (Dennis, Gay & Welsch 1981, ACM Trans. Math. Softw. 7, 348) and put in once it foretells a step better
than its absence; a step that leads up is damped (Levenberg 1944).

    minimise  g's + s'(J'J + S + d D)s / 2     inside the box,      g = J'r

Where slopes cost far more than values, a step that kept its word is followed by others along slopes that are turned just so far that they
agree with what it brought (Broyden 1965, Math. Comput. 19, 577). A search ends on true ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import lsq_linear

from .whitening import Projection

STEPS = 30  # damped steps
FIRST = 0.03  # damping, so that what the data hardly see is not thrown far off while they are still far away
POOR, GOOD = 0.25, 0.6  # gain below which steps become shorter, and above which they become longer
LONGEST = 1.5  # how far one may go, in raw parameters and in plausible sizes of effects
BENT, SHARP = 0.75, 1.5  # gain below which the bend is looked at, and its size over the step's up to which it is followed
PROBE = 0.1  # of a step, where the model has no answer at its end
# Where the residual is so many times the noise, a search whose last steps brought so little of what was promised is given up.
FAR, CRAWL, PATIENCE = 2.0, 1e-3, 5
SOON = 2  # points in turn that do not promise enough, until a search along dear slopes is given up; PATIENCE of them along others
EDGE, OFTEN = 1.0, 6  # standard errors that steps may promise in vain, and how often, until a search ends: it is on an edge
STUCK = 1e-7  # share of the sum of squares that says of two steps in turn that there is no getting on
AWRY, ON_TRUST = 0.25, 3  # how far from 1 the gain of a step may be to turn slopes by, and how many steps in turn may go by such
LEAST = 1e-3  # share of the Gauss-Newton curvature that is kept in every direction, whatever S says

Residual = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Place:
    """A point x (q,) with its residual (n,) and Jacobian (n, q), the true one or one that so many steps have turned."""

    x: Float[np.ndarray, "q"]
    residual: Float[np.ndarray, "n"]
    jacobian: Float[np.ndarray, "n q"]
    turned: int = 0

    @property
    def gradient(self) -> Float[np.ndarray, "q"]:
        return self.jacobian.T @ self.residual

    @property
    def typical(self) -> float:
        """Root mean square of the residual, or 1 where it is smaller."""
        return max(1.0, float(np.linalg.norm(self.residual)) / math.sqrt(len(self.residual)))

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
    enough: float = math.inf,
    *,
    dear: bool = False,
) -> tuple[Float[np.ndarray, "q"], bool]:
    """The optimum from a start inside the bounds, and whether it was reached; else the best point that was seen.

    It is one where `near` standard errors may still be gained, of the residual's own size where that is larger than the noise. A search
    that crawls far from the data is given up, and so is one that does not promise to come below `enough`, the sum of squares that is asked
    for.

    `residual` gives NaN where the model has no answer: such a step is refused. `dear`: a Jacobian costs far more than a residual.
    """
    here = sure = Place(x, residual(x), jacobian(x))
    turning, damping, trusted = np.zeros((len(x), len(x))), FIRST, False
    slow = stuck = hopeless = vain = 0
    for _ in range(STEPS):
        ways = movable(here, lower, upper, near)
        promised = float(np.linalg.norm(Projection.of(here.jacobian[:, ways]).basis.T @ here.residual))
        if promised < near * here.typical:
            if not here.turned:
                return here.x, True
            here, damping = _sure(here, sure, jacobian, damping)
            continue
        hopeless = hopeless + (not here.turned) if here.squares - promised**2 > enough else 0
        if slow == PATIENCE or stuck == 2 or hopeless == (SOON if dear else PATIENCE) or vain == OFTEN:
            break
        believed = turning if trusted else np.zeros_like(turning)
        step = _step(here, believed, damping, lower, upper)
        after = np.clip(here.x + step, lower, upper)
        moved = residual(after)
        gain = _gain(here, step, believed, moved)
        if gain < 0 and here.turned:
            here, damping = _sure(here, sure, jacobian, damping)
            continue
        if gain < BENT and not here.turned and (bent := _bent(here, step, moved, believed, damping, residual)) is not None:
            other = np.clip(here.x + bent, lower, upper)
            beyond = residual(other)
            if np.isfinite(beyond).all() and not beyond @ beyond >= min(here.squares, moved @ moved if gain >= 0 else np.inf):
                after, moved, gain = other, beyond, max(_gain(here, step, believed, beyond), 0.0)
        vain += gain < POOR and promised < EDGE * here.typical
        damping = _damping(damping, gain)
        crawls = min(float(moved @ moved), here.squares) > (1 - CRAWL) * here.squares and promised**2 > CRAWL * here.squares
        slow = slow + 1 if crawls and here.typical > FAR else 0
        stuck = stuck + 1 if abs(float(moved @ moved) - here.squares) < STUCK * here.squares else 0
        if gain >= 0:
            on_trust = dear and abs(gain - 1) < AWRY and here.turned < ON_TRUST
            there = _turned(here, after, moved) if on_trust else Place(after, moved, jacobian(after))
            if not np.isfinite(there.jacobian).all():
                damping = _damping(damping, -1.0)
                continue
            if not (here.turned or there.turned):
                trusted = foretells(turning, here, there, trusted)
                turning = learned(turning, here, there)
            here, sure = there, sure if there.turned else there
    return here.x, False


def _sure(here: Place, sure: Place, jacobian: Residual, damping: float) -> tuple[Place, float]:
    """A point with its true slopes, and the damping; where it has none, the last one that had."""
    there = Place(here.x, here.residual, jacobian(here.x))
    return (there, damping) if np.isfinite(there.jacobian).all() else (sure, _damping(damping, -1.0))


def _turned(here: Place, x: np.ndarray, residual: np.ndarray) -> Place:
    """The end of a step, with the Jacobian that changes least and foretells what it brought."""
    step = x - here.x
    missing = residual - here.residual - here.jacobian @ step
    return Place(x, residual, here.jacobian + np.outer(missing, step) / max(float(step @ step), 1e-300), here.turned + 1)


def _gain(here: Place, step: np.ndarray, turning: np.ndarray, moved: np.ndarray) -> float:
    """What a step brought, over what was foretold of it; below 0 where it led up or nowhere."""
    if not np.isfinite(moved).all() or moved @ moved > here.squares:
        return -1.0
    foretold = float(-2 * here.gradient @ step - np.sum((here.jacobian @ step) ** 2) - step @ turning @ step)
    return (here.squares - float(moved @ moved)) / max(foretold, 1e-300)


def _bent(
    here: Place, step: np.ndarray, moved: np.ndarray, turning: np.ndarray, damping: float, residual: Residual
) -> np.ndarray | None:
    """A step along the parabola t v + t^2 a / 2 with (J'J + S + d D) a = -J' r_vv, as far as it bends little; None if that is not known."""
    share = 1.0 if np.isfinite(moved).all() else PROBE
    there = moved if share == 1.0 else residual(here.x + share * step)
    if not np.isfinite(there).all():
        return None
    second = 2.0 / share * ((there - here.residual) / share - here.jacobian @ step)
    scale = np.sqrt(np.maximum(np.einsum("nq,nq->q", here.jacobian, here.jacobian), 1e-300))
    matrix = here.jacobian.T @ here.jacobian + turning + damping * np.diag(scale**2)
    bend = -np.linalg.lstsq(matrix / np.outer(scale, scale), here.jacobian.T @ second / scale, rcond=1e-12)[0] / scale
    far = min(1.0, SHARP * float(np.linalg.norm(scale * step)) / max(float(np.linalg.norm(scale * bend)), 1e-300))
    return far * step + 0.5 * far**2 * bend


def _damping(before: float, gain: float) -> float:
    """More where a step brought little of what was foretold, less where it kept its word (Marquardt 1963)."""
    if gain < 0:
        return max(10 * before, 1e-2)
    if gain < POOR:
        return max(3 * before, 1e-2)
    return before if gain < GOOD else 0.1 * before if before > 1e-3 else 0.0


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


def foretells(turning: Float[np.ndarray, "q q"], here: Place, there: Place, trusted: bool) -> bool:
    """Whether the quadratic model with S was nearer to what a step brought than the one without; `trusted` where neither was."""
    step = there.x - here.x
    plain = float(2 * here.gradient @ step + np.sum((here.jacobian @ step) ** 2))
    more, found = float(step @ turning @ step), there.squares - here.squares
    without, with_it = abs(plain - found), abs(plain + more - found)
    return trusted if without == with_it else with_it < without


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


def movable(here: Place, lower: Float[np.ndarray, "q"], upper: Float[np.ndarray, "q"], near: float) -> Bool[np.ndarray, "q"]:
    """Not at a bound that the sum of squares falls towards, nor on the flat end of a scale, where all that is left to it moves the
    prediction by less than `near` standard errors.
    """
    close = 1e-5 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    falls = here.gradient > 0
    held = ((here.x <= lower + close) & falls) | ((here.x >= upper - close) & (here.gradient < 0))
    room, length = np.where(falls, here.x - lower, upper - here.x), np.linalg.norm(here.jacobian, axis=0)
    return ~held & ((length > 0) & (length * np.where(length > 0, room, 0.0) > near))
