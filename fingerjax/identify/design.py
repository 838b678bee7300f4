"""Which indentation to make next: the few that cut a chosen uncertainty most, with the intervals before and after.

    M = M_0 + sum over chosen k of J_k' J_k / sigma^2,      V = M^-1

M_0 is what the fit knows, J_k what an indentation would see at the fitted values. Criteria, all to be made least:

    D   log det V            the volume of the region that all parameters are known to lie in
    A   trace V              the mean variance of their logarithms
    c   c' V c               the variance of one of them, or of one ratio

Fedorov, Theory of Optimal Experiments (1972). A parameter that the data do not see at all is taken to be known to a factor of a thousand
beforehand, so that every number is finite. Predictions are local: they hold where the model is nearly linear over the intervals.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ..forward import assemble
from ..measurements import Measurement
from ..study import Study
from ..study_design import targets
from .evaluation import evaluator
from .fit import Fit
from .uncertainty import uncertainty

CRITERIA = ("D", "A", "c")
BEFOREHAND = math.log(1000.0) / 1.96  # standard deviation of a raw parameter that nothing is known of
Judge = Callable[[np.ndarray], np.ndarray]
MOST = 60_000  # sets that are tried one by one; above, the best is grown one by one and then exchanged


@dataclass(frozen=True)
class Choice:
    """A set of indentations, by name, repeated where a name is there twice; `criterion` and covariance (p, p) once they are made."""

    names: tuple[str, ...]
    criterion: float
    covariance: np.ndarray


@dataclass(frozen=True)
class Recommendation:
    """What to do next.

    - `before`: the empty choice. `singles`: every indentation by itself, best first. `best`: the best set of 1, 2, ... indentations.
    - `t`: by which standard errors are widened to intervals.
    """

    fit: Fit
    criterion: str
    target: str | None
    before: Choice
    singles: tuple[Choice, ...]
    best: tuple[Choice, ...]
    t: float

    def ranking(self) -> list[dict[str, object]]:
        """Rows: indentation, criterion, and by what factor it narrows the target's (or the mean) interval."""
        rows: list[dict[str, object]] = []
        for one in self.singles:
            rows.append({"indentation": one.names[0], "criterion": one.criterion, "interval_times": self.narrowing(one)})
        return rows

    def narrowing(self, choice: Choice) -> float:
        """Standard error after over before: of the target, or the geometric mean of all."""
        weights = weights_of(self.target, self.fit.problem.names)
        if weights is not None:
            return math.sqrt(float(weights @ choice.covariance @ weights) / float(weights @ self.before.covariance @ weights))
        ratio = choice.covariance.diagonal() / self.before.covariance.diagonal()
        return float(np.exp(0.5 * np.mean(np.log(ratio))))

    def intervals(self, choice: Choice) -> list[dict[str, object]]:
        """Rows: parameter, value, the predicted ends before and after."""
        rows: list[dict[str, object]] = []
        for j, parameter in enumerate(self.fit.problem.parameters):
            ends = {}
            for when, covariance in (("before", self.before.covariance), ("after", choice.covariance)):
                half = self.t * math.sqrt(covariance[j, j])
                for side, sign in (("lower", -1), ("upper", 1)):
                    ends[f"{side}_{when}"] = float(parameter.natural(self.fit.raw[j] + sign * half))
            rows.append({"parameter": parameter.name, "value": self.fit.best[parameter.name], "unit": parameter.unit, **ends})
        return rows


def recommend(
    fit: Fit, candidates: Mapping[str, np.ndarray], *, criterion: str = "D", target: str | None = None, choose: int = 3
) -> Recommendation:
    """Choose among indentations.

    **Arguments:** `candidates`: by name, the whitened Jacobian (readings, p) that an indentation would add, in raw parameters, as
    `jacobians` makes them; `target`: for criterion c, a parameter, or two with a stroke between them; `choose`: the most to be made.

    **Raises** `ValueError` for an unknown criterion or target, or a fit that is not settled.
    """
    if criterion not in CRITERIA:
        raise ValueError(f"unknown criterion {criterion!r}; choose one of {', '.join(CRITERIA)}")
    if (criterion == "c") != (target is not None):
        raise ValueError("criterion c aims at one target, and no other does: give both, or neither")
    if not fit.settled:
        raise ValueError(f"the fit is not settled ({fit.reason}): there is nothing to design around")
    known, names = uncertainty(fit), list(candidates)
    information = np.stack([J.T @ J for J in candidates.values()])
    start, judge = information_of(fit), _judge(criterion, weights_of(target, fit.problem.names))

    def choice(which: tuple[int, ...]) -> Choice:
        covariance = np.linalg.inv(start + information[list(which)].sum(axis=0))
        return Choice(tuple(names[k] for k in which), float(judge(covariance[None])[0]), covariance)

    singles = sorted((choice((k,)) for k in range(len(names))), key=lambda one: one.criterion)
    best = tuple(choice(_best(start, information, size, judge)) for size in range(1, choose + 1))
    return Recommendation(fit, criterion, target, choice(()), tuple(singles), best, known.t if known.t == known.t else 1.96)


