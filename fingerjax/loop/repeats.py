"""What the repeats of one measurement say of its noise: its size, what a whole trial has in common, and rows that stand out.

    y = mean of the setting + trace (gain, zero) + e,      var e = law(mean)

A trace is what one trial recorded of one condition. Outliers are known by their disagreement with their own repeats, so that a large
misfit of the model is never taken for one; they are weighed down, as Student's t does far out, and kept.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

TURN = 3.0  # standard deviations from which on a row counts less, by the square of what it is beyond
CLEAR = 3.0  # standard errors from which on neighbours count as correlated
ROUNDS = 6  # of weights, traces and sizes in turn
SHORTEST = 4  # rows of a trace from which a gain and a zero of its own can be told from noise
FLAT = 0.1  # of a trace: smaller over larger singular value of (gain, zero), where its values differ by less than a fifth
SEEN = 0.2  # probability by chance below which trials, or traces, are taken to have gains and zeros of their own
SURE = 0.995  # quantile at which the variance that few trials tell is made wide enough
GROWING = 20  # laws of noise that are averaged: so many of which a share of the variance grows with the value, and one that is flat
# Share of the normal variance that is left under these weights: x^2 within TURN, TURN^4 / x^2 beyond.
_KEPT = float(
    1 - 2 * stats.norm.sf(TURN) - 2 * TURN * stats.norm.pdf(TURN) + 2 * TURN**4 * (stats.norm.pdf(TURN) / TURN - stats.norm.sf(TURN))
)


@dataclass(frozen=True, eq=False)
class Repeats:
    """The noise of one block as its repeats have it.

    - `sigma` (rows,): standard deviation of a single row; `weights` (rows,): 1, less for rows that stand out.
    - `centre` (rows,): the weighted mean of the setting.
    - `trial`, `trace` (2, 2): covariance of (gain, zero) that a trial has in all its conditions, and that each trace has of its own;
      `widening`: of both, as Student's interval is wider, because few trials tell their own variance badly.
    - `neighbours`: correlation of neighbouring rows of a trace. `dof`: degrees of freedom behind `sigma`.
    """

    sigma: Float[np.ndarray, "rows"]
    weights: Float[np.ndarray, "rows"]
    centre: Float[np.ndarray, "rows"]
    trial: Float[np.ndarray, "2 2"]
    trace: Float[np.ndarray, "2 2"]
    widening: tuple[float, float]
    neighbours: float
    dof: float


@dataclass(frozen=True, eq=False)
class Recorded:
    """One block as it was recorded, (rows,) each.

    - `setting`, `condition`, `trial`: numbers that rows of the same one share. `along`: the coordinate that orders a trace.
    """

    measured: Float[np.ndarray, "rows"]
    setting: Int[np.ndarray, "rows"]
    condition: Int[np.ndarray, "rows"]
    trial: Int[np.ndarray, "rows"]
    along: Float[np.ndarray, "rows"]

    @property
    def repeated(self) -> bool:
        """Whether a setting is, and not all repeats are copies."""
        first = self.measured[np.unique(self.setting, return_index=True)[1]][self.setting]
        return bool(np.any(self.measured != first))


def from_repeats(recorded: Mapping[str, Recorded], power: float, expected: bool) -> dict[str, Repeats]:
    """The noise of blocks that one kind of instrument recorded, without those whose repeats tell nothing.

    What trials and traces have in common is asked of all blocks together, gains as shares and zeros in units of what a block reads: a few
    trials of one block would tell it badly.

    **Arguments:** `power`: the noise's variance is a + b mean^power, in each block with an a and b of its own; `expected`: b is not 0.
    """
    blocks = {name: _Block.of(one, power, expected) for name, one in recorded.items() if one.repeated}
    splits = {name: block.split() for name, block in blocks.items()}
    traces = [trace for name, block in blocks.items() for trace in block.pairs_of(splits[name], name)]
    shared, own, widening = _levels(traces)
    if traces and not (shared.any() or own.any()):
        splits = {name: replace(block, apart=False).split() for name, block in blocks.items()}
    return {name: _repeats(block, splits[name], shared, own, widening) for name, block in blocks.items()}


def _repeats(
    block: _Block, split: _Split, shared: Float[np.ndarray, "2 2"], own: Float[np.ndarray, "2 2"], widening: tuple[float, float]
) -> Repeats:
    left = np.where(block.count > 1, split.left / split.sigma, 0.0)
    near = _neighbours(left, block.traces, block.along, len(split.pairs))
    unit = np.array([1.0, block.size(split)])
    trial, trace = (np.outer(unit, unit) * each for each in (shared, own))
    return Repeats(split.sigma, split.weights, split.centre, trial, trace, widening, near, split.dof)


@dataclass(frozen=True, eq=False)
class _Split:
    """The rows taken apart: centre, what their trace adds (`pairs`: trace -> gain, zero; `common`), and what is left."""

    centre: np.ndarray
    common: np.ndarray
    left: np.ndarray
    pairs: dict[int, np.ndarray]
    sigma: np.ndarray
    weights: np.ndarray
    dof: float


def _basis(centre: np.ndarray) -> np.ndarray:
    """(rows, 2): what a gain and a zero of one unit add."""
    return np.stack([centre, np.ones_like(centre)], axis=1)


def _inverse(centre: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(2, rows): from deviations to (gain, zero) by weighted least squares. Of a trace that is nearly flat, where a gain and a zero are
    the same, the smallest pair that does.
    """
    basis, root = _basis(centre), np.sqrt(weights)
    scale = np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
    left, singular, right = np.linalg.svd(root[:, None] * basis / scale, full_matrices=False)
    kept = singular > FLAT * singular[0]
    return (right[kept].T / singular[kept] / scale[:, None]) @ left[:, kept].T * root


