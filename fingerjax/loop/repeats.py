"""What the repeats of one measurement say of its noise: its size, what a whole trial has in common, and rows that stand out.

    y = mean of the setting + trace (gain, zero) + e,      var e = law(mean)

A trace is what one trial recorded of one condition. Outliers are known by their disagreement with their own repeats, so that a large
misfit of the model is never taken for one; they are weighed down, as Student's t does far out, and kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, stats

TURN = 3.0  # standard deviations from which on a row counts less, by the square of what it is beyond
CLEAR = 3.0  # standard errors from which on neighbours count as correlated
ROUNDS = 6  # of weights, traces and sizes in turn
SHORTEST = 4  # rows of a trace from which a gain and a zero of its own can be told from noise
FLAT = 0.1  # of a trace: smaller over larger singular value of (gain, zero), where its values differ by less than a fifth
SEEN = 0.2  # probability by chance below which trials, or traces, are taken to have gains and zeros of their own
SURE = 0.995  # quantile at which the variance that few trials tell is made wide enough
CLEARLY = 10.0  # fall of the deviance at which a noise that grows with the value is believed where none is expected
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


def from_repeats(
    measured: Float[np.ndarray, "rows"],
    setting: Int[np.ndarray, "rows"],
    condition: Int[np.ndarray, "rows"],
    trial: Int[np.ndarray, "rows"],
    along: Float[np.ndarray, "rows"],
    power: float,
    expected: bool,
) -> Repeats | None:
    """The noise of one block, or None where no setting is repeated, or all repeats are copies.

    **Arguments:** `setting`, `condition`, `trial`: numbers that rows of the same one share; `along`: the coordinate that orders a trace;
    `power`: the noise's variance is a + b mean^power, with b = 0 unless it is `expected` or clearly seen.
    """
    count = np.bincount(setting)[setting]
    if not (count > 1).any():
        return None
    _, traces = np.unique(np.stack([condition, trial]), axis=1, return_inverse=True)
    traces = traces.reshape(-1)
    if not np.any(measured != _first_of(measured, setting)):
        return None
    block = _Block(measured, setting, condition, trial, traces, count, power, expected)
    split = block.first()
    for _ in range(ROUNDS):
        split = block.again(split)
    shared, own, widening = block.levels(split)
    near = _neighbours(np.where(count > 1, split.left / split.sigma, 0.0), traces, along, len(split.pairs))
    return Repeats(split.sigma, split.weights, split.centre, shared, own, widening, near, split.dof)


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


def _first_of(measured: np.ndarray, setting: np.ndarray) -> np.ndarray:
    """(rows,) the first row of each row's setting."""
    return measured[np.unique(setting, return_index=True)[1]][setting]


def _basis(centre: np.ndarray) -> np.ndarray:
    """(rows, 2): what a gain and a zero of one unit add."""
    return np.stack([centre, np.ones_like(centre)], axis=1)


def _inverse(centre: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, int]:
    """((2, rows), rank): from deviations to (gain, zero) by weighted least squares. Of a trace that is nearly flat, where a gain and a
    zero are the same, the smallest pair that does.
    """
    basis, root = _basis(centre), np.sqrt(weights)
    scale = np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
    left, singular, right = np.linalg.svd(root[:, None] * basis / scale, full_matrices=False)
    kept = singular > FLAT * singular[0]
    return (right[kept].T / singular[kept] / scale[:, None]) @ left[:, kept].T * root, int(kept.sum())


