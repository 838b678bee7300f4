"""How often these very data would raise a false alarm, and whether they would show an effect that is there.

Data are made up from the base fit and its noise, and go through the same code: the noise is estimated anew from their repeats, and the
base parameters follow linearly, so that no set costs a run of the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .adequacy import Adequacy, Look, adequacy, bases
from .noise import estimate
from .record import Planted
from .refit import Optimum
from .sample import Sample
from .score import Ranking, Score, rank
from .subject import Family
from .whitening import Whitener

SETS = 200
PLANTED, SIZE = 3, 2.0  # effects planted, in multiples of the smallest that would be seen


@dataclass(frozen=True)
class FalseAlarms:
    """Shares of made-up data, to which nothing is wrong, that a test of adequacy rejects, and whose largest score is significant."""

    sets: int
    rejected: float
    flagged: float


@dataclass(frozen=True, eq=False)
class Machine:
    """Makes data at a base fit and looks at them.

    - `noise` (rows, rows): the covariance by which data are made up. `left` (rows, rows): what the mesh may leave, which is added to it.
    - `columns`: of the subject, at the base.
    """

    base: Look
    families: tuple[Family, ...]
    columns: Mapping[str, Float[np.ndarray, "rows"]]
    noise: Float[np.ndarray, "rows rows"]
    left: Float[np.ndarray, "rows rows"]

    def look(self, random: np.random.Generator, extra: Float[np.ndarray, "rows"] | None = None) -> tuple[Ranking, Adequacy]:
        """One made-up set, with `extra` added to what the model says."""
        best = self.base.best
        drawn = Whitener.of(self.noise + self.left).back(random.standard_normal(len(best.sample.measured)))
        error = drawn if extra is None else drawn + extra
        again = self._again(error, random)
        ranking = rank(again, self.families, self.columns)
        return ranking, adequacy(again, ranking, self.base.critical, *bases(again))

    def _again(self, error: Float[np.ndarray, "rows"], random: np.random.Generator) -> Optimum:
        """The base fit as the made-up data have it, with the noise that their repeats show."""
        best = self.base.best
        sample, rows = best.sample, best.sample.subject.rows
        made = best.at.prediction + sample.offset + error
        covariance = estimate(rows, made).covariance() + self.left
        whiten = Whitener.of(covariance[np.ix_(sample.chosen, sample.chosen)])
        fresh: Sample = replace(sample, measured=made, covariance=covariance, whiten=whiten)
        priors = random.standard_normal(len(sample.subject.priors))
        residual = np.concatenate([whiten(error[sample.chosen]), priors])
        jacobian = fresh.jacobian(best.at, best.raw)
        return replace(best, sample=fresh, residual=residual, jacobian=jacobian)


def false_alarms(
    machine: Machine, *, seed: int, sets: int = SETS, tell: Callable[[float, str], object] = lambda share, what: None
) -> FalseAlarms:  # fmt: skip
    """Null sets through the ranking and the tests of adequacy."""
    random = np.random.default_rng([seed, 1])
    rejected = flagged = 0
    for number in range(sets):
        tell(number / sets, "false alarms")
        ranking, tests = machine.look(random)
        rejected += tests.rejected
        flagged += ranking.largest > machine.base.critical.value
    return FalseAlarms(sets, rejected / sets if sets else math.nan, flagged / sets if sets else math.nan)


def planted(machine: Machine, *, seed: int) -> list[Planted]:
    """Effects of twice the smallest detectable size, put into made-up data through the model itself, and whether they were found."""
    random = np.random.default_rng([seed, 2])
    found = []
    for score in _worth_planting(machine.base):
        extra = _grown(machine.base, score)
        if extra is not None:
            ranking, _ = machine.look(random, extra)
            names = [one.family.name for one in ranking.scores]
            seen = ranking[score.family.name].statistic > machine.base.critical.value
            found.append(Planted(score.family.name, SIZE, bool(seen), names.index(score.family.name) + 1))
    return found


def _size(base: Look, score: Score) -> float:
    """From null, in the unit of the first column; its sign is the one that is possible."""
    column = score.nodes[0].columns[0]
    return SIZE * score.smallest(base.critical.value) * (column.sign or 1)


def _worth_planting(base: Look) -> Sequence[Score]:
    """The easiest, the middle and the hardest of the effects of which twice the smallest detectable size is plausible."""
    fitting = [
        score
        for score in base.ranking.testable
        if (column := score.nodes[0].columns[0]).lower <= column.null + _size(base, score) <= column.upper
    ]
    fitting.sort(key=lambda score: abs(_size(base, score)) / score.nodes[0].columns[0].scale)
    if len(fitting) <= PLANTED:
        return fitting
    return [fitting[0], fitting[len(fitting) // 2], fitting[-1]]


def _grown(base: Look, score: Score) -> Float[np.ndarray, "rows"] | None:
    """What an effect adds to the prediction; None where the model has no answer."""
    column, best = score.nodes[0].columns[0], base.best
    at = best.sample.subject.value(best.raw, {column.key: column.null + _size(base, score)})
    return at.prediction - best.at.prediction if at.usable else None
