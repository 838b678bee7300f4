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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._results import RESULTS
from ..forward.problem import Problem
from .box import PERFECT, Box, relative_gradient
from .evaluation import Point, evaluator
from .walk import Secant, Walk
from .weighing import AbstractWeighing, Loss

NEAR = 1e-3  # standard errors from the optimum at which a fit that cannot go on counts as arrived
LEVEL = 0.1  # relative gradient from which on the secant may be asked: far from an optimum it misleads
SLOW = 0.1  # of the gradient is left after a good step of Gauss and Newton near an optimum; where more is, the secant knows better
SEATINGS = 3  # times a settled fit is asked whether its afferents could be seated better
# Evaluations in which neither chi2, by this many squared standard errors, nor the gradient, below this share of itself, fell: a fit that
# is left with so few standard errors to gain is on an edge, where contact opens and the slopes of both sides lead to it.
LOOKED_BACK, FELL, FLATTER, EDGE = 8, 1e-3, 0.3, 0.5
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
    - `raw` (p,), `residual` (rows,), `jacobian` (rows, p): the best point found, d residual / d raw, before any loss.
    - `chi2`: what was made least: the sum of squares, or of their loss.
    - `gradient`: largest |J_j . r| / (|J_j| |r|) over the parameters that are free to move: 0 at an optimum.
    - `evaluations`: how often the model was run; each gave residuals and Jacobian.
    - `edge`: whether it ended on a kink, as where contact opens or closes: nothing fell any more, though the gradient is not 0.
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
    chi2: float = math.nan
    edge: bool = False

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
    def dof(self) -> int:
        """Rows (those of priors included) less free parameters."""
        return self.residual.size - self.raw.size

    def rows(self, block: str) -> np.ndarray:
        """Whitened residuals of one measurement."""
        return self.residual[self.problem.blocks[block]]


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
    box: Box
    best: Point
    gradient: float = math.inf
    steps: int = 0
    evaluations: int = 1
    refused: int = 0
    stuck: int = 0
    history: list[Step] = field(default_factory=list)
    reached: list[tuple[float, float]] = field(default_factory=list)  # (chi2, gradient) of the best point after each evaluation
    progress: Callable[[Step], object] | None = None

    def take(self, point: Point) -> None:
        self.best, self.gradient, self.stuck = point, self.slope_at(point), 0

    def slope_at(self, point: Point) -> float:
        return relative_gradient(point.residual, point.jacobian[:, ~self.box.idle(point)])

    def note(self, point: Point, accepted: bool, seconds: float) -> None:
        self.refused += not point.usable
        gradient = self.slope_at(point) if point.usable else math.nan
        self.history.append(Step(self.steps, point.chi2, gradient, accepted, seconds))
        self.reached.append((self.best.chi2, self.gradient))
        if self.progress is not None:
            self.progress(self.history[-1])

    def remaining(self) -> float:
        """How far the linearised optimum lies, in standard errors: |projection of r on the columns| / s."""
        free = self.best.jacobian[:, ~self.box.idle(self.best)]
        lengths = np.linalg.norm(free, axis=0)
        basis, singular, _ = np.linalg.svd(free[:, lengths > 0] / lengths[lengths > 0], full_matrices=False)
        basis = basis[:, singular > 1e-10]
        return float(np.linalg.norm(basis.T @ self.best.residual)) / self.spread()

    def spread(self) -> float:
        """Root mean square of the residuals, `PERFECT` at least."""
        return max(math.sqrt(self.best.chi2 / max(self.best.residual.size - self.best.raw.size, 1)), PERFECT)

    def on_an_edge(self) -> bool:
        """Has nothing been gained for long, neither in chi2 nor in the gradient, with little left to gain on either side?"""
        if len(self.reached) <= LOOKED_BACK:
            return False
        chi2, gradient = self.reached[-1 - LOOKED_BACK]
        still = chi2 - self.best.chi2 < FELL * self.spread() ** 2 and self.gradient > FLATTER * gradient
        return still and self.remaining() <= EDGE

    def limits(self) -> dict[str, str]:
        sides = {
            parameter.name: parameter.at_limit(float(parameter.natural(raw)))
            for parameter, raw in zip(self.problem.parameters, self.best.raw, strict=True)
        }
        found = {name: side for name, side in sides.items() if side is not None}
        if self.best.fading is not None:
            faint = zip(self.problem.names, self.box.faint(self.best), self.best.fading, strict=True)
            found |= {name: "upper" if way > 0 else "lower" for name, gone, way in faint if gone and name not in found}
        return found

    def end(self, result: RESULTS, reason: str, *, edge: bool = False) -> Fit:
        limits = self.limits() if self.best.usable else {}
        if result is RESULTS.successful and limits:
            result = RESULTS.at_limit
            reason += "; ran towards its limit: " + ", ".join(f"{name} ({side})" for name, side in limits.items())
        best = self.best
        plain = best if best.plain is None else best.plain
        return Fit(
            self.problem, result, reason, best.raw, plain.residual, plain.jacobian, self.gradient, self.steps,
            self.evaluations, best.usable, best.iterations, best.solve_residual, limits, tuple(self.history), best.chi2,
            edge,
        )  # fmt: skip