@dataclass(frozen=True, eq=False)
class _Block:
    measured: np.ndarray
    setting: np.ndarray
    condition: np.ndarray
    trial: np.ndarray
    traces: np.ndarray
    count: np.ndarray  # repeats of each row's setting
    power: float
    expected: bool

    def first(self) -> _Split:
        """About the medians of the settings, all rows equal."""
        medians = np.array([np.median(self.measured[self.setting == one]) for one in range(self.setting.max() + 1)])
        return self._split(medians[self.setting], np.ones(len(self.measured)))

    def again(self, before: _Split) -> _Split:
        """About means in which rows that stand out count less."""
        size = before.sigma * math.sqrt(max(before.dof, 1.0) / max(int((self.count > 1).sum()), 1))
        weights = np.minimum(1.0, TURN * size / np.maximum(np.abs(before.left), 1e-300)) ** 2
        sums = np.bincount(self.setting, weights * (self.measured - before.common))
        return self._split((sums / np.bincount(self.setting, weights))[self.setting], weights)

    def _split(self, centre: np.ndarray, weights: np.ndarray) -> _Split:
        pairs = self._pairs(self.measured - centre, centre, weights)
        common = np.zeros(len(centre))
        for one, pair in pairs.items():
            common[self.traces == one] = _basis(centre[self.traces == one]) @ pair
        left = self.measured - centre - common
        dof = float(np.sum(1.0 - 1.0 / self.count)) - self._spent(pairs, centre)
        sigma = _law(left, centre, weights, self.count, dof, self.power, self.expected)
        return _Split(centre, common, left, pairs, sigma, weights, dof)

    def _pairs(self, deviation: np.ndarray, centre: np.ndarray, weights: np.ndarray) -> dict[int, np.ndarray]:
        """Trace -> (gain, zero) by weighted least squares; the smallest where they cannot be told apart."""
        found = {}
        for one in range(self.traces.max() + 1):
            rows = np.flatnonzero((self.traces == one) & (self.count > 1))
            if len(rows) >= SHORTEST:
                found[one] = _inverse(centre[rows], weights[rows])[0] @ deviation[rows]
        return found

    def _spent(self, pairs: dict[int, np.ndarray], centre: np.ndarray) -> float:
        """Degrees of freedom that the traces took, less those that the means of the settings had taken already."""
        spent = 0.0
        for one in np.unique(self.condition):
            ranks = [self._rank(trace, centre) for trace in set(self.traces[self.condition == one].tolist()) & set(pairs)]
            spent += sum(ranks) * (1.0 - 1.0 / max(len(ranks), 1))
        return spent

    def _rank(self, trace: int, centre: np.ndarray) -> int:
        rows = (self.traces == trace) & (self.count > 1)
        return _inverse(centre[rows], np.ones(int(rows.sum())))[1]

    def levels(self, split: _Split) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
        """Covariances of (gain, zero) by moments: what trials have in common between conditions, and the rest; their widening. What is not
        seen is none: a few trials always have something in common by chance, which made as wide as few trials demand would hide effects.
        """
        if not split.pairs:
            return np.zeros((2, 2)), np.zeros((2, 2)), (1.0, 1.0)
        where = {one: tuple(int(code[self.traces == one][0]) for code in (self.condition, self.trial)) for one in split.pairs}
        metric, noise, whole = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2))
        alone: dict[int, np.ndarray] = {}
        for one, pair in split.pairs.items():
            rows = (self.traces == one) & (self.count > 1)
            variance = split.sigma[rows] ** 2 / split.weights[rows]
            basis, inverse = _basis(split.centre[rows]), _inverse(split.centre[rows], split.weights[rows])[0]
            repeats = float(np.mean(self.count[rows]))
            metric += basis.T @ (basis / variance[:, None]) / len(where)
            alone[one] = (inverse * variance) @ inverse.T
            noise += alone[one] / len(where)
            whole += np.outer(pair, pair) * repeats / (repeats - 1.0) / len(where)
        shared, trials = _between(split.pairs, where, self.count, self.traces)
        root = np.linalg.cholesky(metric + 1e-12 * np.diag(np.diag(metric)) + 1e-300 * np.eye(2))
        shared = _positive(shared, root)
        own = _positive(whole - noise - shared, root)
        apart, _ = _told(split.pairs, where, alone)
        own = own if _seen(*apart) else np.zeros((2, 2))
        _, together = _told(split.pairs, where, {one: each + own for one, each in alone.items()})
        shared = shared if _seen(*together) else np.zeros((2, 2))
        conditions = len({one[0] for one in where.values()})
        return shared, own, (_widening(trials - 1), _widening(len(where) - conditions))


def _law(
    left: np.ndarray, centre: np.ndarray, weights: np.ndarray, count: np.ndarray, dof: float, power: float, expected: bool
) -> Float[np.ndarray, "rows"]:
    """(rows,) standard deviations: the root of a + b mean^power, fitted to the squares of what is left."""
    use = count > 1
    square = (weights[use] * left[use]) ** 2 / _KEPT * (use.sum() / max(dof, 1.0))
    flat = float(np.mean(square))
    grown = np.abs(centre) ** power
    share = np.stack([np.ones(int(use.sum())), grown[use] / max(float(np.mean(grown[use])), 1e-300)], axis=1)
    law = np.array([flat, 0.0])
    for _ in range(4):
        size = np.maximum(share @ law, 1e-3 * flat) + 1e-300
        law = optimize.nnls(share / size[:, None], square / size)[0]
    size = np.maximum(share @ law, 1e-2 * flat) + 1e-300
    gain = np.sum(np.log(max(flat, 1e-300)) + square / max(flat, 1e-300)) - np.sum(np.log(size) + square / size)
    if not (expected or gain * dof / use.sum() > CLEARLY):
        law = np.array([flat, 0.0])
    everywhere = law[0] + law[1] * grown / max(float(np.mean(grown[use])), 1e-300)
    return np.sqrt(np.maximum(everywhere, 1e-2 * flat) + 1e-300)


def _between(
    pairs: dict[int, np.ndarray], where: dict[int, tuple[int, ...]], count: np.ndarray, traces: np.ndarray
) -> tuple[np.ndarray, int]:
    """Mean product of the traces of one trial in two conditions, and the number of trials that have two."""
    total, met, trials = np.zeros((2, 2)), 0, set()
    for one, (condition, trial) in where.items():
        for other, (elsewhere, again) in where.items():
            if again == trial and elsewhere != condition:
                repeats = float(np.mean(count[traces == one]))
                product = np.outer(pairs[one], pairs[other])
                total += 0.5 * (product + product.T) * repeats / (repeats - 1.0)
                met += 1
                trials.add(trial)
    return (total / met if met else total), len(trials)


def _told(
    pairs: dict[int, np.ndarray], where: dict[int, tuple[int, ...]], spread: dict[int, np.ndarray]
) -> tuple[tuple[float, int], tuple[float, int]]:
    """Squares of what traces have that their trial's other traces do not, and of what those of a trial have in common, each with its
    degrees of freedom: chi-square where pairs have no more than their `spread`.
    """
    trials = {trial for _, trial in where.values()}
    met = {condition: sum(other == condition for other, _ in where.values()) for condition, _ in where.values()}
    sums, total = {trial: np.zeros(2) for trial in trials}, np.zeros((2, 2))
    whole, freedom = 0.0, 0.0
    for one, (condition, trial) in where.items():
        precise, rank = _inverted(spread[one])
        whole += float(pairs[one] @ precise @ pairs[one])
        freedom += rank * (1.0 - 1.0 / met[condition])
        sums[trial] += precise @ pairs[one]
        total += precise / len(trials)
    common, rank = _inverted(total)
    shared = sum(float(each @ common @ each) for each in sums.values())
    some = rank * (len(trials) - 1)
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
