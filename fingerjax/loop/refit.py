"""Fits to a true optimum, of the base parameters alone or with an effect awake.

    minimise |L^-1 (y - f(theta, phi) - D)|^2 + |theta priors|^2 + sum ((phi - null) / scale)^2     inside the bounds

by damped steps, and where those do not end soon without an effect by the trust-region reflective method (Branch, Coleman & Li 1999); both
refuse a step to where the model has no converged answer. What they return is checked: an optimum is where no free direction promises more
than a tenth of a standard error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from .descent import EDGE, Place, descend, movable
from .sample import Sample
from .subject import Column, Evaluation
from .whitening import Projection

LEVEL = 1e-6  # largest cosine between the residual and a free column at an optimum
# Standard errors, of the residual's own size where that is larger, that an optimum with effects and one without may lack.
NEAR, NEARER = 0.1, 0.05
EVALUATIONS = 60  # of one search
CLOSE, NEARLY = 0.3, 0.8  # of what an optimum may lack: that a search may lack before it is polished, and one that is not
POLISH = 4  # Gauss-Newton steps after a search that stopped too early
ALONG, BROKEN = (1.0, 0.3, 0.1), 0.5  # parts of a step of which none brings more than this share of what it promises
LAST_LOGIT = 11.5  # raw limits of a logit parameter
AT_BOUND = 5e-3  # share of the plausible range from its end within which an effect is at its bound

Known = TypeVar("Known")
Keep = Callable[[str, Callable[[], dict[str, Any]]], dict[str, Any]]


def forget(name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The `Keep` that keeps nothing."""
    return make()


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where a search ended.

    - `raw` (p,), `phi` key -> value: the point. `columns`: the effects that moved, `at` the model there.
    - `residual` (sample,), `jacobian` (sample, p + k): whitened; the derivative of the prediction, effects in units of their `scale`.
    - `gradient`: largest cosine between the residual and a free column; `free` (p + k,): not held at a bound.
    - `settled`: whether it is an optimum; `reason` says why not.
    """

    sample: Sample
    columns: tuple[Column, ...]
    raw: Float[np.ndarray, "p"]
    phi: Mapping[str, float]
    at: Evaluation
    residual: Float[np.ndarray, "sample"]
    jacobian: Float[np.ndarray, "sample q"]
    free: Bool[np.ndarray, "q"]
    gradient: float
    settled: bool
    reason: str = ""

    @property
    def rss(self) -> float:
        """Sum of squares of rows and base priors, without the priors of effects."""
        return float(self.residual @ self.residual)

    @property
    def penalty(self) -> float:
        """What the priors of the effects add."""
        return float(sum(((self.phi[one.key] - one.null) / one.scale) ** 2 for one in self.columns))

    @property
    def df(self) -> float:
        """Rows and priors less what is free."""
        return float(self.residual.size - self.projection.rank)

    @cached_property
    def projection(self) -> Projection:
        """On the free columns, those of the effects that move among them."""
        jacobian = np.where(self.free, self.jacobian, 0.0)
        return Projection.of(jacobian)

    @property
    def plausible(self) -> bool:
        """Whether every effect is clear of its bounds (the null value of a one-sided effect is one). Of an effect of several numbers some
        may rest at their null, as long as another does not: skin may stiffen where what lies deeper does not.
        """

        ends = {one.key: self._end(one) for one in self.columns}
        awake = {one.family for one in self.columns if ends[one.key] is None}
        return all(one.family in awake and ends[one.key] in (None, one.null) for one in self.columns)

    def _end(self, one: Column) -> float | None:
        """The bound of an effect's number that it is at, if it is at one."""
        near = AT_BOUND * (one.upper - one.lower)
        return next((bound for bound in (one.lower, one.upper) if abs(self.phi[one.key] - bound) <= near), None)

    def limits(self) -> dict[str, str]:
        """Base parameters at a limit, and at which."""
        pairs = zip(self.sample.subject.parameters, self.raw, strict=True)
        found = {parameter.name: parameter.at_limit(float(parameter.natural(value))) for parameter, value in pairs}
        return {name: side for name, side in found.items() if side is not None}

    def covariance(self) -> Float[np.ndarray, "q q"]:
        """Of the free raw parameters and effects (in units of `scale`, with their priors); 0 for what is held."""
        below = np.zeros((len(self.columns), self.jacobian.shape[1]))
        below[:, len(self.raw) :] = np.eye(len(self.columns))
        return Projection.of(np.where(self.free, np.concatenate([self.jacobian, below]), 0.0)).covariance()

    def evidence(self) -> float:
        """Laplace's approximation of the log evidence, up to what all effects share: flat priors on the base parameters."""
        moving = len(self.columns)
        below = np.concatenate([np.zeros((moving, len(self.raw))), np.eye(moving)], axis=1)
        curved = np.concatenate([self.jacobian, below])[:, self.free]
        lengths = np.linalg.norm(curved, axis=0)
        curved, lengths = curved[:, lengths > 0], lengths[lengths > 0]
        singular = np.linalg.svd(curved / lengths, compute_uv=False)
        logdet = 2 * float(np.sum(np.log(np.maximum(singular, 1e-12))) + np.sum(np.log(lengths)))
        base = 0.5 * (curved.shape[1] - moving) * math.log(2 * math.pi)
        return -0.5 * (self.rss + self.penalty) - 0.5 * logdet + base