def information_of(fit: Fit) -> np.ndarray:
    """(p, p): what the fit knows of its raw parameters, assumed noise taken as large as the residuals say."""
    known = uncertainty(fit)
    scale = known.covariance.diagonal() / known.unscaled.diagonal()
    s2 = float(np.nanmedian(scale)) if np.isfinite(scale).any() else 1.0
    return fit.jacobian.T @ fit.jacobian / s2 + np.eye(fit.raw.size) / BEFOREHAND**2


def weights_of(target: str | None, names: tuple[str, ...]) -> np.ndarray | None:
    """(p,): +1 for the target, -1 for what it is divided by; None where there is no target."""
    if target is None:
        return None
    weights = np.zeros(len(names))
    for sign, name in zip((1.0, -1.0), targets(target), strict=False):
        if name not in names:
            raise ValueError(f"no free parameter {name!r} to aim at; there are {', '.join(names)}")
        weights[names.index(name)] += sign
    return weights


def _judge(criterion: str, weights: np.ndarray | None) -> Judge:
    """Covariances (k, p, p) -> (k,) to be made least."""
    if criterion == "D":
        return lambda V: np.linalg.slogdet(V)[1]
    if criterion == "A":
        return lambda V: np.trace(V, axis1=1, axis2=2)
    assert weights is not None, "criterion c has a target"
    return lambda V: np.einsum("i,kij,j->k", weights, V, weights)


def _best(start: np.ndarray, information: np.ndarray, size: int, judge: Judge) -> tuple[int, ...]:
    count = len(information)
    if math.comb(count + size - 1, size) <= MOST:
        sets = np.array(list(itertools.combinations_with_replacement(range(count), size)))
        return tuple(int(k) for k in sets[int(np.argmin(_values(start, information, sets, judge)))])
    chosen: list[int] = []
    for _ in range(size):
        chosen.append(_next(start, information, chosen, judge))
    for place in range(size):
        rest = chosen[:place] + chosen[place + 1 :]
        chosen = [*rest[:place], _next(start, information, rest, judge), *rest[place:]]
    return tuple(sorted(chosen))


def _next(start: np.ndarray, information: np.ndarray, chosen: list[int], judge: Judge) -> int:
    sets = np.array([[*chosen, k] for k in range(len(information))])
    return int(np.argmin(_values(start, information, sets, judge)))


def _values(start: np.ndarray, information: np.ndarray, sets: np.ndarray, judge: Judge) -> np.ndarray:
    return judge(np.linalg.inv(start + information[sets].sum(axis=1)))


def jacobians(study: Study, fit: Fit, candidates: tuple[Measurement, ...]) -> dict[str, np.ndarray]:
    """What each possible indentation would see: its whitened Jacobian (readings, p) at the fitted values, by `NAME at DEPTH mm`.

    All are laid out on one mesh, fine where any of them needs it, and read in one pass.

    **Raises** `ValueError` where a solve or a contact in it did not end well.
    """
    planned = dataclasses.replace(study, measurements=candidates, fit=dataclasses.replace(study.fit, priors={}, per={}))
    assembled = assemble(planned)
    problem = assembled.problem()
    values = {name: value for name, value in fit.best.items() if name in problem.names}
    missing = [name for name in problem.names if name not in values]
    if missing:
        raise ValueError(f"the fit has no value of {', '.join(missing)}: one value must hold for the whole finger that is measured next")
    raw = np.array([one.raw(values[one.name]) for one in problem.parameters])
    point = evaluator(problem)(raw)
    if not point.usable:
        raise ValueError("a candidate could not be computed at the fitted values: press less deep, or move it away from the finger's end")
    parts = _indentations(candidates, problem.blocks)
    return {name: _placed(point.jacobian[rows], problem.names, fit.problem.names) for name, rows in parts}


def _indentations(candidates: tuple[Measurement, ...], blocks: dict[str, slice]) -> list[tuple[str, np.ndarray]]:
    found = []
    for one in candidates:
        imposed = one.table[one.imposed]
        rows = np.arange(blocks[one.name].start, blocks[one.name].stop)
        found += [(f"{one.name} at {depth:g} mm", rows[imposed == depth]) for depth in np.unique(imposed)]
    return found


def _placed(jacobian: np.ndarray, names: tuple[str, ...], wanted: tuple[str, ...]) -> np.ndarray:
    """Columns in the order of the fit; zero for parameters that no mechanical reading sees (an afferent's)."""
    placed = np.zeros((len(jacobian), len(wanted)))
    for j, name in enumerate(names):
        placed[:, wanted.index(name)] = jacobian[:, j]
    return placed