def fit(
    problem: Problem,
    *,
    max_steps: int = 100,
    gradient_tolerance: float = 1e-6,
    start: np.ndarray | None = None,
    hold: Mapping[str, float] | None = None,
    weighing: AbstractWeighing | None = None,
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
    - `hold`: raw values, by name, of parameters that stay where they are.
    - `weighing`: what is done to the rows before the loss, see `identify.weighing`.
    - `progress`: called with a `Step` after every evaluation.

    **Returns:** a `Fit`. It never raises for a fit that ends badly: `Fit.result` is then `not_converged` (a
    solve inside failed at the start or kept failing), `no_optimum` (no step goes down, or they ran out) or `interrupted` (Ctrl-C),
    `Fit.values` are NaN and the best point so far is kept in `Fit.raw`. A trial point whose solves failed is
    never accepted. A least chi2 may lie where contact opens and its slope jumps: there no gradient vanishes, and the fit ends when nothing
    is gained any more and the slopes of either side promise less than half a standard error; `Fit.reason` says so.

    A threshold makes chi2 flat where nothing fires and gives it several minima. So scale and threshold of an afferent are begun from, and
    once settled compared with, the best of all for the other values (`Problem.reseat`).

    Levenberg (1944); Marquardt (1963); column scaling as in Moré (1978), section 6.
    """
    if not problem.parameters:
        raise ValueError("problem has no free parameters: name at least one under fit.free")
    evaluate = _weighed(problem, weighing)
    box = Box.around(problem.parameters).pinched({problem.names.index(name): raw for name, raw in (hold or {}).items()})
    first = _seated(problem, box, problem.start() if start is None else np.asarray(start, float))
    found = _fitted(problem, evaluate, box, first, max_steps, gradient_tolerance, progress)
    for _ in range(SEATINGS if problem.reseat is not None and found.settled else 0):
        better = _seated(problem, box, found.raw)
        if np.abs(better - found.raw).max() < 1e-6 or evaluate(better).chi2 >= found.chi2 * (1 - 1e-6):
            break
        found = _fitted(problem, evaluate, box, better, max_steps, gradient_tolerance, progress)
    return found


def _seated(problem: Problem, box: Box, raw: np.ndarray) -> np.ndarray:
    inside = np.clip(raw, box.lower, box.upper)
    return inside if problem.reseat is None else np.clip(problem.reseat(inside), box.lower, box.upper)


def _fitted(
    problem: Problem,
    evaluate: Callable[[np.ndarray], Point],
    box: Box,
    first: np.ndarray,
    max_steps: int,
    gradient_tolerance: float,
    progress: Callable[[Step], object] | None,
) -> Fit:
    with _interruptible() as asked:
        clock = time.perf_counter()
        record = _Record(problem, box, evaluate(first), progress=progress)
        record.note(record.best, record.best.usable, time.perf_counter() - clock)
        if not record.best.usable:
            return record.end(RESULTS.not_converged, _failure("at the start values", record.best))
        record.take(record.best)
        return _descend(record, evaluate, max_steps, gradient_tolerance, asked)


def _weighed(problem: Problem, weighing: AbstractWeighing | None) -> Callable[[np.ndarray], Point]:
    """The model with its rows weighed, and then its loss."""
    plain = evaluator(problem)

    def evaluate(raw: np.ndarray) -> Point:
        point = plain(raw)
        if weighing is not None:
            point = weighing(point)
        return point if problem.loss == "linear" else Loss.of(problem, point.residual.size)(point)

    return evaluate


def _descend(
    record: _Record,
    evaluate: Callable[[np.ndarray], Point],
    max_steps: int,
    tolerance: float,
    asked: threading.Event,
) -> Fit:
    walk, secant = Walk(record.box), Secant(record.box)
    trial, waiting = walk.begin(record.best), None
    while record.gradient > tolerance:
        if asked.is_set():
            return record.end(RESULTS.interrupted, f"stopped by hand after {record.steps} steps")
        if record.steps == max_steps:
            return record.end(RESULTS.no_optimum, f"no optimum in {max_steps} steps (relative gradient {record.gradient:.1e})")
        clock = time.perf_counter()
        point = evaluate(trial).reached_from(record.best)
        record.steps, record.evaluations = record.steps + 1, record.evaluations + 1
        secant.learn(point, record.best)
        trial, waiting, accepted = _next(record, walk, secant, point, waiting)
        record.note(point, accepted, time.perf_counter() - clock)
        if record.refused == REFUSED:
            return record.end(RESULTS.not_converged, _failure(f"at {REFUSED} trial points", point))
        if _stalled(record, trial):
            return _at_a_stand(record)
        if record.on_an_edge():
            return record.end(RESULTS.successful, _edge(record), edge=True)
    return record.end(RESULTS.successful, f"optimum after {record.steps} steps")


def _next(
    record: _Record, walk: Walk, secant: Secant, point: Point, waiting: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Where to look next, where Levenberg-Marquardt would look if that comes from the secant, and whether the point was taken.

    The secant is asked once Levenberg-Marquardt has been refused or nears the optimum slowly, and as long as its steps are good.
    """
    before = record.gradient
    if waiting is None:
        trial, accepted = _judge(record, walk, point)
        ask = point.usable and record.gradient < LEVEL and record.gradient > SLOW * before
    elif _lower(record, point):
        record.take(point)
        trial, accepted, ask = walk.begin(point, walk.step_size), True, True
    else:
        record.stuck += 1
        trial, accepted, ask = waiting, False, False
    proposed = secant.trial(record.best) if ask else None
    return (trial, None, accepted) if proposed is None else (proposed, trial, accepted)


def _lower(record: _Record, point: Point) -> bool:
    """Is the point lower than the best, or, where chi2 no longer tells, closer to level?"""
    if not point.usable:
        return False
    best = record.best.chi2
    return point.chi2 < best * (1 - 1e-10) or (point.chi2 <= best * (1 + 1e-10) and record.slope_at(point) < record.gradient)


def _judge(record: _Record, walk: Walk, point: Point) -> tuple[np.ndarray, bool]:
    """Hand the point to the solver, or take it for its smaller gradient where chi2 no longer tells."""
    polished = _lower(record, point) and point.chi2 > record.best.chi2 * (1 - 1e-10)
    trial = walk.advance(point, record.best)
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
    return record.end(RESULTS.successful if distance <= NEAR else RESULTS.no_optimum, story)


def _edge(record: _Record) -> str:
    """A kink, told with what its sides still promise."""
    return (
        f"optimum after {record.steps} steps, on an edge as where contact opens or closes "
        f"(relative gradient {record.gradient:.1e}, {record.remaining():.1e} standard errors to gain by the slopes of one side)"
    )


def _failure(where: str, point: Point) -> str:
    if point.converged:
        return f"the model gave a number that is not finite {where}"
    return (
        f"a solve inside the model did not converge {where} "
        f"(relative residual {point.solve_residual:.1e} after {point.iterations} iterations)"
    )