@dataclass(frozen=True, eq=False)
class _Trace:
    """What one trace adds to its settings' means: (gain, zero), the zero in units of what its block reads.

    - `spread` (2, 2): what noise alone makes of the pair; `metric` (2, 2): B' B of its rows in standard deviations. `repeats`: of its rows.
    """

    condition: tuple[str, int]
    trial: tuple[str, int]
    pair: Float[np.ndarray, "2"]
    spread: Float[np.ndarray, "2 2"]
    metric: Float[np.ndarray, "2 2"]
    repeats: float

    @property
    def grown(self) -> float:
        """Variance of a trace over that of what is left of it when the mean of all repeats is taken off."""
        return self.repeats / (self.repeats - 1.0)


@dataclass(frozen=True, eq=False)
class _Block:
    measured: np.ndarray
    setting: np.ndarray
    condition: np.ndarray
    trial: np.ndarray
    along: np.ndarray
    traces: np.ndarray
    count: np.ndarray  # repeats of each row's setting
    power: float
    expected: bool
    apart: bool = True  # whether traces may have gains and zeros of their own

    @classmethod
    def of(cls, one: Recorded, power: float, expected: bool) -> _Block:
        _, traces = np.unique(np.stack([one.condition, one.trial]), axis=1, return_inverse=True)
        count = np.bincount(one.setting)[one.setting]
        return cls(one.measured, one.setting, one.condition, one.trial, one.along, traces.reshape(-1), count, power, expected)

    def size(self, split: _Split) -> float:
        """What the block reads, root mean square."""
        return max(float(np.sqrt(np.mean(split.centre[self.count > 1] ** 2))), 1e-300)

    def split(self) -> _Split:
        """The rows taken apart, about means in which rows that stand out count less."""
        split = self._first()
        for _ in range(ROUNDS):
            split = self._again(split)
        return split

    def _first(self) -> _Split:
        """About the medians of the settings, all rows equal."""
        medians = np.array([np.median(self.measured[self.setting == one]) for one in range(self.setting.max() + 1)])
        return self._about(medians[self.setting], np.ones(len(self.measured)))

    def _again(self, before: _Split) -> _Split:
        size = before.sigma * math.sqrt(max(before.dof, 1.0) / max(int((self.count > 1).sum()), 1))
        weights = np.minimum(1.0, TURN * size / np.maximum(np.abs(before.left), 1e-300)) ** 2
        sums = np.bincount(self.setting, weights * (self.measured - before.common))
        return self._about((sums / np.bincount(self.setting, weights))[self.setting], weights)

    def _about(self, centre: np.ndarray, weights: np.ndarray) -> _Split:
        common, kept, pairs = np.zeros(len(centre)), 1.0 - 1.0 / self.count, {}
        for one, rows in self._long().items():
            inverse = _inverse(centre[rows], weights[rows])
            basis = _basis(centre[rows])
            pairs[one] = inverse @ (self.measured - centre)[rows]
            common[rows] = basis @ pairs[one]
            kept[rows] *= 1.0 - np.sum(basis * inverse.T, axis=1)
        left = self.measured - centre - common
        sigma = _law(left, kept, centre, weights, self.power, self.expected)
        return _Split(centre, common, left, pairs, sigma, weights, float(kept.sum()))

    def _long(self) -> dict[int, np.ndarray]:
        """Trace -> its repeated rows, of traces with enough of them to have a gain and a zero."""
        rows = {one: np.flatnonzero((self.traces == one) & (self.count > 1)) for one in range(self.traces.max() + 1)}
        return {one: each for one, each in rows.items() if self.apart and len(each) >= SHORTEST}

    def pairs_of(self, split: _Split, name: str) -> list[_Trace]:
        """What its traces add, where they are long enough to tell."""
        unit, found = np.array([1.0, self.size(split)]), []
        for one, rows in self._long().items():
            variance = split.sigma[rows] ** 2 / split.weights[rows]
            basis, inverse = _basis(split.centre[rows]), _inverse(split.centre[rows], split.weights[rows])
            spread, metric = (inverse * variance) @ inverse.T, basis.T @ (basis / variance[:, None])
            units, repeats = np.outer(unit, unit), float(np.mean(self.count[rows]))
            condition, trial = ((name, int(code[rows][0])) for code in (self.condition, self.trial))
            found.append(_Trace(condition, trial, split.pairs[one] / unit, spread / units, metric * units, repeats))
        return found