@dataclass
class _Points:
    """The model as a function of x: raw parameters, then effects in units of their scale from null."""

    sample: Sample
    columns: tuple[Column, ...]
    seen: dict[bytes, Evaluation] = field(default_factory=dict)
    glanced: dict[bytes, Evaluation | None] = field(default_factory=dict)

    @property
    def near(self) -> float:
        return NEAR if self.columns else NEARER

    @property
    def moving(self) -> tuple[str, ...]:
        return tuple(column.key for column in self.columns)

    def split(self, x: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
        raw, sizes = x[: len(self.sample.subject.parameters)], x[len(self.sample.subject.parameters) :]
        return raw, {one.key: float(one.null + one.scale * size) for one, size in zip(self.columns, sizes, strict=True)}

    def at(self, x: np.ndarray) -> Evaluation:
        return _kept(self.seen, x, lambda: self.sample.subject.evaluate(*self.split(x), self.moving))

    def value_at(self, x: np.ndarray) -> Evaluation:
        """Without derivatives where these are dear and not known yet."""
        if x.tobytes() in self.seen:
            return self.at(x)
        return _kept(self.glanced, x, lambda: self.sample.subject.glance(*self.split(x))) or self.at(x)

    def dear(self, x: np.ndarray) -> bool:
        """Whether derivatives cost far more than a value."""
        return _kept(self.glanced, x, lambda: self.sample.subject.glance(*self.split(x))) is not None

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Residuals and priors of the effects; NaN where the model has no answer, so that the step is refused."""
        at = self.value_at(x)
        if not at.usable:
            return np.full(self.sample.size + len(self.columns), np.nan)
        raw, _ = self.split(x)
        return np.concatenate([-self.sample.residual(at, raw), x[len(raw) :]])

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """(sample, p + k) of the prediction."""
        at, (raw, _) = self.at(x), self.split(x)
        scales = np.array([column.scale for column in self.columns])
        return np.concatenate([self.sample.jacobian(at, raw), self.sample.columns(at.phi_jacobian * scales)], axis=1)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        below = np.zeros((len(self.columns), len(x)))
        below[:, len(x) - len(self.columns) :] = np.eye(len(self.columns))
        return np.concatenate([self.slopes(x), below])

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        limits = [p.raw_limits() if p.link != "logit" else (-LAST_LOGIT, LAST_LOGIT) for p in self.sample.subject.parameters]
        limits += [((one.lower - one.null) / one.scale, (one.upper - one.null) / one.scale) for one in self.columns]
        lower, upper = np.array(limits, dtype=float).reshape(-1, 2).T
        return lower, upper


def _kept(known: dict[bytes, Known], x: np.ndarray, make: Callable[[], Known]) -> Known:
    """What was found at one of the last few points, else made."""
    key = x.tobytes()
    if key not in known:
        while len(known) > 2:
            known.pop(next(iter(known)))
        known[key] = make()
    return known[key]


def optimum(
    sample: Sample,
    columns: tuple[Column, ...],
    raw: Float[np.ndarray, "p"],
    phi: Mapping[str, float],
    *,
    name: str = "",
    kept: Keep = forget,
    enough: float = math.inf,
    at: Evaluation | None = None,
) -> Optimum:
    """The best point from a start; a finished search is handed to `kept` under its name, as numbers. One that does not promise a sum of
    squares below `enough` is given up. `at`: the model at the start with its slopes in `columns`, where it is known already.
    """
    points = _Points(sample, columns)
    start = np.concatenate([raw, [(phi[one.key] - one.null) / one.scale for one in columns]])
    if at is not None:
        points.seen[start.tobytes()] = at
    found = kept(name, lambda: {"x": _search(points, start, enough).tolist()})
    ended = _ended(points, np.array(found["x"], dtype=float))
    if not ended.settled and ended.rss > enough:
        return replace(ended, reason="was given up: it promised no more than chance explains, or far less than another effect")
    return ended


def _search(points: _Points, start: np.ndarray, enough: float) -> np.ndarray:
    lower, upper = points.box()
    room = np.where(np.isfinite(upper - lower), 1e-6 * (upper - lower), 1e-6)
    start = np.clip(start, lower + room, upper - room)
    if not points.at(start).usable:
        return start
    dear = points.dear(start)
    within = (NEARLY if dear else CLOSE) * points.near
    near, reached = descend(points.residual, points.jacobian, start, lower, upper, within, enough, dear=dear)
    if reached and dear:
        return near
    if reached or _at_an_edge(points, near):
        return _polished(points, near)
    if points.columns:
        return near
    found = least_squares(
        points.residual, near, jac=points.jacobian, bounds=(lower, upper), x_scale="jac", ftol=1e-9, xtol=1e-9, gtol=None,
        max_nfev=EVALUATIONS,
    )  # fmt: skip
    return _polished(points, found.x)


def _polished(points: _Points, x: np.ndarray) -> np.ndarray:
    """A Gauss-Newton step in the free directions, which ends the search of a linear model exactly, and more while they are needed."""
    lower, upper = points.box()
    for number in range(POLISH):
        residual, jacobian = points.residual(x), points.jacobian(x)
        free = movable(Place(x, residual, jacobian), lower, upper, points.near)
        projection = Projection.of(jacobian[:, free])
        left = float(np.linalg.norm(projection.basis.T @ residual))
        if (number and left < 0.3 * points.near * _typical(residual)) or _cosine(residual, jacobian[:, free]) < LEVEL:
            return x
        step = np.zeros(len(x))
        step[free] = -projection.inverse @ residual
        after = np.clip(x + step, lower, upper)
        moved = points.residual(after)
        if not (np.isfinite(moved).all() and moved @ moved < residual @ residual):
            return x
        x = after
    return x


def _at_an_edge(points: _Points, x: np.ndarray) -> bool:
    """Whether a point with a slope is the least all the same: where skin begins to touch the slopes on either side lead to the same edge.

    No part of a Gauss-Newton step then keeps what it promises, small as that is.
    """
    residual, jacobian = points.residual(x), points.jacobian(x)
    lower, upper = points.box()
    free = movable(Place(x, residual, jacobian), lower, upper, points.near)
    projection = Projection.of(jacobian[:, free])
    promised = float(np.sum((projection.basis.T @ residual) ** 2))
    if promised > (EDGE * _typical(residual)) ** 2:
        return False
    step = np.zeros(len(x))
    step[free] = -projection.inverse @ residual
    for share in ALONG:
        moved = points.residual(np.clip(x + share * step, lower, upper))
        if not residual @ residual - moved @ moved <= BROKEN * (2 - share) * share * promised:
            return False
    return True


def _typical(residual: np.ndarray) -> float:
    return max(1.0, float(np.linalg.norm(residual)) / math.sqrt(len(residual)))


def _cosine(residual: np.ndarray, jacobian: np.ndarray) -> float:
    lengths = np.linalg.norm(jacobian, axis=0)
    seen = lengths > 0
    size = max(float(np.linalg.norm(residual)), 1e-3 * math.sqrt(residual.size))
    return float(np.max(np.abs(jacobian[:, seen].T @ residual) / (lengths[seen] * size), initial=0.0))


def _ended(points: _Points, x: np.ndarray) -> Optimum:
    (raw, phi), at = points.split(x), points.at(x)
    size = points.sample.size
    if not at.usable:
        nothing, free = np.full((size, len(x)), np.nan), np.ones(len(x), dtype=bool)
        reason = "the model has no converged answer at the start"
        return Optimum(points.sample, points.columns, raw, phi, at, nothing[:, 0], nothing, free, math.nan, False, reason)
    residual, jacobian = points.residual(x), points.jacobian(x)
    free = movable(Place(x, residual, jacobian), *points.box(), points.near)
    gradient = _cosine(residual, jacobian[:, free])
    left = float(np.linalg.norm(Projection.of(jacobian[:, free]).basis.T @ residual))
    settled = gradient < LEVEL or left < points.near * _typical(residual) or _at_an_edge(points, x)
    reason = "" if settled else f"the search stopped {left:.2g} standard errors from the optimum"
    return Optimum(
        points.sample, points.columns, raw, phi, at, -residual[:size], jacobian[:size], free, gradient, settled, reason
    )  # fmt: skip
