"""Rao's score: what every sleeping effect would explain, from one fit, the base parameters being free to move.

    s~ = Q S,   z = s~' r / |s~|,   expected change = s~' r / |s~|^2,   implied shift of theta = -J^+ S change

An effect on a grid counts by its best node; one that enters by several columns counts by z' (S~' S~)^-1 z, lowered by what more columns
reach by chance; a one-sided effect counts only on its own side. A column of which less than 3 % is left by Q is absorbed: these data
cannot tell it from a change of the base parameters. It is listed with the change that imitates it.

Rao (1948); Silvapulle & Sen, Constrained Statistical Inference (2005) for one-sided tests.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.optimize import lsq_linear

from ..parameters import Parameter
from . import material
from .refit import Optimum
from .subject import Column, Family

LEFT = 0.03  # share of a column's length that Q leaves, below which it is absorbed
FELT = 1e-3  # standard deviations by which a plausible size must move all rows together to be felt at all
POWER = 1.28  # normal quantile of 90 %: how surely the smallest detectable size is detected
_QUANTILE = 0.998  # at which statistics of several columns are made to agree with those of one


@dataclass(frozen=True, eq=False)
class Node:
    """One node of a family's grid: its columns that can be tested, their statistic, and key -> expected change from null.

    `promise`: the fall of the sum of squares that plausible sizes can bring, to first order. Where a residual asks for more of an effect
    than there can be, its statistic is larger than what a refit will find.
    """

    columns: tuple[Column, ...]
    statistic: float
    change: Mapping[str, float]
    promise: float


@dataclass(frozen=True, eq=False)
class Score:
    """One family, ranked.

    - `nodes`: of its grid, best first; none where it cannot be tested, and `reason` says why.
    - `z`: signed where the best node is one column, else its statistic. `statistic`: what is compared with the critical value.
    - `theta_shift` (p,): what the expected change does to the raw base parameters.
    - `left`: |Q S| / |S| of the first column; `length`: |Q S| per unit of it, and `shift_of_unit` (p,) what that does to the parameters.
    - `direction` (sample,): Q S change as a unit vector. `imitation`: the change of base parameters that an absorbed effect passes for.
    - `times_form`: how many times what any model is wrong by the expected change of the prediction is, base parameters moved as well.
    """

    family: Family
    nodes: tuple[Node, ...]
    z: float
    statistic: float
    theta_shift: Float[np.ndarray, "p"]
    left: float
    length: float
    direction: Float[np.ndarray, "sample"]
    reason: str = ""
    imitation: str = ""
    times_form: float = 0.0
    shift_of_unit: Float[np.ndarray, "p"] | None = None

    @property
    def matters(self) -> bool:
        """Whether it is larger than what any model is wrong by."""
        return self.times_form >= material.ENOUGH

    @property
    def testable(self) -> bool:
        return bool(self.nodes)

    @property
    def promising(self) -> Node:
        """The node that promises most."""
        return max(self.nodes, key=lambda node: node.promise)

    @property
    def change(self) -> Mapping[str, float]:
        """Key -> expected change from null at the best node."""
        return self.nodes[0].change if self.nodes else {}

    def smallest(self, critical: float) -> float:
        """The size that these data would have shown with 90 % probability, and that matters, in the unit of the first column; inf where
        none.
        """
        if not self.testable:
            return math.inf
        change = abs(self.change[self.nodes[0].columns[0].key])
        mattering = change * material.ENOUGH / self.times_form if self.times_form > 0 else 0.0
        return max((critical + POWER) / self.length, mattering)


@dataclass(frozen=True, eq=False)
class Ranking:
    """All families at one optimum, best first.

    - `blocks`: for each node of each family that can be tested its columns, and these projected and normalised (sample, k).
    """

    scores: tuple[Score, ...]
    blocks: tuple[tuple[tuple[Column, ...], Float[np.ndarray, "sample _"]], ...]

    def __getitem__(self, family: str) -> Score:
        return next(score for score in self.scores if score.family.name == family)

    @property
    def testable(self) -> tuple[Score, ...]:
        return tuple(score for score in self.scores if score.testable)

    @property
    def promising(self) -> tuple[Score, ...]:
        """Those that can be tested, by what plausible sizes of them promise."""
        return tuple(sorted(self.testable, key=lambda score: -score.promising.promise))

    @property
    def absorbed(self) -> tuple[Score, ...]:
        return tuple(score for score in self.scores if score.imitation)

    @property
    def largest(self) -> float:
        """Statistic, of those that matter."""
        return max((score.statistic for score in self.testable if score.matters), default=0.0)

    @property
    def largest_of_all(self) -> float:
        """Statistic, of those too that are smaller than what any model is wrong by."""
        return max((score.statistic for score in self.testable), default=0.0)


def rank(best: Optimum, families: Sequence[Family], columns: Mapping[str, Float[np.ndarray, "rows"]]) -> Ranking:
    """Every family's score at an optimum.

    **Arguments:** `columns`: key -> (rows,) in the units of the rows per unit of the effect, as the subject gives them.
    """
    work = _Work.of(best, [column for family in families for column in family.columns], columns)
    scores = tuple(
        sorted((work.score(family) for family in families), key=lambda score: (not score.testable, -score.statistic, abs(score.z)))
    )
    return Ranking(scores, tuple((node.columns, work.block(node.columns)) for score in scores for node in score.nodes))


@dataclass(frozen=True, eq=False)
class _Work:
    """Columns by key: whitened, and what Q leaves of them."""

    best: Optimum
    residual: Float[np.ndarray, "sample"]
    whole: Mapping[str, Float[np.ndarray, "sample"]]
    rest: Mapping[str, Float[np.ndarray, "sample"]]

    @classmethod
    def of(cls, best: Optimum, wanted: Sequence[Column], columns: Mapping[str, np.ndarray]) -> _Work:
        keys = [column.key for column in wanted]
        stacked = np.array([columns[key] for key in keys], dtype=float).reshape(len(keys), len(best.at.prediction)).T
        stacked = np.where(np.isfinite(stacked).all(axis=0), stacked, 0.0)
        whole = best.sample.columns(stacked)
        rest = best.projection(whole)
        return cls(best, best.projection(best.residual), dict(zip(keys, whole.T, strict=True)), dict(zip(keys, rest.T, strict=True)))

    def felt(self, column: Column) -> bool:
        return float(np.linalg.norm(self.whole[column.key])) * column.scale > FELT

    def left(self, column: Column) -> float:
        whole = float(np.linalg.norm(self.whole[column.key]))
        return float(np.linalg.norm(self.rest[column.key])) / whole if whole > 0 else 0.0

    def block(self, columns: Sequence[Column]) -> Float[np.ndarray, "sample k"]:
        rest = np.stack([self.rest[column.key] for column in columns], axis=1)
        return rest / np.linalg.norm(rest, axis=0)

    def node(self, columns: tuple[Column, ...]) -> Node:
        block = self.block(columns)
        lengths = np.array([np.linalg.norm(self.rest[column.key]) for column in columns])
        sizes = np.linalg.lstsq(block, self.residual, rcond=1e-9)[0] / lengths
        change = {column.key: float(size) for column, size in zip(columns, sizes, strict=True)}
        statistic = float(statistics(columns, (block.T @ self.residual)[:, None], block.T @ block)[0])
        return Node(columns, statistic, change, self._promise(columns, block, lengths))

    def _promise(self, columns: tuple[Column, ...], block: Float[np.ndarray, "sample k"], lengths: Float[np.ndarray, "k"]) -> float:
        limits = np.array([(column.lower - column.null, column.upper - column.null) for column in columns]).T * lengths
        left = lsq_linear(block, self.residual, bounds=(limits[0], limits[1])).cost
        return max(float(self.residual @ self.residual) - 2.0 * float(left), 0.0)

    def score(self, family: Family) -> Score:
        seen = [tuple(one for one in variant if self.felt(one) and self.left(one) >= LEFT) for variant in family.variants]
        nodes = tuple(sorted((self.node(columns) for columns in seen if columns), key=lambda node: -node.statistic))
        return self._tested(family, nodes) if nodes else self._untestable(family)

    def _tested(self, family: Family, nodes: tuple[Node, ...]) -> Score:
        best = nodes[0]
        first = best.columns[0]
        z = float(self.block(best.columns)[:, 0] @ self.residual) if len(best.columns) == 1 else best.statistic
        moved = sum((self.whole[key] * size for key, size in best.change.items()), np.zeros_like(self.residual))
        direction = self.best.projection(moved)
        length = float(np.linalg.norm(self.rest[first.key]))
        return Score(
            family, nodes, z, best.statistic, self._shift(moved), self.left(first), length,
            direction / max(float(np.linalg.norm(direction)), 1e-300), times_form=self._times_form(direction),
            shift_of_unit=self._shift(self.whole[first.key]),
        )  # fmt: skip

    def _times_form(self, direction: Float[np.ndarray, "sample"]) -> float:
        sample = self.best.sample
        change = np.zeros(len(sample.chosen))
        change[sample.chosen] = sample.whiten.back(direction[: int(sample.chosen.sum())])
        return material.times_form(sample.subject.rows, sample.chosen, change)

    def _shift(self, moved: np.ndarray) -> np.ndarray:
        return -(self.best.projection.inverse @ moved)[: len(self.best.raw)]

    def _untestable(self, family: Family) -> Score:
        felt = next((one for one in family.columns if self.felt(one)), None)
        nothing = np.zeros_like(self.residual)
        if felt is None:
            reason = "a plausible size of it does not move these data"
            return Score(family, (), 0.0, 0.0, np.zeros(len(self.best.raw)), 0.0, 0.0, nothing, reason)
        unit = self._shift(self.whole[felt.key])
        shift = unit * felt.scale
        reason = "absorbed by the base parameters: these data cannot tell it from a change of them"
        likeness = imitation(self.best.sample.subject.parameters, -shift, felt)
        return Score(family, (), 0.0, 0.0, shift, self.left(felt), 0.0, nothing, reason, likeness, shift_of_unit=unit)


def statistics(
    columns: Sequence[Column], scores: Float[np.ndarray, "k draws"], gram: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "draws"]:
    """The statistic of one node for many residuals: |z|, z on its own side, or the lowered root of a block's.

    **Arguments:** `scores`: what its normalised columns and the residuals have in common; `gram`: those columns among themselves.
    """
    if len(columns) == 1:
        sign = columns[0].sign
        return np.maximum(sign * scores[0], 0.0) if sign else np.abs(scores[0])
    values, vectors = np.linalg.eigh(gram)
    kept = values > 1e-9 * values[-1]
    squares = np.sum((vectors[:, kept].T @ scores) ** 2 / values[kept][:, None], axis=0)
    by_chance = stats.chi2.ppf(_QUANTILE, int(kept.sum())) - stats.chi2.ppf(_QUANTILE, 1)
    return np.sqrt(np.maximum(squares - by_chance, 0.0))


def imitation(parameters: tuple[Parameter, ...], shift: Float[np.ndarray, "p"], column: Column) -> str:
    """In words, the change of base parameters that a plausible size of an effect passes for, or a smaller one that moves none tenfold."""
    logs = [abs(size) for one, size in zip(parameters, shift, strict=True) if one.link == "log"]
    share = min(1.0, math.log(10.0) / max(max(logs, default=0.0), 1e-300))
    largest = float(np.max(np.abs(shift), initial=0.0))
    pairs = [(one, share * size) for one, size in zip(parameters, shift, strict=True) if abs(size) > 0.05 * largest]
    moved = ", ".join(
        f"{one.name} {math.expm1(size):+.1%}" if one.link == "log" else f"{one.name} {float(one.slope(one.raw())) * size:+.3g} {one.unit}"
        for one, size in sorted(pairs, key=lambda pair: -abs(pair[1]))
    )
    unit = "" if column.unit == "1" else f" {column.unit}"
    return f"{column.null + share * column.scale:.3g}{unit} would pass for {moved}"


def combined(
    best: Optimum, first: Sequence[Column], second: Sequence[Column], columns: Mapping[str, Float[np.ndarray, "rows"]]
) -> tuple[Node, ...]:
    """Two terms of one effect at once, each at its own node of the grid, the earlier node first: all pairs, best first, those
    that the signs allow before others.
    """
    work = _Work.of(best, [*first, *second], columns)
    pairs = {
        frozenset((tuple(one.fixed.items()), tuple(other.fixed.items()))): (one, other)
        for one in reversed(first)
        for other in second
        if one.fixed != other.fixed or not one.fixed
    }
    nodes = [work.node(pair) for pair in pairs.values() if all(work.felt(one) and work.left(one) >= LEFT for one in pair)]
    return tuple(sorted(nodes, key=lambda node: (not _possible(node), -node.statistic)))


def _possible(node: Node) -> bool:
    return all(column.sign * node.change[column.key] >= 0 for column in node.columns)