def _levels(traces: list[_Trace]) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Covariances of (gain, zero) by moments: what trials have in common between conditions, and the rest; their widening. What is not
    seen is none: a few trials always have something in common by chance, which made as wide as few trials demand would hide effects.
    """
    none = np.zeros((2, 2))
    if not traces:
        return none, none, (1.0, 1.0)
    metric, noise = (sum((getattr(one, name) for one in traces), none) / len(traces) for name in ("metric", "spread"))
    whole = sum((one.grown * np.outer(one.pair, one.pair) for one in traces), none) / len(traces)
    shared, trials = _between(traces)
    root = np.linalg.cholesky(metric + 1e-12 * np.diag(np.diag(metric)) + 1e-300 * np.eye(2))
    shared = _positive(shared, root)
    own = _positive(whole - noise - shared, root)
    apart, _ = _told(traces, none)
    own = own if _seen(*apart) else none
    _, together = _told(traces, own)
    shared = shared if _seen(*together) else none
    conditions = len({one.condition for one in traces})
    return shared, own, (_widening(trials - 1), _widening(len(traces) - conditions))


def _law(
    left: Float[np.ndarray, "rows"],
    kept: Float[np.ndarray, "rows"],
    centre: Float[np.ndarray, "rows"],
    weights: Float[np.ndarray, "rows"],
    power: float,
    expected: bool,
) -> Float[np.ndarray, "rows"]:
    """(rows,) standard deviations: the root of a + b mean^power, averaged over b's share as the squares of what is left speak for it. Of
    few repeats the likeliest law has a or b be nothing as a rule, and some rows would count as many times surer than they are. Where no
    growth is expected none is as likely beforehand as any.

    **Arguments:** `kept`: share of a row's variance that is left when the mean of its setting, and its trace, are taken off it.
    """
    use = kept > 1e-6
    square, dof = (weights[use] * left[use]) ** 2 / _KEPT, kept[use]
    grown = np.abs(centre) ** power
    grown = grown / max(float(np.mean(grown[use])), 1e-300)
    share = np.append((np.arange(GROWING) + 0.5) / GROWING, 0.0)
    shape = 1.0 - share + share * grown[:, None]
    level = np.sum(square[:, None] / shape[use], axis=0) / dof.sum() + 1e-300
    speaks = -0.5 * (dof.sum() * np.log(level) + dof @ np.log(shape[use]))
    likely = np.exp(speaks - speaks.max()) * np.append(np.ones(GROWING), 0.0 if expected else GROWING)
    return np.sqrt(shape @ (likely * level) / likely.sum())


def _between(traces: list[_Trace]) -> tuple[Float[np.ndarray, "2 2"], int]:
    """Mean product of the traces of one trial in two conditions, and the number of trials that have two."""
    total, met, trials = np.zeros((2, 2)), 0, set()
    for one in traces:
        for other in traces:
            if other.trial == one.trial and other.condition != one.condition:
                product = np.outer(one.pair, other.pair)
                total += 0.5 * (product + product.T) * one.grown
                met += 1
                trials.add(one.trial)
    return (total / met if met else total), len(trials)


def _told(traces: list[_Trace], added: Float[np.ndarray, "2 2"]) -> tuple[tuple[float, int], tuple[float, int]]:
    """Squares of what traces have that their trial's other traces do not, and of what those of a trial have in common, each with its
    degrees of freedom: chi-square where pairs have no more than their spread and what is `added` to it. A trial's only trace has what it
    has for itself.
    """
    met, several = Counter(one.condition for one in traces), Counter(one.trial for one in traces)
    whole, freedom, shared, some = 0.0, 0.0, 0.0, 0
    common: dict[str, dict[tuple[str, int], list[np.ndarray]]] = {}
    for one in traces:
        precise, rank = _inverted(one.spread + added)
        whole += float(one.pair @ precise @ one.pair)
        freedom += rank * (1.0 - 1.0 / met[one.condition])
        if several[one.trial] > 1:
            sums = common.setdefault(one.trial[0], {}).setdefault(one.trial, [np.zeros(2), np.zeros((2, 2))])
            sums[0] += precise @ one.pair
            sums[1] += precise
    for trials in common.values():
        spread, rank = _inverted(np.mean([precise for _, precise in trials.values()], axis=0))
        shared += sum(float(pair @ spread @ pair) for pair, _ in trials.values())
        some += rank * (len(trials) - 1)
    return (whole - shared, round(freedom) - some), (shared, some)


def _inverted(covariance: np.ndarray) -> tuple[np.ndarray, int]:
    """The pseudo-inverse of a covariance in units of its own, and its rank."""
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    scaled = covariance / np.outer(size, size)
    return np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) / np.outer(size, size), int(np.linalg.matrix_rank(scaled, 1e-9))


def _seen(squares: float, freedom: int) -> bool:
    return freedom > 0 and float(stats.chi2.sf(squares, freedom)) < SEEN


def _positive(matrix: np.ndarray, root: np.ndarray) -> np.ndarray:
    """The part of a symmetric matrix that is a covariance, in the metric root root'."""
    values, vectors = np.linalg.eigh(root.T @ matrix @ root)
    back = np.linalg.solve(root.T, vectors)
    return (back * np.maximum(values, 0.0)) @ back.T


def _widening(dof: int) -> float:
    return float((stats.t.ppf(SURE, max(dof, 1)) / stats.norm.ppf(SURE)) ** 2)


def _neighbours(left: np.ndarray, traces: np.ndarray, along: np.ndarray, fitted: int) -> float:
    """Correlation of neighbours along the traces; 0 where it is not clear. What fitting took is given back."""
    products, squares, pairs = 0.0, 0.0, 0
    for one in range(traces.max() + 1):
        rows = np.flatnonzero(traces == one)
        rows = rows[np.argsort(along[rows], kind="stable")]
        products += float(np.sum(left[rows[1:]] * left[rows[:-1]]))
        squares += float(np.sum(left[rows] ** 2))
        pairs += max(len(rows) - 1, 0)
    if pairs < 20 or squares == 0.0:
        return 0.0
    share = products / squares * len(left) / pairs + (2.0 * fitted / len(left))
    return float(np.clip(share, 0.0, 0.95)) if share > CLEAR / math.sqrt(pairs) else 0.0
