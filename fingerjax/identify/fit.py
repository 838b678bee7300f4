"""Levenberg-Marquardt to a true optimum, with one evaluation of the model for each step.

An evaluation may cost seconds, so the model is touched once for each point: residuals, Jacobian and the
health of every solve inside come out of one compiled pass. optimistix's `LevenbergMarquardt` is then stepped
on the linearisation, which at that point has the same value and the same derivative and costs nothing.

Parameters are fitted in their raw (linked) form and scaled by the length of their Jacobian columns, so that
neither the damping nor the stopping rule depends on units.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from fingerjax._results import RESULTS
from fingerjax.forward.problem import Health, Problem
from fingerjax.parameters import Parameter

DAMPING = 1e-3  # first Levenberg-Marquardt parameter, in units of the squared column lengths (Marquardt 1963)
LARGEST_CHANGE = 3.0  # of a log or logit parameter in one step: a factor of twenty
LAST_LOGIT = 11.5  # raw limits of a logit parameter: 1e-5 of its span from either end
PERFECT = 1e-3  # residuals of this many sigma count as perfect: a smaller one is not worth a step
NEAR = 1e-3  # standard errors from the optimum at which a fit that cannot go on counts as arrived
REFUSED = 10  # failed evaluations in all after which a fit gives up


@dataclass(frozen=True)
class Step:
    """One evaluation, as the progress callback sees it."""

    step: int
    chi2: float
    gradient: float
    accepted: bool
    seconds: float


@dataclass(frozen=True)
class Fit:
    """Where a fit ended, how it got there, and the linearisation there.

    - `result`: a member of `RESULTS`; `reason` is the particular story in one clause.
    - `raw` (p,), `residual` (rows,), `jacobian` (rows, p): the best point found, d residual / d raw.
    - `gradient`: largest |J_j . r| / (|J_j| |r|) over the parameters that are free to move: 0 at an optimum.
    - `evaluations`: how often the model was run; each gave residuals and Jacobian.
    """

    problem: Problem
    result: RESULTS
    reason: str
    raw: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    gradient: float
    steps: int
    evaluations: int
    converged: bool
    iterations: int
    solve_residual: float
    limits: dict[str, str] = field(default_factory=dict)
    history: tuple[Step, ...] = ()

    @property
    def settled(self) -> bool:
        """Is this an optimum whose values may be read? (A parameter may sit at its limit.)"""
        return self.result in (RESULTS.successful, RESULTS.at_limit)

    @property
    def best(self) -> dict[str, float]:
        """Natural values of the best point so far, whether or not it is an optimum."""
        pairs = zip(self.problem.parameters, self.raw, strict=True)
        return {parameter.name: float(parameter.natural(raw)) for parameter, raw in pairs}

    @property
    def values(self) -> dict[str, float]:
        """Natural values at the optimum; NaN throughout where there is none."""
        return self.best if self.settled else dict.fromkeys(self.problem.names, math.nan)

    @property
    def chi2(self) -> float:
        return float(self.residual @ self.residual)

    @property
    def dof(self) -> int:
        """Rows (those of priors included) less free parameters."""
        return self.residual.size - self.raw.size

    def rows(self, block: str) -> np.ndarray:
        """Whitened residuals of one measurement."""
        return self.residual[self.problem.blocks[block]]


@dataclass(frozen=True)
class _Point:
    """The model at one raw vector."""

    raw: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    converged: bool
    iterations: int
    solve_residual: float

    @property
    def usable(self) -> bool:
        return self.converged and bool(
            np.all(np.isfinite(self.residual)) and np.all(np.isfinite(self.jacobian))
        )

    @property
    def chi2(self) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            return float(self.residual @ self.residual)


@eqx.filter_jit
def _linearise(residuals: Callable[[Array], tuple[Array, Health]], raw: Array) -> tuple[Array, Array, Health]:
    """Residuals, Jacobian and health in one pass.

    The tangents are pushed forward together with the one value that they share (`out_axes=None` insists on
    it). A `linearize` would do too, but runs a loop in the model twice: once for the value and once for the
    tangents.
    """

    def push(direction: Array) -> tuple[Array, Array, Health]:
        return jax.jvp(residuals, (raw,), (direction,), has_aux=True)

    return jax.vmap(push, out_axes=(None, 1, None))(jnp.eye(raw.size))


def evaluator(problem: Problem) -> Callable[[np.ndarray], _Point]:
    """The model as a function of the raw vector, on the host.

    Compiled once per `problem.residuals`. Where that is a module (`equinox.Module`) with the data among its
    leaves, problems that differ in their data only share one compilation.
    """

    def evaluate(raw: np.ndarray) -> _Point:
        at = jnp.asarray(raw)
        residuals = problem.residuals if problem.prepare is None else problem.prepare(at)
        residual, jacobian, health = jax.block_until_ready(_linearise(residuals, at))
        return _Point(
            raw,
            np.asarray(residual),
            np.asarray(jacobian),
            bool(health.converged),
            int(health.iterations),
            float(health.residual),
        )

    return evaluate


@dataclass(frozen=True)
class _Box:
    """The raw limits. A logit parameter stops just short of its own, where its slope is still a number."""

    lower: np.ndarray
    upper: np.ndarray
    largest_change: np.ndarray

    @classmethod
    def around(cls, parameters: tuple[Parameter, ...]) -> _Box:
        bounds = [_raw_limits(parameter) for parameter in parameters]
        change = [math.inf if parameter.link == "identity" else LARGEST_CHANGE for parameter in parameters]
        return cls(np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds]), np.array(change))

    def held(self, point: _Point) -> np.ndarray:
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


@cache
def _solver() -> Any:
    # A step is good from three quarters of the predicted reduction; optimistix asks for 0.99, which a curved
    # model reaches too late for the damping to vanish.
    search: Any = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=10.0, low_constant=0.1)
    return eqx.tree_at(lambda s: s.search, optx.LevenbergMarquardt(rtol=0.0, atol=0.0), search)


@cache
def _blank_state(rows: int, count: int) -> Any:
    """The solver's first state. Kept, because it holds a traced function and a new one would be compiled
    again."""
    z = jnp.zeros(count)
    args = (jnp.zeros(rows), jnp.zeros((rows, count)), z)
    shapes = jax.eval_shape(_linearised, z, args)
    return _solver().init(_linearised, z, args, {}, *shapes, frozenset())


@eqx.filter_jit
def _advance(z: Array, args: tuple[Array, Array, Array], state: Any) -> tuple[Array, Any]:
    z, state, _ = _solver().step(_linearised, z, args, {}, state, frozenset())
    return z, state


class _Walk:
    """optimistix's Levenberg-Marquardt on linearisations that somebody else evaluates.

    Coordinates are z = raw * scale, scale being the column lengths of the Jacobian times sqrt(`DAMPING`).
    """

    def __init__(self, box: _Box):
        self.box = box
        self.scale = np.array([])
        self.state: Any = None
        self.z: Any = None

    def begin(self, point: _Point, step_size: float = 1.0) -> np.ndarray:
        """(Re)start at an evaluated point and say where to evaluate next."""
        lengths = np.linalg.norm(point.jacobian, axis=0)
        fresh = np.where(lengths > 0, lengths, 1.0) * math.sqrt(DAMPING)
        self.scale = fresh if self.scale.size == 0 else np.maximum(fresh, self.scale)
        self.z = jnp.asarray(point.raw * self.scale)
        self.state = eqx.tree_at(
            lambda s: (s.y_eval, s.search_state.step_size),
            _blank_state(*point.jacobian.shape),
            (self.z, jnp.asarray(step_size)),
        )
        return self.advance(point, point)

    def advance(self, at: _Point, best: _Point) -> np.ndarray:
        """Tell the solver what was found at its trial point; (p,) raw where it wants to look next.

        A point higher than the best is refused here: after clipping, the solver may have predicted it to be
        so.
        """
        surrogate = self._surrogate(at, refuse=not at.usable or at.chi2 > best.chi2)
        self.z, self.state = _advance(self.z, surrogate, self.state)
        centre = np.asarray(self.z) / self.scale
        trial = self.box.inside(centre, np.asarray(self.state.y_eval) / self.scale)
        self.state = eqx.tree_at(lambda s: s.y_eval, self.state, jnp.asarray(trial * self.scale))
        return trial

    @property
    def accepted(self) -> bool:
        return int(self.state.num_steps_since_acceptance) == 0

    @property
    def step_size(self) -> float:
        return float(self.state.search_state.step_size)

    def outgrown(self, point: _Point) -> bool:
        """Has a column grown so far past its scale that the damping no longer knows it?"""
        lengths = np.linalg.norm(point.jacobian, axis=0) * math.sqrt(DAMPING)
        return bool(np.any(lengths > 2.0 * self.scale))

    def _surrogate(self, point: _Point, refuse: bool = False) -> tuple[Array, Array, Array]:
        residual, jacobian = point.residual, point.jacobian * ~self.box.held(point)
        if refuse:
            residual, jacobian = np.full_like(residual, np.inf), np.zeros_like(jacobian)
        return jnp.asarray(residual), jnp.asarray(jacobian / self.scale), jnp.asarray(point.raw * self.scale)


def _linearised(z: Array, args: tuple[Array, Array, Array]) -> tuple[Array, None]:
    residual, jacobian, centre = args
    return residual + jacobian @ (z - centre), None


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into a flag, so that the evaluation under way ends cleanly; a second one
    raises."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def handler(number: int, frame: Any) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = signal.signal(signal.SIGINT, handler)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


@dataclass
class _Record:
    """What accumulates while a fit runs."""

    problem: Problem
    box: _Box
    best: _Point
    gradient: float = math.inf
    steps: int = 0
    evaluations: int = 1
    refused: int = 0
    stuck: int = 0
    history: list[Step] = field(default_factory=list)
    progress: Callable[[Step], object] | None = None

    def take(self, point: _Point) -> None:
        self.best, self.gradient, self.stuck = point, self.slope_at(point), 0

    def slope_at(self, point: _Point) -> float:
        return relative_gradient(point.residual, point.jacobian[:, ~self.box.held(point)])

    def note(self, point: _Point, accepted: bool, seconds: float) -> None:
        self.refused += not point.usable
        gradient = self.slope_at(point) if point.usable else math.nan
        self.history.append(Step(self.steps, point.chi2, gradient, accepted, seconds))
        if self.progress is not None:
            self.progress(self.history[-1])

    def remaining(self) -> float:
        """How far the linearised optimum lies, in standard errors: |projection of r on the columns| / s."""
        free = self.best.jacobian[:, ~self.box.held(self.best)]
        lengths = np.linalg.norm(free, axis=0)
        basis, singular, _ = np.linalg.svd(free[:, lengths > 0] / lengths[lengths > 0], full_matrices=False)
        basis = basis[:, singular > 1e-10]
        spread = math.sqrt(self.best.chi2 / max(self.best.residual.size - self.best.raw.size, 1))
        return float(np.linalg.norm(basis.T @ self.best.residual)) / max(spread, PERFECT)

    def limits(self) -> dict[str, str]:
        sides = {
            parameter.name: parameter.at_limit(float(parameter.natural(raw)))
            for parameter, raw in zip(self.problem.parameters, self.best.raw, strict=True)
        }
        return {name: side for name, side in sides.items() if side is not None}

    def end(self, result: RESULTS, reason: str) -> Fit:
        limits = self.limits() if self.best.usable else {}
        if result is RESULTS.successful and limits:
            result = RESULTS.at_limit
            reason += "; at its limit: " + ", ".join(f"{name} ({side})" for name, side in limits.items())
        best = self.best
        return Fit(
            self.problem, result, reason, best.raw, best.residual, best.jacobian, self.gradient, self.steps,
            self.evaluations, best.usable, best.iterations, best.solve_residual, limits, tuple(self.history),
        )  # fmt: skip


def fit(
    problem: Problem,
    *,
    max_steps: int = 100,
    gradient_tolerance: float = 1e-6,
    start: np.ndarray | None = None,
    progress: Callable[[Step], object] | None = None,
) -> Fit:
    """Find the parameters at which the sum of squared whitened residuals is least.

        minimise  chi2(raw) = |r(raw)|^2        stop when  |J_j . r| <= tolerance |J_j| |r|  for every free j

    **Arguments:**

    - `problem`: what to fit.
    - `max_steps`: evaluations after the first one; each costs one run of the model with its derivatives.
    - `gradient_tolerance`: the relative gradient that counts as an optimum.
    - `start`: raw start values (p,), for instance `Fit.raw` of an interrupted fit; the parameters' own
      otherwise.
    - `progress`: called with a `Step` after every evaluation.

    **Returns:** a `Fit`. It never raises for a fit that ends badly: `Fit.result` is then `not_converged` (a
    solve inside failed at the start or kept failing, or the steps ran out) or `interrupted` (Ctrl-C),
    `Fit.values` are NaN and the best point so far is kept in `Fit.raw`. A trial point whose solves failed is
    never accepted.

    Levenberg (1944); Marquardt (1963); column scaling as in Moré (1978), section 6.
    """
    if not problem.parameters:
        raise ValueError("problem has no free parameters: name at least one under fit.free")
    evaluate, box = evaluator(problem), _Box.around(problem.parameters)
    first = np.clip(problem.start() if start is None else np.asarray(start, float), box.lower, box.upper)
    with _interruptible() as asked:
        clock = time.perf_counter()
        record = _Record(problem, box, evaluate(first), progress=progress)
        record.note(record.best, record.best.usable, time.perf_counter() - clock)
        if not record.best.usable:
            return record.end(RESULTS.not_converged, _failure("at the start values", record.best))
        record.take(record.best)
        return _descend(record, evaluate, max_steps, gradient_tolerance, asked)


def _descend(
    record: _Record,
    evaluate: Callable[[np.ndarray], _Point],
    max_steps: int,
    tolerance: float,
    asked: threading.Event,
) -> Fit:
    walk = _Walk(record.box)
    trial = walk.begin(record.best)
    while record.gradient > tolerance:
        if asked.is_set():
            return record.end(RESULTS.interrupted, f"stopped by hand after {record.steps} steps")
        if record.steps == max_steps:
            return record.end(
                RESULTS.not_converged,
                f"no optimum in {max_steps} steps (relative gradient {record.gradient:.1e})",
            )
        clock = time.perf_counter()
        point = evaluate(trial)
        record.steps, record.evaluations = record.steps + 1, record.evaluations + 1
        trial, accepted = _judge(record, walk, point)
        record.note(point, accepted, time.perf_counter() - clock)
        if record.refused == REFUSED:
            return record.end(RESULTS.not_converged, _failure(f"at {REFUSED} trial points", point))
        if _stalled(record, trial):
            return _at_a_stand(record)
    return record.end(RESULTS.successful, f"optimum after {record.steps} steps")


def _judge(record: _Record, walk: _Walk, point: _Point) -> tuple[np.ndarray, bool]:
    """Hand the point to the solver, or take it for its smaller gradient where chi2 no longer tells."""
    best = record.best
    polished = (
        point.usable and point.chi2 <= best.chi2 * (1 + 1e-10) and record.slope_at(point) < record.gradient
    )
    trial = walk.advance(point, best)
    accepted = walk.accepted or polished
    if not accepted:
        record.stuck += 1
        return trial, False
    record.take(point)
    if not walk.accepted or walk.outgrown(point):
        trial = walk.begin(point, walk.step_size)
    return trial, True


def _stalled(record: _Record, trial: np.ndarray) -> bool:
    """Nothing gained lately, and nothing worth having left; or a step too small to be one."""
    still = np.all(np.abs(trial - record.best.raw) <= 1e-14 * (1 + np.abs(trial)))
    return bool(still) or record.stuck >= 12 or (record.stuck >= 2 and record.remaining() <= NEAR)


def _at_a_stand(record: _Record) -> Fit:
    """No step goes down any more: rounding, or a kink where contact opens, not necessarily an optimum."""
    distance = record.remaining()
    story = f"no step goes down after {record.steps} (relative gradient {record.gradient:.1e}"
    story += f", {distance:.1e} standard errors from the optimum)"
    return record.end(RESULTS.successful if distance <= NEAR else RESULTS.not_converged, story)


def _failure(where: str, point: _Point) -> str:
    if point.converged:
        return f"the model gave a number that is not finite {where}"
    return (
        f"a solve inside the model did not converge {where} "
        f"(relative residual {point.solve_residual:.1e} after {point.iterations} iterations)"
    )
